"""How the machine drives, as the rig's wheels tell it and as a control unit on the actuators' bus tells it."""

from __future__ import annotations

import asyncio
import json
import tomllib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.config import Config, parse
from graderd.drivers.j1939.link import CanLink
from graderd.drivers.j1939.transport import Message
from graderd.drivers.j1939.vehicle import J1939Vehicle, wheel_speed_m_per_s
from graderd.drivers.simulated.vehicle import SimulatedVehicle
from graderd.hal.clock import SystemClock
from graderd.hal.settings import CanSettings, VehicleSettings
from graderd.hal.vehicle import VehicleTelemetry
from graderd.runtime.app.sim import RIG_FRAME_AGE_S, RIG_STREAMS, attach
from graderd.simulator.control_client import RigControl
from graderd.simulator.operator import CONFIG as PATIENT
from graderd.simulator.process import Rig
from harness.electrak_sim import until
from tests.rig_process import rig_here

READY_S = 30.0
CCVS = 0xFEF1


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[tuple[Rig, RigControl]]:
    async with rig_here(tmp_path / "rig") as rig:
        yield rig


def ccvs(raw: int) -> bytes:
    """CCVS1 with this wheel-based speed in bits of 1/256 km/h; all else not available."""
    return b"\xff" + raw.to_bytes(2, "little") + b"\xff" * 5


def told(telemetry: VehicleTelemetry) -> tuple[float, float]:
    assert telemetry.speed_m_per_s is not None
    assert telemetry.travelled_m is not None
    return telemetry.speed_m_per_s.value, telemetry.travelled_m.value


