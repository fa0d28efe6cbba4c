"""A rotator that graderd does not know: a hydraulic cylinder behind a proportional valve on the J1939 bus.

Everything it takes stands in this file: settings, driver, what the configuration names (``VALVE``), a virtual valve to
try it on, and the tests. No product file knows of it. ``docs/developers/add-a-device.md`` walks through it.

The valve obeys ISO 11783-7 "auxiliary valve command" (PGN 65072 + number: byte 1 port flow, 1 % a bit, offset -125 %;
byte 3 bits 1-4 valve state, 0 blocked, 1 extend, 2 retract). Its angle encoder sends PGN 65312 (proprietary B) every
50 ms: the angle at the blade, 0.01 degrees a bit, offset -180 degrees.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from graderd.config import ConfigError, parse
from graderd.core.status import Status
from graderd.drivers.backend import Parts, RotatorBackend
from graderd.drivers.j1939.can_port import BusPort, PortFullError, PortLostError, open_port
from graderd.drivers.j1939.ids import Frame, Pgn, make_id, pgn_of
from graderd.drivers.j1939.link import CanLink, name_from
from graderd.hal.clock import Clock
from graderd.hal.device import DeviceService, Lifecycle, NoArguments
from graderd.hal.errors import (
    CommandRangeError,
    DeviceLostError,
    DeviceTimeoutError,
    LifecycleError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.reading import Reading
from graderd.hal.rotator import Rotator, RotatorTelemetry
from graderd.hal.settings import CanSettings, Positive, RotatorSettings, Settings
from graderd.runtime.app.backends import check_plugins, rotator_of
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from harness.awake_clock import AwakeClock
from tests.contract.conformance import RotatorConformance, RotatorStand

NAME: Final = f"{__name__}:VALVE"
"""What the configuration says to get it."""

# -- messages -----------------------------------------------------------------------------------------------------

VALVE_COMMAND: Final = 0xFE30
ANGLE: Final = 0xFF20
BLOCKED: Final = 0


def command(valve_n: int, source: int, flow_percent: float) -> Frame:
    """The valve's command; no flow blocks both ports."""
    flow = round(flow_percent)
    state = BLOCKED if flow == 0 else 1 if flow > 0 else 2
    return Frame(make_id(3, VALVE_COMMAND + valve_n, source), bytes((flow + 125, 0xFF, 0xC0 | state, *[0xFF] * 5)))


def angle_message(address: int, angle_deg: float) -> Frame:
    """What the encoder sends."""
    raw = round((angle_deg + 180.0) * 100.0)
    return Frame(make_id(6, ANGLE, address), raw.to_bytes(2, "little") + b"\xff" * 6)


# -- settings -----------------------------------------------------------------------------------------------------


class ValveTable(Settings):
    """``[rotation.driver]``: what only this driver knows."""

    address_n: int = 128
    valve_n: int = 0
    flow_percent_per_deg: Positive = 12.0
    flow_max_percent: Positive = 60.0
    feedback_timeout_s: Positive = 0.3


class ValveSettings(RotatorSettings):
    """``[rotation]`` with this driver."""

    driver: ValveTable = ValveTable()


# -- driver -------------------------------------------------------------------------------------------------------


