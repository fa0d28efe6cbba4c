"""The control tick: takes the newest of everything, decides, limits, commands, feeds the watchdog. Never waits."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from typing import Protocol

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, FaultState, clear_faults, update_faults
from graderd.core.gate import AxisPass, GateInputs, GateState, pass_gate
from graderd.core.lift import LiftCoordinator, height_mm
from graderd.core.lift_pair import SideReading
from graderd.core.machine import ARMED, Inputs, Intents, Mode, Pose, State, step
from graderd.core.motion import resolve
from graderd.core.plausibility import PlausibilityMonitor, axis_figures
from graderd.core.soil import SoilObservation
from graderd.hal.clock import Clock
from graderd.hal.errors import DeviceError
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.lifecycle import Lifecycle
from graderd.hal.reading import Reading
from graderd.runtime.devices import ACTUATOR_NAMES, Devices, PowerSequencer
from graderd.runtime.readiness import requirements
from graderd.runtime.state_file import StateFile

MAX_COMMANDS_PER_TICK = 32
LATENESS_WINDOW_N = 500
BLOCKED_S = 0.5
"""A tick this late: goals have timed out and the servo's watchdog (0.2 s by default) has tripped meanwhile."""
LAPSE_SHOWN_S = 3.0

log = logging.getLogger(__name__)


class Eyes(Protocol):
    """What the control loop wants of perception."""

    def take_observation(self) -> SoilObservation | None:
        """A new observation, once."""
        ...

    def faults(self) -> tuple[DeviceFault, ...]:
        """What is wrong with camera and picture."""
        ...

    def send_angle(self, angle_deg: float, time_s: float) -> None:
        """Tell perception the measured angle."""
        ...


