"""The control loop around the tick: senses, calls :class:`graderd.core.tick.Controller`, acts. It never waits."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple, Protocol

from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core import commands as cmd
from graderd.core.attitude import MeasuredAttitude
from graderd.core.machine import ARMED, Mode, State
from graderd.core.soil import SoilObservation
from graderd.core.tick import NO_VEHICLE, AxisSensed, AxisTick, Controller, Sensed, Tick
from graderd.hal.clock import Clock
from graderd.hal.errors import DeviceError
from graderd.hal.fault import DeviceFault
from graderd.runtime.devices import Devices, PowerSequencer
from graderd.runtime.state_file import LastStop, StateFile

MAX_COMMANDS_PER_TICK = 32
LATENESS_WINDOW_N = 500
ENDING = (cmd.Disarm, cmd.Manual, cmd.Release)
BEFORE = "stopped before the daemon was started"

log = logging.getLogger(__name__)


class Eyes(Protocol):
    """What the control loop wants of perception."""

    def take_observation(self) -> SoilObservation | None:
        """A new observation, once."""
        ...

    def faults(self) -> tuple[DeviceFault, ...]:
        """What is wrong with camera and picture."""
        ...

    def send_angle(self, angle_deg: float, time_s: float, attitude: MeasuredAttitude) -> None:
        """Tell perception the measured angle, and the attitude as far as it is known."""
        ...


class Queued(NamedTuple):
    """A command that waits for its tick, since when, and who waits for its reply."""

    command: cmd.Command
    heard_s: float
    reply: asyncio.Future[cmd.Reply]


def _state_at_start(last_stop: LastStop | None) -> State:
    """Stopped, where nobody has let go of what stopped the machine before it was started anew. Stops are counted on."""
    if last_stop is None:
        return State()
    if last_stop.reset:
        return State(stop_n=last_stop.stop_n)
    reason = last_stop.reason if BEFORE in last_stop.reason else f"{BEFORE}: {last_stop}"
    return State(mode=Mode.STOPPED, reason=reason, stop_n=max(1, last_stop.stop_n), stops=(reason,))


class ControlLoop:
    """One per daemon. ``sensed`` and ``tick`` are the newest: whoever wants to know something reads them. ``figures``:
    those of every axis.

    ``fault_sources``: told the time, each says what it sees wrong now. ``on_tick``: called at the end of every tick.
    ``on_step``: called with what every step of the controller knew and decided, those of a stop between two ticks
    included; the wires have been told by then. ``controller`` and its ``settings`` are for the recorder to read.
    ``ticks_n``, ``decisions_n``: since the start. ``armed_by``: who asked for the newest arming.
    """

    def __init__(
        self,
        config: Config,
        devices: Devices,
        eyes: Eyes,
        clock: Clock,
        state_file: StateFile,
    ) -> None:
        self.lateness_s: deque[float] = deque(maxlen=LATENESS_WINDOW_N)
        self.ticks_n = self.decisions_n = 0
        self.last_stop = state_file.load()
        self.fault_sources: list[Callable[[float], tuple[DeviceFault, ...]]] = []
        self.on_tick: Callable[[], None] | None = None
        self.on_step: Callable[[Sensed, Tick], None] | None = None
        self._period_s = 1.0 / config.control.tick_hz
        self.settings = tick_settings(config)
        self.figures = self.settings.figures
        self.controller = Controller(self.settings, _state_at_start(self.last_stop))
        self._devices = devices
        self._eyes = eyes
        self._clock = clock
        self._state_file = state_file
        self._power = PowerSequencer(devices)
        self._queue: deque[Queued] = deque()
        self._refused: dict[str, str] = {}
        self._keep_last_stop = False
        self.armed_by = ""
        self.sensed = self._sensed(())
        self.tick = self.controller.step(self.sensed)

    # ---- commands -------------------------------------------------------------------------------------------------

    async def command(self, command: cmd.Command, waited_s: float = 0.0) -> cmd.Reply:
        """Hand a command to the next tick and wait for its reply. Stop acts on the wires before it returns.
        ``waited_s``: for how long it waited before."""
        if isinstance(command, cmd.Stop):
            return self.stop_now(command)
        future: asyncio.Future[cmd.Reply] = asyncio.get_running_loop().create_future()
        self._queue.append(Queued(command, self._clock.now_s() - waited_s, future))
        return await future

    def stop_now(self, command: cmd.Stop) -> cmd.Reply:
        """Stop without waiting for a tick: hold on every wire now, then latch. What was queued before it is void."""
        self._hold_all()
        reply = self._step((command,))[0]
        while self._queue:
            queued = self._queue.popleft()
            if not queued.reply.done():
                name = queued.command.command
                void = cmd.Reply(command=name, accepted=False, message=cmd.STOP_CAME_FIRST, remedy=cmd.STOP_REMEDY)
                queued.reply.set_result(void)
        return reply

    def end(self, reason: str) -> bool:
        """Stop because the daemon ends, and say whether that ended an armed machine's work. Where it did not, what
        stopped the machine last is still told after a restart."""
        interrupts = self.tick.state.mode in ARMED
        self._keep_last_stop = not interrupts
        self.stop_now(cmd.Stop(reason=reason))
        self._keep_last_stop = False  # a stop while the devices are being closed is somebody's, and needs its reset
        return interrupts

    # ---- the tick -------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Tick at the configured rate until cancelled. A late tick is counted, and not made up for."""
        due_s = self._clock.now_s()
        try:
            while True:
                began_s = self._clock.now_s()
                late_s = max(0.0, began_s - due_s)
                self.lateness_s.append(late_s)
                self.run_tick(late_s)
                # From its beginning: a pause of the process in the midst of a tick makes the next one late.
                due_s = max(due_s + self._period_s, began_s)
                await asyncio.sleep(max(0.0, due_s - self._clock.now_s()))
        finally:
            await self._power.close()

    def run_tick(self, late_s: float = 0.0) -> None:
        """Sense, decide, act, with the commands that came meanwhile."""
        queued = list(islice(self._taken(), MAX_COMMANDS_PER_TICK))
        replies = self._step(tuple(asked.command for asked in queued), late_s, tuple(asked.heard_s for asked in queued))
        for asked, reply in zip(queued, replies, strict=True):
            if not asked.reply.done():
                asked.reply.set_result(reply)
        if self.on_tick is not None:
            self.on_tick()

    def _taken(self) -> Iterator[Queued]:
        """What is queued, without what nobody waits for any more: nothing is begun for who has gone, or was told that
        nothing came of it. What only ends something counts all the same."""
        while self._queue:
            asked = self._queue.popleft()
            if not asked.reply.done() or isinstance(asked.command, ENDING):
                yield asked

    def _step(
        self, commands: tuple[cmd.Command, ...], late_s: float = 0.0, heard_s: tuple[float, ...] = ()
    ) -> tuple[cmd.Reply, ...]:
        before = self.tick.state
        self.ticks_n += 1
        self.sensed = self._sensed(commands, late_s, heard_s)
        self.tick = self.controller.step(self.sensed)
        self._act(self.tick)  # the wires come first, then whoever wants to know
        self.decisions_n += self.tick.state.decision.decided_s > before.decision.decided_s
        self._note(before, self.tick.state)
        if self.on_step is not None:
            self.on_step(self.sensed, self.tick)
        return self.tick.replies

    def _obeyed(self) -> Iterator[cmd.Command]:
        """The commands of this tick that were accepted."""
        return (c for c, reply in zip(self.sensed.commands, self.tick.replies, strict=True) if reply.accepted)

    def _note(self, before: State, after: State) -> None:
        if after.arming_since_s not in (None, before.arming_since_s):
            self.armed_by = next((command.client for command in self._obeyed() if isinstance(command, cmd.Arm)), "")
        if after.mode is Mode.STOPPED:
            # A second reason as well as the first: who starts the daemon anew has to know both.
            if after.stops != before.stops and not self._keep_last_stop:
                self.last_stop = self._state_file.save(after.reason, after.stop_n)
        elif before.mode is Mode.STOPPED and self.last_stop is not None:
            self.last_stop = self._state_file.save_reset(self.last_stop, before.stop_n)
        if before.mode is not after.mode:
            self._tell_transition(before.mode, after)

    def _tell_transition(self, before: Mode, after: State) -> None:
        """Who or what changed the mode stands in fields of its own beside the text."""
        client = next((command.client for command in self._obeyed() if command.client), "")
        if before is Mode.DISARMED and after.mode is Mode.MANUAL:
            client = self.armed_by  # asked for before the devices were powered
        fault = next((f.name for f in self.tick.faults if after.reason.startswith(f"{f.name}: ")), "")
        fields = {"event": True, "mode": after.mode, "client": client, "fault": fault}
        log.info("%s -> %s: %s", before, after.mode, after.reason, extra=fields)

    def _sensed(
        self, commands: tuple[cmd.Command, ...], late_s: float = 0.0, heard_s: tuple[float, ...] = ()
    ) -> Sensed:
        """Everything that is known now; each device is asked once."""
        now_s = self._clock.now_s()
        found: list[DeviceFault] = [*self._devices.link.faults(), *self._eyes.faults()]
        axes: dict[str, AxisSensed] = {}
        for name, device in self._devices.all().items():
            found.extend(device.faults())
            axes[name] = AxisSensed(device.lifecycle, device.telemetry(), self._devices.problem_of(name))
        for source in self.fault_sources:
            found.extend(source(now_s))
        if self._state_file.problem:
            found.append(DeviceFault("daemon", "state_file_corrupt", self._state_file.problem, now_s))
        refused, self._refused = self._refused, {}
        return Sensed(
            now_s=now_s,
            axes=axes,
            faults=tuple(found),
            commands=commands,
            waited_s=tuple(max(0.0, now_s - at_s) for at_s in heard_s),
            observation=self._eyes.take_observation(),
            powered=self._power.all_active,
            arm_error=self._power.take_error(),
            refused=refused,
            late_s=late_s,
            vehicle=self._devices.vehicle.telemetry() if self._devices.vehicle else NO_VEHICLE,
        )

    def _act(self, tick: Tick) -> None:
        """Hand what was decided to the devices."""
        if tick.stopped_now:
            self._hold_all()
        self._power.want(tick.intents.power)
        for axis, decided in tick.axes.items():
            self._tell(axis, decided)
        angle = self.sensed.axes["rotation"].telemetry.position
        if angle is not None and angle.valid:
            self._eyes.send_angle(angle.value, angle.time_s, tick.attitude)

    def _tell(self, axis: str, decided: AxisTick) -> None:
        if decided.send is None:
            if decided.hold:
                self._devices.all()[axis].hold()
            return
        try:
            if axis == "rotation":
                self._devices.rotation.set_goal_deg(decided.send)
            else:
                self._devices.actuators[axis].set_target_mm(decided.send, decided.speed_share)
        except DeviceError as error:
            # The driver is the last to say no (its own soft limits, a lost device); the axis holds.
            self._refused[axis] = str(error)
            self._devices.all()[axis].hold()

    def _hold_all(self) -> None:
        """The stop path: every axis is told, whatever one of the drivers does."""
        for name in self._devices.hold_all():
            fields = {"device": name}
            log.error("%s: its driver failed to take the hold; its own dead man ends the motion", name, extra=fields)