async def test_the_rigs_vehicle_tells_speed_and_distance(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    vehicle = SimulatedVehicle(str(machine.paths.control), SystemClock())
    assert vehicle.telemetry() == VehicleTelemetry()
    await vehicle.open()
    try:
        await until(lambda: vehicle.telemetry().speed_m_per_s is not None)
        assert told(vehicle.telemetry()) == (0.0, 0.0)
        await control.drive(0.5, 0.6)
        await until(lambda: told(vehicle.telemetry())[0] > 0.45)
        await until(lambda: told(vehicle.telemetry())[1] > 0.59 and told(vehicle.telemetry())[0] == 0.0)
        await control.request("reset_vehicle")  # lifted back: no wheel turns
        await control.drive(-0.5, 0.2)
        await until(lambda: told(vehicle.telemetry())[0] < -0.3)
        await until(lambda: told(vehicle.telemetry())[0] == 0.0)
        assert told(vehicle.telemetry())[1] == pytest.approx(0.4, abs=0.01)
    finally:
        await vehicle.close()
    await vehicle.close()


async def test_a_rig_that_comes_later_or_goes_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    vehicle = SimulatedVehicle(str(path), SystemClock())
    answers = [b"nonsense\n", b'{"error": "busy"}\n', b'{"ok": true, "speed_m_per_s": 0.25, "travelled_m": 1.5}\n']
    asked: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append(await reader.readline())
        writer.write(answers.pop(0))
        await writer.drain()
        writer.close()

    await vehicle.open()
    server = await asyncio.start_unix_server(serve, str(path))
    try:
        await until(lambda: vehicle.telemetry().speed_m_per_s is not None)
        assert told(vehicle.telemetry()) == (0.25, 1.5)
        assert [json.loads(line) for line in asked] == [{"cmd": "vehicle"}] * 3
    finally:
        await vehicle.close()
        server.close()


async def test_wheel_speed_on_the_actuators_bus(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    link = CanLink(CanSettings(interface="slcan", channel=str(machine.paths.can)))
    vehicle = J1939Vehicle(VehicleSettings(source="j1939"), link)
    await link.open()
    await vehicle.open()
    try:
        for _ in range(4):
            await control.request("can_frame", can_id=0x18000000 | CCVS << 8 | 0x00, data_hex=ccvs(461).hex())
            await asyncio.sleep(0.02)
        await until(lambda: vehicle.telemetry().speed_m_per_s is not None)
        speed, travelled_m = told(vehicle.telemetry())
        assert speed == pytest.approx(0.5, abs=0.001)
        assert 0.0 < travelled_m < 0.5
    finally:
        await vehicle.close()
        await link.close()


@pytest.mark.parametrize(
    ("data", "speed"),
    [
        (ccvs(0), 0.0),
        (ccvs(256), 1.0 / 3.6),
        (ccvs(0xFAFF), 250.996 / 3.6),
        (ccvs(0xFB00), None),
        (ccvs(0xFE00), None),
        (ccvs(0xFFFF), None),
        (b"\xff\x00", None),
        (b"", None),
    ],
)
def test_the_speed_in_a_message(data: bytes, speed: float | None) -> None:
    assert wheel_speed_m_per_s(data) == (None if speed is None else pytest.approx(speed, abs=1e-3))


class Bus:
    """A link that only hands messages on."""

    where = "a bus"

    def __init__(self) -> None:
        self.listeners: list[object] = []

    def tap_messages(self, listener: object) -> object:
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def say(self, raw: int, now_s: float, source: int = 0, pgn: int = CCVS) -> None:
        for listener in self.listeners:
            listener(Message(pgn, source, 0xFF, ccvs(raw)), now_s)  # type: ignore[operator]


async def heard(address_n: int | None = None) -> tuple[Bus, J1939Vehicle]:
    bus = Bus()
    vehicle = J1939Vehicle(VehicleSettings(source="j1939", address_n=address_n), bus)  # type: ignore[arg-type]
    await vehicle.open()
    return bus, vehicle


ONE_M_PER_S = round(3.6 * 256)


async def test_distance_is_added_up_and_starts_anew_after_a_gap() -> None:
    bus, vehicle = await heard()
    for number in range(11):
        bus.say(ONE_M_PER_S, 10.0 + 0.1 * number)
    assert told(vehicle.telemetry()) == pytest.approx((1.0, 1.0), abs=0.01)
    bus.say(ONE_M_PER_S, 11.6)
    assert told(vehicle.telemetry())[1] == 0.0


async def test_a_speed_that_is_not_available_is_not_valid() -> None:
    bus, vehicle = await heard()
    bus.say(ONE_M_PER_S, 10.0)
    bus.say(0xFFFF, 10.1)
    telemetry = vehicle.telemetry()
    assert telemetry.speed_m_per_s is not None
    assert telemetry.travelled_m is not None
    assert not telemetry.speed_m_per_s.is_fresh(10.1, 1.0)
    assert not telemetry.travelled_m.is_fresh(10.1, 1.0)


async def test_one_sender_is_believed_at_a_time() -> None:
    bus, vehicle = await heard()
    bus.say(ONE_M_PER_S, 10.0, source=0)
    bus.say(2 * ONE_M_PER_S, 10.05, source=3)
    bus.say(2 * ONE_M_PER_S, 10.06, pgn=0xFEF2)
    assert told(vehicle.telemetry())[0] == pytest.approx(1.0, abs=0.01)
    bus.say(2 * ONE_M_PER_S, 10.7, source=3)  # the first is silent
    assert told(vehicle.telemetry())[0] == pytest.approx(2.0, abs=0.01)
    bus, vehicle = await heard(address_n=3)
    bus.say(ONE_M_PER_S, 10.0, source=0)
    assert vehicle.telemetry() == VehicleTelemetry()
    await vehicle.close()
    assert bus.listeners == []


def test_a_daemon_with_a_rig_hears_the_rigs_wheels_unless_told_otherwise(tmp_path: Path) -> None:
    names = {"servo": "s", "can": {"interface": "slcan", "channel": "c"}, "camera": "p", "control": "k"}
    (tmp_path / "rig.json").write_text(json.dumps({"pid": 1, "stop_input": "t", **names}))
    assert attach(Config(), tmp_path).vehicle == VehicleSettings(source="simulated", path="k")
    on_bus = Config(vehicle=VehicleSettings(source="j1939", address_n=3))
    assert attach(on_bus, tmp_path).vehicle == on_bus.vehicle


def test_a_rig_renders_no_more_than_it_can_in_time_and_less_where_less_is_asked_for(tmp_path: Path) -> None:
    names = {"servo": "s", "can": {"interface": "slcan", "channel": "c"}, "camera": "p", "control": "k"}
    (tmp_path / "rig.json").write_text(json.dumps({"pid": 1, "stop_input": "t", **names}))
    most = attach(Config(), tmp_path).camera
    assert {name: getattr(most, name) for name in RIG_STREAMS} == RIG_STREAMS
    less = {"color_width_px": 320, "color_height_px": 200, "depth_width_px": 0, "depth_height_px": 0, "rate_hz": 5.0}
    asked = attach(parse({"camera": less}), tmp_path).camera
    assert {name: getattr(asked, name) for name in less} == less


def test_a_rigs_picture_may_be_older_and_older_still_where_the_configuration_says_so(tmp_path: Path) -> None:
    """Rendering takes a while; the demonstration, beside others on a busy machine, gives it a second."""
    names = {"servo": "s", "can": {"interface": "slcan", "channel": "c"}, "camera": "p", "control": "k"}
    (tmp_path / "rig.json").write_text(json.dumps({"pid": 1, "stop_input": "t", **names}))
    patient = parse(tomllib.loads(PATIENT.format(socket=tmp_path / "s")))
    for config, most_s in ((Config(), RIG_FRAME_AGE_S), (patient, 1.0)):
        assert attach(config, tmp_path).perception.decision.max_frame_age_s == most_s
