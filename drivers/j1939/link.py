"""The CAN link: one owner of the bus, its own reader, a steady schedule of control messages, a supervisor.

The drivers of all devices on the bus share one :class:`CanLink`. It claims our J1939 address, sends every device's
control message on a fixed 100 ms grid, hands feedback out by source address, tells stop messages, publishes DM1, and
opens the bus again with back-off when it was lost. What is in the messages is the drivers' own.

Without an address (contended, not claimed yet) a node is to be silent. A stop is not: whatever may be in motion is told
to end it at once, from the address that was ours last, and told again until it stands. Electraks obey any address.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Protocol

from graderd.drivers.j1939 import dm1
from graderd.drivers.j1939.bus_health import BusEvent, BusHealth
from graderd.drivers.j1939.can_port import READY_S, BusPort, PortFullError, PortLostError, open_port
from graderd.drivers.j1939.ids import GLOBAL, Frame, Pgn, destination_of, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.drivers.j1939.node import Identity, J1939Node
from graderd.drivers.j1939.stop_message import StopWatcher
from graderd.drivers.j1939.ticker import Ticker
from graderd.drivers.j1939.transport import Message
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import DeviceError, DeviceLostError, DeviceMissingError, DeviceRefusedError
from graderd.hal.fault import DeviceFault
from graderd.hal.settings import CanSettings


class LinkUser(Protocol):
    """The driver of one device on the bus, as the link sees it. The methods never wait."""

    @property
    def address(self) -> int:
        """J1939 address of the device."""
        ...

    @property
    def feedback_pgn(self) -> int:
        """Parameter group of the device's feedback, sent to everybody or to us; for as long as it is attached."""
        ...

    def control_frame(self, source: int, now_s: float) -> Frame:
        """The control message that goes out now, from our address ``source``."""
        ...

    def stop_frame(self, source: int, now_s: float) -> Frame | None:
        """The control message that ends motion, for while we have no address; None where nothing can be moving."""
        ...

    def on_feedback(self, data: bytes, now_s: float) -> None:
        """A message of the feedback group from the device's address."""
        ...

    def on_claim(self, name: int, solicited: bool, now_s: float) -> None:
        """An address claim from this address; ``solicited`` where somebody asked for claims just before."""
        ...

    def on_link_lost(self, now_s: float) -> None:
        """The bus is gone; nothing can be sent."""
        ...

    def hold(self) -> None:
        """Disable motion from the next control message on."""
        ...


_log = logging.getLogger(__name__)
_FIELDS = {"device": "can"}

CONTROL_PERIOD_S: Final = 0.1
_POLL_S: Final = 0.02
_AHEAD_S: Final = 0.0004
"""Wake-ups come so much before their time: more than waking up and encoding mostly take, so that control messages keep
their period to some microseconds. What is left of it is spun, ten times a second."""
_BACKOFF_FIRST_S: Final = 0.1
_BACKOFF_MAX_S: Final = 2.0
_CLOSE_REPEATS_N: Final = 3
_REFUSED_WITHIN_S: Final = 0.05
"""An adapter's answer to a frame comes within milliseconds; one that is full says so at once."""
_STOP_UNADDRESSED_S: Final = 2.0
"""For so long after the address was lost, or the bus opened, motion is ended from the address that was ours last."""


@dataclass(slots=True)
class LinkCounters:
    """What the link did since it was made."""

    rx_n: int = 0
    tx_n: int = 0
    tx_full_n: int = 0
    refused_n: int = 0
    lost_n: int = 0
    reopened_n: int = 0
    control_late_max_s: float = 0.0


@dataclass(slots=True)
class _Taps:
    frames: list[Callable[[Frame, float], None]] = field(default_factory=list)
    events: list[Callable[[BusEvent, float], None]] = field(default_factory=list)
    messages: list[Callable[[Message, float], None]] = field(default_factory=list)


_BACK_WITHIN_S: Final = 0.25
_PROOF_N: Final = 64
"""Frames that must come back in a row, about two seconds of traffic, before one that did not is forgotten."""
_WAITING_MAX_N: Final = 512


