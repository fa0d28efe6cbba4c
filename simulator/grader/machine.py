"""The virtual machine: the world, and the virtual servo and actuators that move the blade in it and feel its soil."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graderd.drivers.dynamixel.codec import Instruction, Packet
from graderd.drivers.electrak.codec import ElectrakCodec
from graderd.drivers.j1939.ids import Frame, Pgn, destination_of, pgn_of
from graderd.drivers.j1939.python_can import can
from graderd.hal.clock import Clock, SystemClock
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from graderd.simulator.grader.blade import GROUND_LIFT_MM, LEVEL_TILT_MM, BladePose
from graderd.simulator.grader.world import World
from graderd.simulator.servo import PlantSettings, VirtualServo, VirtualServoBus


class TimedServo(VirtualServo):
    """A virtual servo that remembers when its goal was written last; ``goal_written_s`` is monotonic."""

    goal_written_s = -math.inf

    def execute(self, packet: Packet, now_s: float, *, ram_only: bool = False) -> tuple[int, bytes] | None:
        """As :meth:`VirtualServo.execute`."""
        if packet.instruction == Instruction.WRITE and len(packet.params) > 2:
            first = int.from_bytes(packet.params[:2], "little")
            if first <= self.table["goal_position"].address < first + len(packet.params) - 2:
                self.goal_written_s = now_s
        return super().execute(packet, now_s, ram_only=ram_only)


class ControlTimes:
    """Listens on the actuators' bus: for each, when a message last allowed motion and when one forbade it again."""

    def __init__(self, addresses: Mapping[str, int], clock: Clock) -> None:
        self._names = {address: name for name, address in addresses.items()}
        self._clock = clock
        # The bit that enables motion is at the same place for every model.
        self._codec = ElectrakCodec("electrak_hd")
        self._enabled_s = dict.fromkeys(addresses, -math.inf)
        self._disabled_s = dict.fromkeys(addresses, -math.inf)

    def hear(self, frame: Frame) -> None:
        """One frame on the wire."""
        if not frame.extended or pgn_of(frame.can_id) != Pgn.PROPRIETARY_A or len(frame.data) != 8:
            return
        name = self._names.get(destination_of(frame.can_id))
        if name is None:
            return
        if self._codec.decode_control(frame.data).motion_enable:
            self._enabled_s[name] = self._clock.now_s()
        elif self._disabled_s[name] <= self._enabled_s[name]:
            self._disabled_s[name] = self._clock.now_s()

    def state(self) -> dict[str, float | None]:
        """Monotonic times by name; None: never."""
        told = {f"{name}_enabled_s": at_s for name, at_s in self._enabled_s.items()}
        told |= {f"{name}_disabled_s": at_s for name, at_s in self._disabled_s.items()}
        return {key: at_s if math.isfinite(at_s) else None for key, at_s in told.items()}


_ADDRESSES = {"lift_left": 19, "lift_right": 20, "tilt": 27}
STOPS_DEG = 75.0
"""The blade's ends meet the machine's frame there, so that one that is pushed or runs away does not spin for ever."""
_HAND_S = 0.1
"""Where a hand was longer ago says nothing about how fast it turns the blade."""
_LONGEST_STEP_S = 0.05
"""A process that was stopped for longer lets the machine miss that time instead of jumping."""
_UNLOADED_LIFT_N = 150.0
"""Half the weight of blade and circle on each lift, against extension."""
_LIFT_SHARE, _TILT_SHARE, _TILT_LIMIT_N = 0.3, 0.25, 350.0
"""Parts of the force on the blade that the lifts (of their own half) and the tilt feel: assumptions."""