class ValveRotator:
    """See the module's text. One device on the shared CAN link (``graderd.drivers.j1939.link.LinkUser``)."""

    def __init__(self, settings: ValveSettings, link: CanLink, clock: Clock) -> None:
        self.address = settings.driver.address_n
        self.feedback_pgn = ANGLE
        self._settings, self._own = settings, settings.driver
        self._link = link
        self._clock = clock
        self._lifecycle = Lifecycle.CLOSED
        self._heard = asyncio.Event()
        self._heard_n = 0
        self._angle: Reading[float] | None = None
        self._velocity: Reading[float] | None = None
        self._goal: Reading[float] | None = None
        self._sent: Reading[float] | None = None
        self._flowing = False
        self._fault: DeviceFault | None = None

    @property
    def lifecycle(self) -> Lifecycle:
        self._watch()
        return self._lifecycle

    def telemetry(self) -> RotatorTelemetry:
        return RotatorTelemetry(
            angle_deg=self._angle,
            velocity_deg_per_s=self._velocity,
            goal_deg=self._goal.value if self._goal is not None else None,
            goal_sent_deg=self._sent,
            counters={"feedback_n": self._heard_n},
        )

    def faults(self) -> tuple[DeviceFault, ...]:
        self._watch()
        return () if self._fault is None else (self._fault,)

    async def open(self) -> None:
        self._require(Lifecycle.CLOSED)
        await self._link.open()
        self._heard.clear()
        self._fault = None
        self._link.attach(self)
        try:
            async with asyncio.timeout(2.0):
                await self._heard.wait()
        except TimeoutError:
            self._link.detach(self)
            raise DeviceTimeoutError("rotation", f"no angle from address {self.address}", "Check its supply") from None
        except BaseException:
            self._link.detach(self)
            raise
        self._lifecycle = Lifecycle.STANDBY

    async def arm(self) -> None:
        self._require(Lifecycle.STANDBY)
        await self._link.prove_stop(self)
        self._require(Lifecycle.STANDBY)  # still: that took a moment
        self._goal = None
        self._lifecycle = Lifecycle.ACTIVE

    def set_goal_deg(self, goal_deg: float) -> None:
        self._require(Lifecycle.ACTIVE)
        low, high = self._settings.min_deg, self._settings.max_deg
        if not (math.isfinite(goal_deg) and low <= goal_deg <= high):
            raise CommandRangeError("rotation", f"goal {goal_deg} deg is outside {low:g} to {high:g} deg")
        self._goal = Reading(goal_deg, self._clock.now_s())

    def hold(self) -> None:
        self._goal = None
        if self._flowing:
            self._link.send_control(self)  # now, not with the next period

    async def disarm(self) -> None:
        self.hold()
        if self._lifecycle is Lifecycle.ACTIVE:
            self._lifecycle = Lifecycle.STANDBY

    async def close(self) -> None:
        if self._lifecycle is Lifecycle.CLOSED:
            return
        self._goal = None
        for _ in range(3):
            self._link.send_control(self)
            await asyncio.sleep(0.01)
        self._link.detach(self)
        self._lifecycle, self._fault = Lifecycle.CLOSED, None

    # the link's side

    def control_frame(self, source: int, now_s: float) -> Frame:
        self._watch()
        flow = self._flow_percent(now_s)
        self._flowing = flow != 0.0
        return command(self._own.valve_n, source, flow)

    def stop_frame(self, source: int, now_s: float) -> Frame | None:
        flowed, self._flowing = self._flowing, False
        return command(self._own.valve_n, source, 0.0) if flowed else None

    def on_feedback(self, data: bytes, now_s: float) -> None:
        angle_deg = int.from_bytes(data[:2], "little") / 100.0 - 180.0
        if self._angle is not None and now_s > self._angle.time_s:
            speed = (angle_deg - self._angle.value) / (now_s - self._angle.time_s)
            self._velocity = Reading(speed, now_s)
        self._angle = Reading(angle_deg, now_s)
        self._heard_n += 1
        if self._link.address is not None:  # before that it is heard, and cannot be told anything
            self._heard.set()
        if self._lifecycle is Lifecycle.FAILED and self._link.address is not None:
            self._lifecycle, self._fault = Lifecycle.STANDBY, None

    def on_claim(self, name: int, solicited: bool, now_s: float) -> None: ...

    def on_link_lost(self, now_s: float) -> None:
        self._fail("unplugged", f"{self._link.where} is lost")

    # inside

    def _flow_percent(self, now_s: float) -> float:
        """Proportional to what is left of the way; none where it may not move or the goal was not renewed."""
        if self._goal is not None and now_s - self._goal.time_s > self._settings.goal_timeout_s:
            self._goal = None
        if self._lifecycle is not Lifecycle.ACTIVE or self._goal is None or self._angle is None:
            return 0.0
        self._sent = Reading(self._goal.value, now_s)
        wanted = self._own.flow_percent_per_deg * (self._goal.value - self._angle.value)
        return max(-self._own.flow_max_percent, min(self._own.flow_max_percent, wanted))

    def _watch(self) -> None:
        if self._lifecycle in (Lifecycle.STANDBY, Lifecycle.ACTIVE) and self._angle is not None:
            age_s = self._angle.age_s(self._clock.now_s())
            if age_s > self._own.feedback_timeout_s:
                self._fail("no_reply", f"no angle from address {self.address} for {age_s:.2f} s")

    def _fail(self, condition: str, detail: str) -> None:
        if self._lifecycle in (Lifecycle.STANDBY, Lifecycle.ACTIVE):
            self._lifecycle = Lifecycle.FAILED
            self._fault = DeviceFault("rotation", condition, detail, self._clock.now_s())
            self.hold()

    def _require(self, wanted: Lifecycle) -> None:
        if self.lifecycle is not wanted:
            raise LifecycleError("rotation", f"needs the state {wanted}, it is {self._lifecycle}")


# -- what the configuration names -----------------------------------------------------------------------------------


def _build(settings: ValveSettings, parts: Parts) -> ValveRotator:
    return ValveRotator(settings, parts.can, parts.clock)


