"""Virtual Electraks on a wire of their own, reachable over a pseudo-terminal, a python-can bus, or in process."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

from graderd.drivers.j1939.bus_health import ERROR_FRAMES, BusEvent
from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.python_can import can
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import DeviceMissingError
from graderd.simulator.actuators import faults
from graderd.simulator.actuators.faults import LOWEST_PRIORITY_NAME, Flood, RivalController
from graderd.simulator.actuators.model import VirtualElectrak
from graderd.simulator.actuators.slcan import SlcanAdapter
from graderd.simulator.actuators.wire import Listener, Wire, WireBus

_TICK_S: Final = 0.005
_BUS_FAULTS: Final = (
    "adapter_hung",
    "adapter_refuses",
    "adapter_resets",
    "address_conflict",
    "bus_off",
    "claim_storm",
    "error_passive",
    "flood",
    "overrun",
    "self_reception",
)
BusState = Literal["bus_off", "error_passive", "error_active", "overrun"]
_STATE_LINES: Final[dict[BusState, bytes]] = {
    "bus_off": b"sb000256",
    "error_passive": b"sp128128",
    "error_active": b"sa000000",
    "overrun": b"e1o",
}
"""State and error lines as the kernel's slcan driver reads them from an adapter."""
_EVENTS: Final[dict[BusState, BusEvent]] = {
    "bus_off": BusEvent.BUS_OFF,
    "error_passive": BusEvent.ERROR_PASSIVE,
    "error_active": BusEvent.ERROR_ACTIVE,
    "overrun": BusEvent.QUEUE_OVERRUN,
}


