"""What the driver puts on the wire, and in which order; profile verification; calibration on a real servo's bytes."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from pathlib import Path

import pytest

from graderd.drivers.dynamixel import Ph54Rotator, ServoBus
from graderd.drivers.dynamixel.codec import Instruction, Packet, StatusError, StreamDecoder
from graderd.drivers.dynamixel.device import Ph54Device
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceError, DeviceTimeoutError
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from harness.awake_clock import AwakeClock
from tests.dynamixel_sim import bench, until

TABLE = ControlTable.load("ph54_200_s500")
PROFILE = TABLE["profile_acceleration"].address
GOAL = TABLE["goal_position"].address


class Tap:
    """Everything the driver sends, decoded, with its time."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, Packet]] = []
        self._decoder = StreamDecoder()

    def __call__(self, time_s: float, direction: str, data: bytes) -> None:
        if direction == "tx":
            self.sent += [(time_s, packet) for packet in self._decoder.feed(data)]

    def writes(self, start: int = 0) -> list[tuple[int, bytes]]:
        return [
            (int.from_bytes(p.params[:2], "little"), p.params[2:])
            for _, p in self.sent[start:]
            if p.instruction == Instruction.WRITE
        ]


async def tapped(tmp_path: Path, servo: VirtualServo, **changes: float) -> tuple[Tap, Ph54Rotator, VirtualServoBus]:
    clock = AwakeClock()
    wire = VirtualServoBus([servo], tmp_path / "servo", clock=clock)
    await wire.start()
    tap = Tap()
    rotator = Ph54Rotator(Ph54Settings(**{"port": str(tmp_path / "servo"), **changes}), clock=clock)
    rotator.tap(tap)
    await rotator.open()
    return tap, rotator, wire


async def test_opening_writes_nothing_but_the_status_return_level(tmp_path: Path) -> None:
    tap, rotator, wire = await tapped(tmp_path, VirtualServo())
    await asyncio.sleep(0.3)
    await rotator.close()
    await wire.close()
    assert tap.writes() == [(TABLE["status_return_level"].address, b"\x02")]


async def test_a_tap_hears_every_connection_until_it_ends(tmp_path: Path) -> None:
    tap, rotator, wire = await tapped(tmp_path, VirtualServo())
    await wire.unplug()
    await until(lambda: rotator.lifecycle is Lifecycle.FAILED, "not failed")
    before_n = len(tap.sent)
    await wire.replug()
    await until(lambda: len(tap.sent) > before_n, "nothing of the new connection")
    second = Tap()
    end = rotator.tap(second)
    await until(lambda: second.sent, "nothing heard")
    end()
    heard_n, before_n = len(second.sent), len(tap.sent)
    await until(lambda: len(tap.sent) > before_n + 3, "the first hears no more")
    assert len(second.sent) == heard_n
    await rotator.close()
    await wire.close()


async def test_hold_is_the_very_next_packet(tmp_path: Path) -> None:
    tap, rotator, wire = await tapped(tmp_path, VirtualServo(), goal_timeout_s=1.0)
    wire.inject("delay", seconds=0.004)  # so that there is usually a request in flight
    await rotator.arm()
    for i in range(12):
        rotator.set_goal_deg(20.0 if i % 2 else -20.0)
        await asyncio.sleep(0.05 + i * 0.0017)
        before_n = len(tap.sent)
        rotator.hold()
        await until(lambda n=before_n: tap.writes(n), "nothing was written")  # type: ignore[misc]
        address, data = tap.writes(before_n)[0]
        assert tap.sent[before_n][1].instruction in (Instruction.WRITE, Instruction.PING)  # a ping only after a loss
        assert (address, len(data)) == (PROFILE, 12)
    await rotator.close()
    await wire.close()


async def test_goals_are_sent_once_and_the_profile_only_after_a_hold(tmp_path: Path) -> None:
    tap, rotator, wire = await tapped(tmp_path, VirtualServo(), goal_timeout_s=1.0)
    await rotator.arm()
    start = len(tap.sent)
    for _ in range(10):
        rotator.set_goal_deg(5.0)
        await asyncio.sleep(0.02)
    await until(lambda: tap.writes(start), "no goal")
    counts = rotator.calibration.counts(5.0).to_bytes(4, "little", signed=True)
    assert set(tap.writes(start)) == {(GOAL, counts)}
    assert len(tap.writes(start)) <= 2  # two only where a reply was lost on a busy machine
    rotator.hold()
    await until(lambda: tap.writes(start)[-1][0] == PROFILE, "no hold")
    held = int.from_bytes(tap.writes(start)[-1][1][:4], "little")
    rotator.set_goal_deg(6.0)
    goal_again = rotator.calibration.counts(6.0).to_bytes(4, "little", signed=True)
    await until(lambda: tap.writes(start)[-1][1].endswith(goal_again), "no goal after the hold")
    assert tap.writes(start)[-1][0] == PROFILE
    assert held == 10 * int.from_bytes(tap.writes(start)[-1][1][:4], "little") == 5000
    await rotator.close()
    await wire.close()


async def test_eeprom_is_written_at_the_first_arm_only(tmp_path: Path) -> None:
    tap, rotator, wire = await tapped(tmp_path, VirtualServo())
    await rotator.arm()
    first = [a for a, _ in tap.writes() if a < 512]
    assert {TABLE[n].address for n in ("current_limit", "min_position_limit", "max_position_limit")} == set(first)
    await rotator.disarm()
    again = len(tap.sent)
    await rotator.arm()
    assert [a for a, _ in tap.writes(again) if a < 512] == []
    await rotator.close()
    await wire.close()