def _safe_off(settings: ValveSettings, can: CanSettings) -> str:
    port = open_port(can)
    try:
        port.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, can.source_address_n), name_from(can).to_bytes()))
        for _ in range(4):
            port.send(command(settings.driver.valve_n, can.source_address_n, 0.0))
            time.sleep(0.02)
    except PortLostError as error:
        raise DeviceLostError(f"CAN {can.channel}", error.detail, "Shut the hydraulic supply") from error
    finally:
        port.close()
    return "valve blocked"


def _services(rotator: ValveRotator) -> Mapping[str, DeviceService]:
    async def feedback(_: NoArguments) -> dict[str, Any]:
        return {"feedback_n": rotator.telemetry().counters["feedback_n"]}

    return {"feedback": DeviceService(feedback, only_reads=True)}


VALVE = RotatorBackend(ValveSettings, _build, _safe_off, _services)


# -- the virtual valve ----------------------------------------------------------------------------------------------


class VirtualValve:
    """Valve, cylinder and encoder on the virtual wire. A command older than 0.3 s blocks it, as the standard asks."""

    def __init__(self, bus: VirtualActuatorBus, clock: Clock, angle_deg: float) -> None:
        self.angle_deg = angle_deg
        self.powered = True
        self.flow_percent = 0
        self.commands_n = 0
        self._bus = bus
        self._clock = clock
        self._told_s = -math.inf

    def hear(self, frame: Frame) -> None:
        if self.powered and frame.extended and pgn_of(frame.can_id) == VALVE_COMMAND:
            self.flow_percent = frame.data[0] - 125 if frame.data[2] & 0xF != BLOCKED else 0
            self._told_s = self._clock.now_s()
            self.commands_n += 1

    async def run(self) -> None:
        was_s = said_s = self._clock.now_s()
        while True:
            await asyncio.sleep(0.005)
            now_s = self._clock.now_s()
            dt_s, was_s = now_s - was_s, now_s
            if not self.powered or now_s - self._told_s > 0.3:
                self.flow_percent = 0
            self.angle_deg += 0.4 * self.flow_percent * dt_s
            if self.powered and now_s - said_s >= 0.05:
                said_s = now_s
                self._bus.send(angle_message(128, self.angle_deg))


# -- tests ------------------------------------------------------------------------------------------------------------


class ValveStand(RotatorStand):
    """The driver on a wire of its own process."""

    low, high, reached, still = -45.0, 45.0, 0.6, 0.2

    def __init__(self) -> None:
        self.clock = AwakeClock()
        self.bus = VirtualActuatorBus([], clock=self.clock)
        self.valve = VirtualValve(self.bus, self.clock, -12.0)
        self.link = CanLink(
            CanSettings(interface="virtual"), self.clock, bus_factory=lambda: BusPort(self.bus.connect())
        )
        section = parse({"rotation": {"backend": NAME, "min_deg": self.low, "max_deg": self.high}}).rotation
        backend, settings = rotator_of(section)
        self._rotator: Rotator = backend.build(settings, Parts(self.clock, self.link))

    @property
    def device(self) -> Rotator:
        return self._rotator

    def true_position(self) -> float:
        return self.valve.angle_deg

    def mute(self) -> None:
        port = self.link._port
        assert port is not None

        def refuse(frame: Frame) -> None:
            raise PortFullError(f"no buffer space for {frame.can_id:X}")

        self._send = port.send
        port.send = refuse  # type: ignore[method-assign]

    def unmute(self) -> None:
        port = self.link._port
        assert port is not None
        port.send = self._send  # type: ignore[method-assign]

    async def lose_wire(self) -> None:
        self.valve.powered = False

    async def restore_wire(self) -> None:
        self.valve.powered = True


class TestValveRotator(RotatorConformance):
    """The conformance class, as it is."""

    @pytest.fixture
    async def stand(self) -> AsyncIterator[ValveStand]:
        made = ValveStand()
        await made.bus.start()
        made.bus.listen(made.valve.hear)
        moving = asyncio.create_task(made.valve.run(), name="valve")
        yield made
        await made.device.close()
        await made.link.close()
        moving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await moving
        await made.bus.close()

    async def test_a_lost_bus_is_told_apart_from_a_silent_valve(self, stand: ValveStand) -> None:
        await stand.device.open()
        stand.bus.unplug()
        await stand.until(lambda: stand.device.lifecycle is Lifecycle.FAILED)
        assert [fault.condition for fault in stand.device.faults()] == ["unplugged"]
        await stand.until(lambda: stand.device.lifecycle is Lifecycle.STANDBY)