class SelfReception:
    """Tells an echo from another node's frame. One object for each opening of the bus."""

    def __init__(self) -> None:
        self._waiting: collections.deque[tuple[Frame, float]] = collections.deque(maxlen=_WAITING_MAX_N)
        self._returned_n = 0
        self._needed_n = 1

    def on_sent(self, frame: Frame, now_s: float) -> None:
        """A frame left."""
        self._waiting.append((frame, now_s))

    def is_echo(self, frame: Frame, now_s: float) -> bool:
        """Whether a frame that came is one of ours, come back."""
        while self._waiting and now_s - self._waiting[0][1] > _BACK_WITHIN_S:
            self._waiting.popleft()
            self._returned_n, self._needed_n = 0, _PROOF_N
        if not self._waiting or self._waiting[0][0] != frame:
            return False
        self._waiting.popleft()
        self._returned_n += 1
        return self._returned_n >= self._needed_n


class CanLink:
    """The J1939 bus of the machine's devices.

    ``on_stop`` is called, with the reason in words, for a stop message (ISO 11783-7 or the configured PGN).
    ``bus_factory`` replaces the opening of ``settings.interface`` (in-process buses of tests). All methods belong to
    one event loop.
    """

    def __init__(
        self,
        settings: CanSettings,
        clock: Clock | None = None,
        *,
        on_stop: Callable[[str], None] | None = None,
        bus_factory: Callable[[], BusPort] | None = None,
        software: str = "graderd",
    ) -> None:
        self.settings = settings
        self.counters = LinkCounters()
        self._clock = clock or SystemClock()
        self._factory = bus_factory
        self._node = J1939Node(
            name_from(settings),
            settings.source_address_n,
            identity=Identity(serial_number=str(settings.name_identity_n), software=software),
            obey_commanded=settings.obey_commanded_address,
        )
        self._health = BusHealth()
        self._stop = StopWatcher(settings.stop_pgn_n, settings.stop_on_iso11783_all_stop, on_stop)
        self._port: BusPort | None = None
        self._own = SelfReception()
        self._address: int | None = None
        self._last_address = settings.source_address_n
        self._unaddressed_since_s = -math.inf
        self._address_lost_at_s: float | None = None
        self._users: dict[int, LinkUser] = {}
        self._feedback_pgns: frozenset[int] = frozenset()
        self._unattached: dict[tuple[int, int], float] = {}
        self._taps = _Taps()
        self._tasks: list[asyncio.Task[None]] = []
        self._lost = asyncio.Event()
        self._opening = asyncio.Lock()
        self._not_opened: DeviceError | None = None
        self._boots_until_s = -math.inf

    # -- state ------------------------------------------------------------------------------------------------------

    @property
    def is_open(self) -> bool:
        """Whether there is a way onto the bus now."""
        return self._port is not None

    @property
    def address(self) -> int | None:
        """Our claimed address; None while it may not be used."""
        return self._node.address if self._port is not None else None

    @property
    def node(self) -> J1939Node:
        """The protocol machine, for its counters and the addresses seen."""
        return self._node

    @property
    def where(self) -> str:
        """Interface and channel, for messages."""
        return f"CAN {self.settings.interface} {self.settings.channel}"

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions of the bus present now, device ``can``."""
        now_s = self._clock.now_s()
        lost_for_s = 0.0 if self._address_lost_at_s is None else now_s - self._address_lost_at_s
        self._health.watch_claim(self._node.claimer, lost_for_s, now_s)
        return self._health.faults(now_s)

    def unattached(self, pgn: int, now_s: float) -> tuple[int, ...]:
        """Addresses that sent this feedback group within the last second and belong to no attached device."""
        return tuple(sorted(a for (of_pgn, a), t in self._unattached.items() if of_pgn == pgn and now_s - t < 1.0))

    # -- life -------------------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """Open the bus, claim our address and start the schedule; does nothing where that is done.

        Who asks while it is being opened for another waits for that, and is told what became of it. Afterwards the link
        keeps itself: a lost bus is closed at once and opened again with back-off.

        Raises:
            DeviceMissingError: the channel does not exist, is down, or cannot be opened.
        """
        before = self._not_opened
        async with self._opening:
            if self._tasks:
                return
            if self._not_opened is not None and self._not_opened is not before:
                raise self._not_opened
            try:
                await self._open_port()
            except DeviceError as error:
                self._not_opened = error
                raise
            self._tasks = [
                asyncio.create_task(self._schedule(), name="can-schedule"),
                asyncio.create_task(self._supervise(), name="can-supervisor"),
            ]

    async def close(self) -> None:
        """Every device told to hold, several times, then silent and closed; idempotent."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        for task in tasks:
            with contextlib.suppress(asyncio.CancelledError):
                await task
        for user in self._users.values():
            user.hold()
        if self._port is not None:
            for repeat in range(_CLOSE_REPEATS_N):
                if repeat:
                    await asyncio.sleep(0.01)
                for user in self._users.values():
                    self.send_control(user)
        self._drop_port()

    def attach(self, user: LinkUser) -> None:
        """Put a device on the schedule.

        Raises:
            DeviceError: another one has the same address.
        """
        if self._users.get(user.address, user) is not user:
            raise DeviceError(self.where, f"two devices are configured for address {user.address}", "Check address_n")
        self._users[user.address] = user
        self._feedback_pgns = frozenset(each.feedback_pgn for each in self._users.values())

    def detach(self, user: LinkUser) -> None:
        """Take a device off the schedule; its messages stop."""
        if self._users.get(user.address) is user:
            del self._users[user.address]
            self._feedback_pgns = frozenset(each.feedback_pgn for each in self._users.values())

    def tap(self, listener: Callable[[Frame, float], None]) -> Callable[[], None]:
        """Call ``listener`` with every frame received or sent; returns the call that ends it."""
        self._taps.frames.append(listener)
        return lambda: self._taps.frames.remove(listener)

    def tap_events(self, listener: Callable[[BusEvent, float], None]) -> Callable[[], None]:
        """Call ``listener`` with what the controller tells of the bus itself; returns the call that ends it."""
        self._taps.events.append(listener)
        return lambda: self._taps.events.remove(listener)

    def tap_messages(self, listener: Callable[[Message, float], None]) -> Callable[[], None]:
        """Call ``listener`` with every J1939 message, multi-packet ones included; returns the call that ends it."""
        self._taps.messages.append(listener)
        return lambda: self._taps.messages.remove(listener)

    # -- sending ----------------------------------------------------------------------------------------------------

    def send_control(self, user: LinkUser) -> bool:
        """Send one device's control message now; False where that is impossible."""
        frame = self._control(user)
        return frame is not None and self._send(frame)

    async def prove_stop(self, user: LinkUser) -> None:
        """Say now what a stop will say, and see it taken: what :meth:`arm` of a device on the bus asks for.

        The device's control message is the one that ends motion while it is in standby; the stop path sends no other,
        by no other way, and no limit of ours counts it. An adapter that refuses afterwards has 50 ms for it.

        Raises:
            DeviceRefusedError: we have no address, or it does not leave.
        """
        where = f"address {user.address} on {self.where}"
        before = self._untold_n()
        if self._node.address is None:
            raise DeviceRefusedError(where, "graderd has no J1939 address", "Wait, or look at the can faults")
        sent = self.send_control(user)
        if sent and self._port is not None and self._port.refuses_later:
            await asyncio.sleep(_REFUSED_WITHIN_S)
        if not sent or self._untold_n() != before or self._node.address is None or self._port is None:
            raise DeviceRefusedError(where, "a stop would not leave now", "Look at the can faults, then arm")

    def _untold_n(self) -> int:
        """Frames so far that the bus did not take."""
        return self.counters.tx_full_n + self.counters.refused_n + self.counters.lost_n

    def request(self, pgn: int, destination: int = 0xFF) -> None:
        """Ask for a parameter group; the answer comes through :meth:`tap_messages`."""
        self._node.request(pgn, destination, now_s=self._clock.now_s())
        self._flush()

    def publish_faults(self, faults: Iterable[DeviceFault], *, stopped: bool = False) -> None:
        """Send the daemon's faults as DM1: amber lamp with any fault, red stop lamp while ``stopped``."""
        dtcs = {dm1.dtc_of(fault.device, fault.condition) for fault in faults}
        self._node.publish(dtcs, red=stopped, now_s=self._clock.now_s())

    def _control(self, user: LinkUser) -> Frame | None:
        """A device's control message as it is now; None where nothing can be sent, or nothing may."""
        if self._port is None:
            return None
        now_s = self._clock.now_s()
        if self._node.address is not None:
            return user.control_frame(self._node.address, now_s)
        if now_s - self._unaddressed_since_s > _STOP_UNADDRESSED_S:
            return None
        return user.stop_frame(self._last_address, now_s)

    def _send_all_controls(self) -> None:
        for user in tuple(self._users.values()):
            self.send_control(user)

    def _follow_address(self, now_s: float) -> None:
        """An address lost: what moves is stopped now. One gained: what is owed goes out now, not a period later."""
        address = self._node.address
        if address == self._address:
            return
        self._address = address
        self._address_lost_at_s = None
        if address is None:
            self._unaddressed_since_s = self._address_lost_at_s = now_s
        else:
            self._last_address = address
        self._send_all_controls()

    def _send(self, frame: Frame) -> bool:
        if self._port is None:
            return False
        try:
            self._port.send(frame)
        except PortFullError as error:
            self.counters.tx_full_n += 1
            self._health.on_transmit_full(str(error), self._clock.now_s())
            return False
        except PortLostError as error:
            self._on_lost(error)
            return False
        self.counters.tx_n += 1
        self._own.on_sent(frame, self._clock.now_s())
        if self._taps.frames:
            now_s = self._clock.now_s()
            for tap in self._taps.frames:
                tap(frame, now_s)
        return True

    def _flush(self) -> None:
        for frame in self._node.take():
            self._send(frame)

    # -- receiving --------------------------------------------------------------------------------------------------

    def _on_readable(self) -> None:
        port = self._port
        if port is None:
            return
        try:
            items = port.read()
        except PortLostError as error:
            self._on_lost(error)
            return
        now_s = self._clock.now_s()
        for item in items:
            if isinstance(item, BusEvent):
                self._on_event(item, now_s)
            else:
                self._on_frame(item, now_s)
        self.counters.rx_n += len(items)
        self._health.on_traffic(len(items), now_s)
        if port.pending:
            asyncio.get_running_loop().call_soon(self._on_readable)
        if self._node.outbox:
            self._flush()

    def _on_event(self, event: BusEvent, now_s: float) -> None:
        was_off = self._health.is_off
        self._health.on_event(event, now_s)
        for listener in self._taps.events:
            listener(event, now_s)
        self.counters.refused_n += event is BusEvent.REFUSED
        if event is BusEvent.BUS_OFF:
            # Not when a tick has seen it: the controller may be back by then, and its first word has to end motion.
            for user in tuple(self._users.values()):
                user.hold()
        elif event is BusEvent.ERROR_ACTIVE or (was_off and not self._health.is_off):
            self._send_all_controls()  # what was said while nobody heard us

    def _on_frame(self, frame: Frame, now_s: float) -> None:
        if self._own.is_echo(frame, now_s):
            return
        for tap in self._taps.frames:
            tap(frame, now_s)
        if not frame.extended:
            return
        pgn = pgn_of(frame.can_id)
        if pgn in self._feedback_pgns and destination_of(frame.can_id) in (GLOBAL, self._node.address):
            source = source_of(frame.can_id)
            user = self._users.get(source)
            if user is not None and user.feedback_pgn == pgn:
                user.on_feedback(frame.data, now_s)
            else:
                self._unattached[pgn, source] = now_s
            return
        if pgn == Pgn.ADDRESS_CLAIMED:
            self._on_claim(frame, now_s)
        message = self._node.on_frame(frame, now_s)
        self._follow_address(now_s)
        if message is not None:
            self._stop.on_message(message, now_s)
            for listener in self._taps.messages:
                listener(message, now_s)

    def _on_claim(self, frame: Frame, now_s: float) -> None:
        user = self._users.get(source_of(frame.can_id))
        if user is not None and len(frame.data) == 8:
            solicited = now_s - self._node.claim_requested_at_s < 0.5
            user.on_claim(int.from_bytes(frame.data, "little"), solicited, now_s)

    # -- schedule and supervision -----------------------------------------------------------------------------------

    async def _schedule(self) -> None:
        """Every 20 ms protocol timers, every 100 ms on the same grid control messages; no catching up."""
        ticker = Ticker(_POLL_S, kernel=isinstance(self._clock, SystemClock), ahead_s=_AHEAD_S)
        per_control_n = round(CONTROL_PERIOD_S / _POLL_S)
        tick_n, sent_for_n = 0, -1
        try:
            while True:
                if tick_n // per_control_n != sent_for_n and self._port is not None:
                    sent_for_n = tick_n // per_control_n
                    frames = [frame for user in self._users.values() if (frame := self._control(user)) is not None]
                    ticker.meet()
                    self.counters.control_late_max_s = max(self.counters.control_late_max_s, ticker.late_s)
                    for frame in frames:
                        self._send(frame)
                now_s = self._clock.now_s()
                self._node.poll(now_s)
                self._follow_address(now_s)
                self._flush()
                tick_n += await ticker.wait()
        finally:
            ticker.close()

    async def _supervise(self) -> None:
        """Open the bus again whenever it was lost, for as long as the link lives."""
        while True:
            await self._lost.wait()
            backoff_s = _BACKOFF_FIRST_S
            while self._port is None:
                await asyncio.sleep(backoff_s)
                backoff_s = min(2 * backoff_s, _BACKOFF_MAX_S)
                try:
                    await self._open_port()
                    self.counters.reopened_n += 1
                    _log.info("%s: open again", self.where, extra=_FIELDS)
                except DeviceError as error:
                    _log.warning("%s: not open again: %s", self.where, error, extra=_FIELDS)
                    self._health.on_open_failed(error, self._clock.now_s())
                except Exception:  # a bug in here must not end the search for the bus
                    _log.exception("%s: opening failed in an unexpected way; will try again", self.where, extra=_FIELDS)

    async def _open_port(self) -> None:
        self._lost.clear()
        if self._factory is not None:
            port = self._factory()
        else:
            await asyncio.sleep(max(0.0, self._boots_until_s - self._clock.now_s()))
            port = await asyncio.to_thread(open_port, self.settings)
            try:
                await asyncio.to_thread(port.wait_ready, READY_S)
            except PortLostError as error:
                port.close()
                self._boots_until_s = self._clock.now_s() + READY_S  # opened once more it would only reset again
                raise DeviceLostError(self.where, error.detail) from error
        now_s = self._clock.now_s()
        self._port = port
        self._health.on_open()
        self._own = SelfReception()
        asyncio.get_running_loop().add_reader(port.fileno(), self._on_readable)
        self._node.start(now_s)
        self._address, self._address_lost_at_s, self._unaddressed_since_s = None, None, now_s
        self._send_all_controls()
        self._follow_address(now_s)
        self._flush()

    def _on_lost(self, error: PortLostError) -> None:
        now_s = self._clock.now_s()
        fields = {**_FIELDS, "fault": f"can.{error.condition}"}
        _log.warning("%s: lost (%s): %s", self.where, error.condition, error.detail, extra=fields)
        self.counters.lost_n += 1
        self._health.on_lost(error.condition, error.detail, now_s)
        self._drop_port()
        for user in tuple(self._users.values()):
            user.on_link_lost(now_s)
        self._lost.set()

    def _drop_port(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(ValueError, OSError):
                asyncio.get_running_loop().remove_reader(port.fileno())
            port.close()


def name_from(settings: CanSettings) -> Name:
    """Our NAME, field by field from the settings."""
    return Name(
        identity=settings.name_identity_n,
        manufacturer=settings.name_manufacturer_n,
        ecu_instance=settings.name_ecu_instance_n,
        function_instance=settings.name_function_instance_n,
        function=settings.name_function_n,
        vehicle_system=settings.name_vehicle_system_n,
        vehicle_system_instance=settings.name_vehicle_system_instance_n,
        industry_group=settings.name_industry_group_n,
        arbitrary_address_capable=int(settings.name_arbitrary_address),
    )


__all__ = ["CONTROL_PERIOD_S", "CanLink", "DeviceMissingError", "LinkCounters", "LinkUser", "name_from"]