async def test_arming_sets_the_goal_before_the_torque_and_reads_everything_back(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.shaft_deg = -33.0
    servo.memory["goal_position"] = 100_000  # stale: would be a jump
    tap, rotator, wire = await tapped(tmp_path, servo)
    start = len(tap.sent)
    await rotator.arm()
    order = [a for a, _ in tap.writes(start)]
    torque = TABLE["torque_enable"].address
    assert order.index(TABLE["goal_current"].address) < order.index(TABLE["bus_watchdog"].address) < order.index(torque)
    reads = [int.from_bytes(p.params[:2], "little") for _, p in tap.sent[start:] if p.instruction == Instruction.READ]
    assert reads.count(TABLE["bus_watchdog"].address) >= 3
    assert torque in reads
    await asyncio.sleep(0.3)
    assert servo.shaft_deg == pytest.approx(-33.0, abs=0.1)
    await rotator.close()
    await wire.close()


@pytest.mark.parametrize("register", ["profile_velocity", "bus_watchdog", "max_position_limit", "torque_enable"])
async def test_what_does_not_read_back_ends_the_arming_without_torque(
    tmp_path: Path, register: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    servo = VirtualServo()
    commit, written = servo.memory.commit, servo._written
    monkeypatch.setattr(servo.memory, "commit", lambda ch: commit([c for c in ch if c[0].name != register]))
    if register == "torque_enable":
        monkeypatch.setattr(servo, "_written", lambda r, v: None if r.name == register else written(r, v))
    async with bench(tmp_path, servo) as rig:
        with pytest.raises(DeviceError):
            await rig.rotator.arm()
        assert rig.rotator.lifecycle is Lifecycle.STANDBY
        assert not servo.torque_enabled


async def test_a_disarm_that_could_not_be_finished_is_finished_when_the_wire_is_back(tmp_path: Path) -> None:
    async with bench(tmp_path, reply_timeout_s=1.5) as rig:
        await rig.rotator.arm()
        rig.bus.inject("drop_requests")
        with pytest.raises(DeviceTimeoutError):
            await rig.rotator.disarm()
        rig.bus.clear_faults()
        await rig.until(lambda: not rig.servo.torque_enabled)
        assert rig.rotator.lifecycle is Lifecycle.STANDBY


async def test_sign_zero_and_gear_ratio_reach_the_shaft(tmp_path: Path) -> None:
    servo = VirtualServo()
    async with bench(tmp_path, servo, sign=-1, zero_deg=10.0, gear_ratio=2.0) as rig:
        assert rig.at(-10.0)()
        await rig.rotator.arm()
        await rig.drive(20.0, rig.at(20.0, 0.1))
        assert servo.shaft_deg == pytest.approx(-60.0, abs=0.4)
        telemetry = rig.rotator.telemetry()
        assert telemetry.torque_nm is not None
        assert telemetry.current_a is not None
        assert telemetry.torque_nm.value == pytest.approx(telemetry.current_a.value * 4.806 * 2.0)


async def test_a_factory_fresh_servo_shows_no_difference(tmp_path: Path) -> None:
    async with bench(tmp_path) as rig:
        assert await rig.rotator.verify_profile() == []


async def test_every_difference_is_listed_in_every_kind(tmp_path: Path) -> None:
    servo = VirtualServo()
    async with bench(tmp_path, servo) as rig:
        servo.memory["temperature_limit"] = 70
        servo.memory["secondary_id"] = 9
        servo.memory["velocity_p_gain"] = 40_000
        servo.memory["shutdown"] = 58  # the other documented factory value: no difference
        found = {d.register: d for d in await rig.rotator.verify_profile()}
        assert {name: d.kind for name, d in found.items()} == {
            "temperature_limit": "default",
            "secondary_id": "expected",
            "velocity_p_gain": "range",
        }
        assert "70" in found["temperature_limit"].text
        await rig.rotator.arm()
        assert servo.memory["current_limit"] == 9300
        await rig.rotator.close()
        again = {d.register for d in await rig.rotator.verify_profile()}  # closed: the wire is taken for this alone
        assert again == found.keys()  # what arming wrote is no difference
        assert rig.rotator.port is None


async def test_a_register_the_servo_does_not_know_is_a_difference(tmp_path: Path) -> None:
    servo = VirtualServo()
    missing = servo.table["backup_ready"]
    del servo.table._by_address[missing.address]
    wire = VirtualServoBus([servo], tmp_path / "servo")
    await wire.start()
    bus = ServoBus(str(tmp_path / "servo"), 57_600)
    bus.open()
    (difference,) = await Ph54Device(bus, TABLE, 1).verify(3, {})
    assert (difference.register, difference.kind, difference.device) == ("backup_ready", "refused", None)
    assert StatusError.ACCESS.name.lower() in difference.text
    bus.close()
    await wire.close()


async def test_telemetry_comes_at_the_poll_rate(tmp_path: Path) -> None:
    async with bench(tmp_path, poll_hz=50.0) as rig:
        await rig.rotator.arm()
        times_s = []
        for i in range(50):
            rig.rotator.set_goal_deg(i * 0.1)
            angle = (await rig.rotator.wait_telemetry()).angle_deg
            assert angle is not None
            times_s.append(angle.time_s)
        gaps_s = sorted(b - a for a, b in pairwise(times_s))
        assert gaps_s[len(gaps_s) // 2] == pytest.approx(0.02, abs=0.003)