@pytest.mark.parametrize(
    ("section", "problem"),
    [
        ({"driver": {"adress_n": 3}}, "rotation.driver.adress_n: unknown key. Did you mean rotation.driver.address_n?"),
        ({"driver": {"flow_max_percent": -1}}, "rotation.driver.flow_max_percent: Input should be greater than 0"),
        ({"port": "/dev/ttyUSB0"}, "rotation.port: unknown key"),
        ({"backend": "nowhere.at.all:VALVE"}, "rotation.backend: nowhere.at.all:VALVE cannot be loaded"),
        ({"backend": f"{__name__}:BLOCKED"}, "is a int, not a RotatorBackend"),
        ({"backend": "graderd.drivers.dynamixel.backend:PH54"}, "is graderd's own"),
        ({"backend": "ph45"}, "rotation.backend: no such driver; there is ph54. Did you mean ph54?"),
    ],
)
def test_its_settings_are_checked_as_strictly_as_ours(section: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_plugins(parse({"rotation": {"backend": NAME, **section}}))
    assert problem in str(raised.value)


def test_config_check_asks_the_driver_too(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(f'[rotation]\nbackend = "{NAME}"\n[rotation.driver]\nadress_n = 3\n', encoding="utf-8")
    told = subprocess.run(
        [sys.executable, "-m", "graderd", "config", "check", str(path)], capture_output=True, text=True
    )
    assert told.returncode == 2
    assert "Did you mean rotation.driver.address_n?" in told.stderr


CONFIG: Final = """\
[api]
socket = "{directory}/graderd.sock"
[rotation]
backend = "{name}"
[rotation.driver]
flow_max_percent = 50
[can]
interface = "slcan"
channel = "{directory}/can"
[state]
directory = "{directory}/state"
"""


@pytest.mark.whole_machine
@pytest.mark.timeout(120)
async def test_the_daemon_drives_it_and_the_guard_blocks_it(tmp_path: Path) -> None:
    """A whole daemon with the valve in the servo's place; killed under way, the guard ends the motion."""
    clock = AwakeClock()
    units = [VirtualElectrak("electrak_md_a050" if a == 27 else "electrak_hd_b017", a, 50.0) for a in (19, 20, 27)]
    bus = VirtualActuatorBus(units, link=tmp_path / "can", clock=clock)
    valve = VirtualValve(bus, clock, -12.0)
    await bus.start()
    bus.listen(valve.hear)
    moving = asyncio.create_task(valve.run(), name="valve")
    config = tmp_path / "graderd.toml"
    config.write_text(CONFIG.format(directory=tmp_path, name=NAME), encoding="utf-8")
    daemon = await asyncio.create_subprocess_exec(sys.executable, "-m", "graderd", "run", "--config", str(config))
    transport = httpx.AsyncHTTPTransport(uds=str(tmp_path / "graderd.sock"))
    try:
        async with httpx.AsyncClient(transport=transport, base_url="http://graderd", timeout=10.0) as client:

            async def ask(name: str, **fields: Any) -> None:
                answer = await client.post("/v1/commands", json={"command": name, "client": "test", **fields})
                assert answer.status_code == 200, answer.text

            async def status() -> Status:
                while True:
                    with contextlib.suppress(httpx.TransportError):
                        return Status.model_validate((await client.get("/v1/status")).json())
                    assert daemon.returncode is None
                    await asyncio.sleep(0.05)

            async with asyncio.timeout(60):
                while not all(need.met for need in (await status()).readiness if need.mandatory):
                    await asyncio.sleep(0.05)
                assert (await status()).axes["rotation"].measured == pytest.approx(-12.0, abs=0.1)
                await ask("arm")
                while (await status()).mode != "manual":
                    await asyncio.sleep(0.05)
                await ask("jog", axis="rotate", value=10.0)
                while valve.angle_deg < -5.0:
                    await ask("renew")
                    await asyncio.sleep(0.05)
            assert (await client.post("/v1/services/rotation.feedback")).json()["feedback_n"] > 0
            refused = await client.post("/v1/services/rotation.reboot", json={"consent": True})
            assert refused.status_code == 409
            assert "there is no service" in refused.text
        daemon.kill()
        await daemon.wait()
        commands_n = valve.commands_n
        guard = await asyncio.create_subprocess_exec(sys.executable, "-m", "graderd", "guard", "--config", str(config))
        assert await guard.wait() == 0
        assert valve.commands_n >= commands_n + 4
        assert valve.flow_percent == 0
    finally:
        if daemon.returncode is None:
            daemon.kill()
            await daemon.wait()
        moving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await moving
        await bus.close()