class Machine:
    """World, servo and actuators of one rig, on the caller's event loop.

    ``servo_link``, ``can_link``: symbolic links to the pseudo-terminals; ``can_bus``: a python-can bus to join instead
    of an slcan pseudo-terminal.
    """

    def __init__(self, servo_link: Path, can_link: Path, can_bus: can.BusABC | None, seed: int) -> None:
        self.world = World()
        self.servo = TimedServo(servo_id=1, seed=seed, plant=PlantSettings(stops_deg=STOPS_DEG))
        self.servo_bus = VirtualServoBus([self.servo], servo_link, strict_baud=True)
        self.lift_left = VirtualElectrak("electrak_hd_b017", _ADDRESSES["lift_left"], GROUND_LIFT_MM, seed)
        self.lift_right = VirtualElectrak("electrak_hd_b017", _ADDRESSES["lift_right"], GROUND_LIFT_MM, seed + 1)
        self.tilt = VirtualElectrak("electrak_md_a050", _ADDRESSES["tilt"], LEVEL_TILT_MM, seed + 2)
        self.actuator_bus = VirtualActuatorBus(
            [self.lift_left, self.lift_right, self.tilt], link=None if can_bus else can_link, bus=can_bus
        )
        self._control_times = ControlTimes(_ADDRESSES, SystemClock())
        self._hand = (float("-inf"), 0.0)
        self.servo_faults: dict[str, dict[str, float]] = {}
        self.actuator_faults: dict[str, dict[str, float]] = {}

    async def start(self) -> None:
        """Plug both wires in."""
        await self.servo_bus.start()
        await self.actuator_bus.start()
        self.actuator_bus.listen(self._control_times.hear)

    async def close(self) -> None:
        """Pull both wires out; idempotent."""
        await self.actuator_bus.close()
        await self.servo_bus.close()

    def step(self, step_s: float) -> None:
        """Let the world follow servo and actuators for ``step_s``, and them feel its soil."""
        if step_s > 0.0:
            self.world.step(min(step_s, _LONGEST_STEP_S), self.pose())
            self._pass_loads()

    def pose(self) -> BladePose:
        """Where servo and actuators have the blade now."""
        return BladePose.from_actuators(
            self.servo.shaft_deg, self.lift_left.position_mm, self.lift_right.position_mm, self.tilt.position_mm
        )

    def _pass_loads(self) -> None:
        """Let servo and actuators feel the soil, except where an injected fault pushes them already."""
        load = self.world.load
        if "push" not in self.servo_faults:
            self.servo.load_torque_nm = load.servo_torque_nm(self.servo.torque_enabled)
        if "overload" in self.actuator_faults:
            return
        self.lift_left.load_n = _UNLOADED_LIFT_N + _LIFT_SHARE * load.left_n
        self.lift_right.load_n = _UNLOADED_LIFT_N + _LIFT_SHARE * load.right_n
        self.tilt.load_n = min(max(_TILT_SHARE * load.force_n, -_TILT_LIMIT_N), _TILT_LIMIT_N)

    # -- faults -----------------------------------------------------------------------------------------------------

    def inject_servo_fault(self, name: str, params: dict[str, float]) -> None:
        """A fault of the servo or its bus.

        Raises:
            ValueError: no such fault or parameter.
        """
        self.servo_bus.inject(name, **params)
        self.servo_faults[name] = dict(params)

    def inject_actuator_fault(self, name: str, device: str | None, params: dict[str, float]) -> None:
        """A fault of one actuator, of all (``device`` None), or of their bus.

        Raises:
            ValueError: no such fault or parameter.
        """
        if name == "unplug":
            if params or device:
                raise ValueError("unplug is a fault of the adapter: it has no device and no parameters")
            self.actuator_bus.unplug()
        else:
            if "address" in params:
                raise ValueError("name the unit by device, not by address")
            rest: dict[str, Any] = dict(params)
            self.actuator_bus.inject(name, address=None if device is None else _ADDRESSES[device], **rest)
        self.actuator_faults[name] = dict(params)

    def turn_blade(self, angle_deg: float) -> None:
        """Somebody turns the blade by hand.

        Raises:
            ValueError: the servo holds it, or the frame is in the way.
        """
        if abs(angle_deg) > STOPS_DEG:
            raise ValueError(f"the blade turns to {STOPS_DEG:g} degrees at most")
        if self.servo.torque_enabled:
            raise ValueError("the servo's torque holds the blade; disarm first")
        now_s, (before_s, before_deg) = SystemClock().now_s(), self._hand
        speed = (angle_deg - before_deg) / (now_s - before_s) if 0.0 < now_s - before_s < _HAND_S else 0.0
        self.servo.turn_by_hand(angle_deg, speed)
        self._hand = now_s, angle_deg

    def send_frame(self, can_id: int, data: bytes) -> None:
        """A message of some other node on the actuators' bus (29-bit identifier)."""
        self.actuator_bus.send(Frame(can_id, data))

    def clear_servo_faults(self) -> None:
        """End the servo's faults."""
        self.servo_bus.clear_faults()
        self.servo_faults = {}

    def clear_actuator_faults(self) -> None:
        """End the actuators' faults; plug the adapter in again."""
        if "unplug" in self.actuator_faults:
            self.actuator_bus.replug()
        self.actuator_bus.clear_faults()
        self.actuator_faults = {}

    def fault_names(self) -> dict[str, list[str]]:
        """What can be injected."""
        return {
            "servo": list(self.servo_bus.fault_names()),
            "actuators": [*self.actuator_bus.fault_names(), "unplug"],
        }

    # -- truth ------------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What is true of machine and soil, as no sensor sees it."""
        world, load = self.world, self.world.load
        left, center, right = world.volumes_l()
        return {
            "time_s": time.monotonic(),
            "blade_deg": world.blade.angle_deg,
            "blade_velocity_deg_per_s": self.servo.shaft_velocity_deg_per_s,
            "blade_height_mm": world.blade.height_m * 1000.0,
            "blade_slope_deg": world.blade.slope_deg,
            "blade_pitch_deg": world.blade.pitch_deg,
            "lift_left_mm": self.lift_left.position_mm,
            "lift_right_mm": self.lift_right.position_mm,
            "tilt_mm": self.tilt.position_mm,
            "lift_left_velocity_mm_per_s": self.lift_left.velocity_mm_per_s,
            "lift_right_velocity_mm_per_s": self.lift_right.velocity_mm_per_s,
            "tilt_velocity_mm_per_s": self.tilt.velocity_mm_per_s,
            "vehicle_x_m": world.vehicle.x_m,
            "speed_m_per_s": world.vehicle.speed_m_per_s,
            "driving": world.vehicle.driving,
            "vol_left_l": left,
            "vol_center_l": center,
            "vol_right_l": right,
            "soil_mass_kg": world.soil_kg,
            "load_force_n": load.force_n,
            "load_torque_nm": load.torque_nm,
            "servo_torque_enabled": self.servo.torque_enabled,
            "servo_watchdog_tripped": self.servo.tripped,
            "servo_requests_n": self.servo_bus.requests_n,
            "lift_left_enabled": self.lift_left.motion_enabled,
            "lift_right_enabled": self.lift_right.motion_enabled,
            "tilt_enabled": self.tilt.motion_enabled,
            "servo_goal_written_s": self.servo.goal_written_s if math.isfinite(self.servo.goal_written_s) else None,
            **self._control_times.state(),
        }
