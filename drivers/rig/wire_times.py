"""When the last motion commands were on the wires: what a stop's latency is measured by."""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.dynamixel.codec import Instruction, Packet
from drivers.dynamixel.virtual import VirtualServo
from drivers.electrak.codec import ElectrakCodec
from drivers.electrak.j1939.ids import Frame, Pgn, destination_of, pgn_of
from graderd.hal.clock import Clock


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