class VirtualActuatorBus:
    """Owns the virtual actuators, moves their time and carries their frames, all on the caller's event loop.

    ``link``: path of a symbolic link to an slcan pseudo-terminal. ``bus``: a python-can bus with a file descriptor
    (vcan) to join, instead or as well; the caller closes it. Without either, :meth:`connect` gives in-process buses.
    """

    def __init__(
        self,
        actuators: Sequence[VirtualElectrak],
        *,
        link: Path | None = None,
        bus: can.BusABC | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.actuators = tuple(actuators)
        self.wire = Wire()
        self._clock = clock or SystemClock()
        self._adapter = SlcanAdapter(self.wire, link) if link else None
        self._external = bus
        self._buses: list[WireBus] = []
        self._task: asyncio.Task[None] | None = None
        self._hearers: list[Listener] = []
        self._unit_hearers: dict[int, Listener] = {}
        self._rival: RivalController | None = None
        self._flood: Flood | None = None

    # -- life -------------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Power up: create the pseudo-terminal, join the external bus, start moving time.

        Raises:
            DeviceMissingError: the link cannot be created.
        """
        if self._task is not None:
            return
        if self._adapter is not None:
            try:
                self._adapter.plug()
            except OSError as error:
                raise DeviceMissingError(
                    "virtual CAN adapter", f"cannot create its terminal: {error}", "Check the link's folder"
                ) from error
        for unit in self.actuators:
            hear = self._hearer_of(unit)
            self._unit_hearers[id(unit)] = hear
            self.listen(hear)
        self.listen(self._on_rival)
        if self._external is not None:
            self._join(self._external)
        self._task = asyncio.create_task(self._run(), name="virtual-actuators")

    async def close(self) -> None:
        """Stop time, remove the terminal, close the buses handed out; idempotent."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        for hear in self._hearers:
            self.wire.detach(hear)
        self._hearers.clear()
        if self._adapter is not None:
            self._adapter.unplug()
        if self._external is not None:
            self._leave(self._external)
        for bus in self._buses:
            bus.shutdown()
        self._buses.clear()

    @property
    def channel_open(self) -> bool:
        """Whether a host has opened the slcan adapter's channel: frames reach it from then on."""
        return self._adapter is not None and self._adapter.is_open

    def connect(self) -> WireBus:
        """Another node on the wire, as a python-can bus of this process; closed with this object at the latest."""
        bus = WireBus(self.wire)
        self._buses.append(bus)
        return bus

    def send(self, frame: Frame) -> None:
        """Put a frame of any node on the wire (a peer that injects)."""
        self.wire.send(frame)

    def listen(self, listener: Listener) -> None:
        """Hear every frame on the wire until :meth:`close`."""
        self.wire.attach(listener)
        self._hearers.append(listener)

    def unplug(self) -> None:
        """Pull the slcan adapter out; in-process buses fail as a deleted interface does (ENODEV)."""
        if self._adapter is not None:
            self._adapter.unplug()
        self._fail_buses(19, "No such device")

    def replug(self) -> None:
        """Put the adapter back; in-process buses have to be connected anew."""
        if self._adapter is not None:
            self._adapter.plug()

    def interface_down(self) -> None:
        """In-process buses fail as after ``ip link set down`` (ENETDOWN)."""
        self._fail_buses(100, "Network is down")

    # -- faults -----------------------------------------------------------------------------------------------------

    def fault_names(self) -> tuple[str, ...]:
        """Faults that :meth:`inject` knows: of one actuator, and of the bus."""
        return tuple(sorted((*faults.UNIT_FAULTS, *_BUS_FAULTS)))

    def inject(self, fault: str, *, address: int | None = None, **params: float) -> None:
        """Switch a fault on: of the unit at ``address`` (None: all units), or of the bus.

        Bus faults and their parameters: ``flood`` rate_hz 2000; ``address_conflict`` at_address 231: a controller
        with our own NAME; ``claim_storm`` at_address 231, rate_hz 200, wins 1: a controller who claims without end, and
        whose NAME wins (0: loses) every arbitration; ``bus_off``, ``error_passive``, ``overrun``: as the adapter or
        kernel reports them; ``adapter_hung``: the adapter no longer reads; ``adapter_refuses``: it answers NACK to
        every frame; ``adapter_resets`` boot_s 0: it forgets its channel, and from the next time its port is opened on
        boots so long; ``self_reception``: the host gets its own frames back.

        Raises:
            ValueError: no such fault, or no unit at that address.
        """
        if fault not in _BUS_FAULTS:
            units = [unit for unit in self.actuators if address in (None, unit.address)]
            if fault not in faults.UNIT_FAULTS:
                raise ValueError(f"no fault {fault!r}; there are {', '.join(self.fault_names())}")
            if not units:
                raise ValueError(f"no virtual actuator at address {address}")
            for unit in units:
                faults.inject(unit, fault, dict(params))
            return
        match fault:
            case "flood":
                self._flood = Flood(params.get("rate_hz", 2000.0))
            case "address_conflict":
                self._rival = RivalController(int(params.get("at_address", 231)))
            case "claim_storm":
                rate_hz = params.get("rate_hz", 200.0)
                name = 1 if params.get("wins", 1.0) else LOWEST_PRIORITY_NAME
                self._rival = RivalController(int(params.get("at_address", 231)), name=name, claims_hz=rate_hz)
            case "adapter_hung":
                if self._adapter is not None:
                    self._adapter.set_deaf(True)
            case "adapter_refuses" | "adapter_resets" | "self_reception":
                self._disturb_adapter(fault, params.get("boot_s", 0.0))
            case "bus_off" | "error_passive" | "overrun":
                self.report_state(fault)

    def clear_faults(self) -> None:
        """Back to a healthy machine: every unit, the adapter and the bus."""
        for unit in self.actuators:
            faults.clear(unit)
        self._flood = None
        self._rival = None
        if self._adapter is not None:
            self._adapter.set_deaf(False)
            self._adapter.refusing = self._adapter.echoing = False
            self._adapter.boot_s = 0.0
        self.report_state("error_active")

    def report_state(self, state: BusState) -> None:
        """Tell the hosts a controller state: an slcan line, or a kernel-style error frame for in-process buses."""
        if self._adapter is not None:
            self._adapter.send_line(_STATE_LINES[state])
        class_bits, data = ERROR_FRAMES[_EVENTS[state]]
        for bus in self._buses:
            bus.deliver(can.Message(arbitration_id=class_bits, data=data, is_error_frame=True, is_extended_id=False))

    def send_adapter_line(self, line: bytes) -> None:
        """Send a raw slcan line to the host."""
        if self._adapter is not None:
            self._adapter.send_line(line)

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _run(self) -> None:
        while True:
            now_s = self._clock.now_s()
            for unit in self.actuators:
                for frame in unit.advance(now_s):
                    self.wire.send(frame, self._unit_hearers[id(unit)])
            for peer in (self._rival, self._flood):
                if peer is not None:
                    for frame in peer.advance(now_s):
                        self.wire.send(frame, self._on_rival)
            await asyncio.sleep(_TICK_S)

    def _disturb_adapter(self, fault: str, boot_s: float) -> None:
        if self._adapter is None:
            return
        match fault:
            case "adapter_refuses":
                self._adapter.refusing = True
            case "adapter_resets":
                self._adapter.boot_s = boot_s
                self._adapter.reset()
            case "self_reception":
                self._adapter.echoing = True

    def _hearer_of(self, unit: VirtualElectrak) -> Listener:
        def hear(frame: Frame) -> None:
            unit.on_frame(frame, self._clock.now_s())

        return hear

    def _on_rival(self, frame: Frame) -> None:
        if self._rival is not None:
            for answer in self._rival.on_frame(frame):
                self.wire.send(answer, self._on_rival)

    def _fail_buses(self, error_number: int, text: str) -> None:
        for bus in self._buses:
            bus.fail(can.CanOperationError(text, error_number))
        self._buses.clear()

    def _join(self, bus: can.BusABC) -> None:
        hear = _forward_to(bus)

        def readable() -> None:
            with contextlib.suppress(can.CanError):
                while (message := bus.recv(0)) is not None:
                    if not message.is_error_frame and not message.is_remote_frame:
                        self.wire.send(Frame(message.arbitration_id, bytes(message.data), message.is_extended_id), hear)
                return
            self._leave(bus)  # the interface is gone; the machine goes on without it

        self.listen(hear)
        asyncio.get_running_loop().add_reader(bus.fileno(), readable)

    def _leave(self, bus: can.BusABC) -> None:
        self._external = None
        with contextlib.suppress(OSError, ValueError):
            asyncio.get_running_loop().remove_reader(bus.fileno())


def _forward_to(bus: can.BusABC) -> Callable[[Frame], None]:
    def hear(frame: Frame) -> None:
        # a full transmit queue loses frames on a real bus too
        with contextlib.suppress(can.CanError):
            bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended))

    return hear