class ControlLoop:
    """Owns the machine's state. One per daemon."""

    def __init__(
        self,
        config: Config,
        devices: Devices,
        eyes: Eyes,
        clock: Clock,
        state_file: StateFile,
    ) -> None:
        self.config = config
        self.devices = devices
        self.state = State()
        self.faults = FaultState()
        self.passed: dict[str, AxisPass] = {}
        self.intents = Intents()
        self.overruns_n = 0
        self.lateness_s: deque[float] = deque(maxlen=LATENESS_WINDOW_N)
        self.time_s = clock.now_s()
        self.last_stop = state_file.load()
        self.connection_problems: dict[str, str] = {}
        self.extra_faults: list[Callable[[float], tuple[DeviceFault, ...]]] = []
        self.on_tick: Callable[[], None] | None = None
        self._eyes = eyes
        self._clock = clock
        self._state_file = state_file
        self._gate = GateState()
        self._lift = LiftCoordinator(config.lift_pair)
        speeds = {axis: limit.speed for axis, limit in config.gate.limits().items()}
        self._plausibility = PlausibilityMonitor(axis_figures(config.rotation, speeds))
        self._power = PowerSequencer(devices)
        self._queue: deque[tuple[cmd.Command, asyncio.Future[cmd.Reply]]] = deque()
        self._moving: set[str] = set()
        self._own_faults = PresentFaults("daemon")

    # ---- commands -------------------------------------------------------------------------------------------------

    async def command(self, command: cmd.Command) -> cmd.Reply:
        """Hand a command to the next tick and wait for its reply. Stop acts on the wires before it returns."""
        if isinstance(command, cmd.Stop):
            return self.stop_now(command)
        future: asyncio.Future[cmd.Reply] = asyncio.get_running_loop().create_future()
        self._queue.append((command, future))
        return await future

    def stop_now(self, command: cmd.Stop) -> cmd.Reply:
        """Stop without waiting for a tick: hold on every wire now, then latch."""
        self._hold_all()
        return self._step((command,))[0]

    # ---- the tick -------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Tick at the configured rate until cancelled. A late tick is counted, and not made up for."""
        period_s = 1.0 / self.config.control.tick_hz
        due_s = self._clock.now_s()
        try:
            while True:
                late_s = self._clock.now_s() - due_s
                self.lateness_s.append(max(0.0, late_s))
                if late_s > self.config.control.overrun_s:
                    self.overruns_n += 1
                    self._note_late(late_s, self._clock.now_s())
                self.tick()
                due_s = max(due_s + period_s, self._clock.now_s())
                await asyncio.sleep(max(0.0, due_s - self._clock.now_s()))
        finally:
            await self._power.close()

    def tick(self) -> None:
        """One turn of sense, decide, limit, act."""
        queued = [self._queue.popleft() for _ in range(min(len(self._queue), MAX_COMMANDS_PER_TICK))]
        replies = self._step(tuple(command for command, _ in queued))
        for (_, future), reply in zip(queued, replies, strict=True):
            if not future.done():
                future.set_result(reply)
        if self.on_tick is not None:
            self.on_tick()

    def _step(self, commands: tuple[cmd.Command, ...]) -> tuple[cmd.Reply, ...]:
        now_s = self._clock.now_s()
        dt_s, self.time_s = now_s - self.time_s, now_s
        pose = self.pose(now_s)
        self.faults = update_faults(self.faults, self._present_faults(now_s), now_s, CATALOGUE)
        self._clear_latches(commands)
        before = self.state
        # The machine answers stop first; replies are put back into the order the commands came in.
        order = sorted(range(len(commands)), key=lambda i: not isinstance(commands[i], cmd.Stop))
        result = step(
            self.state,
            Inputs(
                now_s=now_s,
                resolve=lambda command, at: resolve(
                    command, at, self.config.attitude, self.config.presets, self._limits()
                ),
                commands=commands,
                observation=self._eyes.take_observation(),
                pose=pose,
                settled=self._settled(pose),
                devices_active=self._power.all_active,
                arm_error=self._power.take_error(),
                unmet=tuple(r.unmet() for r in requirements(self, now_s) if r.mandatory and not r.met),
                faults=self.faults.active,
            ),
            self.config.machine,
            self.config.rule,
        )
        self.state, self.intents = result.state, result.intents
        self._note_transition(before, result.state)
        self._note_lapse(before, result.state, now_s)
        self._act(dt_s, pose)
        replies: list[cmd.Reply] = [result.replies[0]] * len(commands) if commands else []
        for position, index in enumerate(order):
            replies[index] = result.replies[position]
        return tuple(replies)

    def _act(self, dt_s: float, pose: Pose) -> None:
        """Pass the gate and hand what may be sent to the drivers."""
        self._power.want(self.intents.power)
        goals, shares = self._lift.step(
            self.intents.goals, self.time_s, self._side("lift_left"), self._side("lift_right")
        )
        self._gate, self.passed = pass_gate(
            self._gate,
            goals,
            GateInputs(
                settings=self.config.gate,
                mode=self.state.mode,
                pose=pose,
                dt_s=dt_s,
                lease_ok=self.state.mode is Mode.AUTO or self.state.lease is not None,
                height_mm=height_mm(self.config.attitude, pose),
            ),
        )
        for axis, result in self.passed.items():
            try:
                self._send(axis, result.limited, shares.get(axis, 1.0))
            except DeviceError as error:
                # The driver is the last to say no (its own soft limits, a lost device); the axis holds.
                self.passed[axis] = AxisPass(result.requested, None, str(error))
                self._hold(axis)
        angle = self.devices.rotation.telemetry().angle_deg
        if angle is not None and angle.valid:
            self._eyes.send_angle(angle.value, angle.time_s)

    def _send(self, axis: str, limited: float | None, speed_share: float) -> None:
        if limited is None or not self._power.all_active:
            self._hold(axis)
        elif axis == "rotation":
            self._moving.add(axis)
            self.devices.rotation.set_goal_deg(limited)
        else:
            self._moving.add(axis)
            self.devices.actuators[axis].set_target_mm(limited, speed_share)

    def _hold_all(self) -> None:
        """The stop path: every axis is told, whatever one of the drivers does."""
        for name in self.devices.hold_all():
            log.error("%s: its driver failed to take the hold; its own dead man ends the motion", name)
        self._moving.clear()

    def _side(self, name: str) -> SideReading | None:
        reading = self.devices.actuators[name].telemetry().position_mm
        return SideReading(reading.value, reading.time_s) if reading is not None and reading.valid else None

    def _hold(self, axis: str) -> None:
        """Once: a hold renewed every tick would follow every bit of measured drift."""
        if axis in self._moving:
            self._moving.discard(axis)
            self.devices.all()[axis].hold()

    # ---- what is known --------------------------------------------------------------------------------------------

    def pose(self, now_s: float) -> Pose:
        """Measured positions fresh enough to act on."""
        control = self.config.control
        positions = {
            name: _fresh(self.devices.actuators[name].telemetry().position_mm, now_s, control.actuator_max_age_s)
            for name in ACTUATOR_NAMES
        }
        return Pose(
            rotation_deg=_fresh(self.devices.rotation.telemetry().angle_deg, now_s, control.rotation_max_age_s),
            lift_left_mm=positions["lift_left"],
            lift_right_mm=positions["lift_right"],
            tilt_mm=positions["tilt"],
        )

    def _settled(self, pose: Pose) -> bool:
        """Whether every axis with a goal stands at it, or at the bound the gate lets it have."""
        control = self.config.control
        for axis, result in self.passed.items():
            rotation = axis == "rotation"
            goals = self.intents.goals
            wanted = goals.rotation_deg if rotation else getattr(goals, f"{axis}_mm")
            if wanted is None:
                continue
            measured = pose.rotation_deg if rotation else getattr(pose, f"{axis}_mm")
            tolerance = control.rotation_tolerance_deg if rotation else control.actuator_tolerance_mm
            goal = result.limited if result.reason and result.limited is not None else wanted
            if measured is None or abs(measured - goal) > tolerance:
                return False
        return True

    def _limits(self) -> dict[str, tuple[float, float]]:
        return {axis: (limit.low, limit.high) for axis, limit in self.config.gate.limits().items()}

    def _present_faults(self, now_s: float) -> list[DeviceFault]:
        found: list[DeviceFault] = [*self.devices.link.faults(), *self._eyes.faults(), *self._lift.faults()]
        for device in self.devices.all().values():
            found.extend(device.faults())
        found.extend(self._plausibility.judge(self.devices.axis_samples(), now_s))
        for source in self.extra_faults:
            found.extend(source(now_s))
        problem = self._state_file.problem
        self._own_faults.keep("state_file_corrupt", bool(problem), problem, now_s)
        return [*found, *self._own_faults.present(now_s)]

    def _note_transition(self, before: State, after: State) -> None:
        if before.mode is after.mode:
            return
        log.info("%s -> %s: %s", before.mode, after.mode, after.reason)
        if after.mode is Mode.STOPPED:
            self._hold_all()
            self.last_stop = self._state_file.save(after.reason)
        elif after.mode in ARMED and before.mode not in ARMED:
            self._gate = GateState()
            self.faults = clear_faults(self.faults, Clear.ON_REARM)

    def _note_late(self, late_s: float, now_s: float) -> None:
        detail = f"tick {late_s * 1e3:.0f} ms late, {self.overruns_n} overruns"
        self._own_faults.tell("loop_blocked" if late_s > BLOCKED_S else "tick_overrun", detail, now_s)

    def _note_lapse(self, before: State, after: State, now_s: float) -> None:
        lapsed = before.lease is not None and after.lease is None and now_s > before.lease.expires_s
        if lapsed and before.lease is not None and after.mode in ARMED:
            self._own_faults.tell("lease_lapsed", f"client {before.lease.client or '?'}", now_s, LAPSE_SHOWN_S)

    def _clear_latches(self, commands: tuple[cmd.Command, ...]) -> None:
        """A reset or an arm lets go of latched faults whose cause is gone; what is still there stays and refuses."""
        if any(isinstance(command, cmd.Stop) for command in commands):
            return
        if any(isinstance(command, cmd.Reset) for command in commands):
            self.faults = clear_faults(self.faults, Clear.ON_RESET)
        if self.state.mode is Mode.DISARMED and any(isinstance(command, cmd.Arm) for command in commands):
            self.faults = clear_faults(self.faults, Clear.ON_REARM)

    def published_faults(self) -> tuple[DeviceFault, ...]:
        """The active faults as the bus publishes them."""
        return tuple(
            DeviceFault(device, condition, fault.detail, fault.since_s)
            for fault in self.faults.active
            for device, _, condition in (fault.name.partition("."),)
        )

    def lifecycle(self, axis: str) -> Lifecycle:
        """Lifecycle of an axis's device."""
        return self.devices.all()[axis].lifecycle


def _fresh(reading: Reading[float] | None, now_s: float, max_age_s: float) -> float | None:
    return reading.value if reading is not None and reading.is_fresh(now_s, max_age_s) else None
