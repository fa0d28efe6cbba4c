"""What happens to the blade when the daemon ends, dies or loses the wire; and the guard's safe-off."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from graderd.drivers.dynamixel import safe_off
from graderd.drivers.dynamixel.arming import watchdog_counts
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceMissingError, DeviceTimeoutError
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from harness.awake_clock import AwakeClock
from tests.dynamixel_sim import TIMEOUT_S, bench, servo_process, until

# A daemon in miniature: arms, turns for ever, says when it is under way.
CLIENT = """
import asyncio, sys
from graderd.drivers.dynamixel import Ph54Rotator
from graderd.hal.settings import Ph54Settings
async def main():
    r = Ph54Rotator(Ph54Settings(port=sys.argv[1], speed_deg_per_s=16.7))
    await r.open()
    await r.arm()
    while True:
        r.set_goal_deg(55.0)
        await asyncio.sleep(0.02)
        if r.telemetry().velocity_deg_per_s.value > 15:
            print("moving", flush=True)
asyncio.run(main())
"""


@pytest.mark.whole_machine
@pytest.mark.xdist_group("a line")
@pytest.mark.parametrize("way", ["killed", "stopped", "unplugged"])
def test_from_loss_of_link_to_standstill_the_watchdog_bounds_it(
    tmp_path: Path, way: str, capsys: pytest.CaptureFixture[str]
) -> None:
    watchdog_s = Ph54Settings().watchdog_s
    with servo_process(tmp_path / "servo") as servo:
        client = subprocess.Popen([sys.executable, "-c", CLIENT, str(servo.link)], stdout=subprocess.PIPE, text=True)
        try:
            assert client.stdout is not None
            assert client.stdout.readline() == "moving\n"
            clock = AwakeClock()
            lost_s = clock.now_s()
            if way == "unplugged":
                servo.tell("unplug")
            else:
                os.kill(client.pid, signal.SIGKILL if way == "killed" else signal.SIGSTOP)
            still_s = tripped_s = None
            while still_s is None:
                status = servo.tell("status")["servos"][0]
                now_s = clock.now_s()
                assert now_s - lost_s < TIMEOUT_S
                if tripped_s is None and status["watchdog_tripped"]:
                    tripped_s = now_s - lost_s
                if abs(status["velocity_deg_per_s"]) < 0.5:
                    still_s = now_s - lost_s
                time.sleep(0.002)
        finally:
            client.kill()
            client.wait()
            if client.stdout is not None:
                client.stdout.close()
    assert tripped_s is not None
    assert still_s <= watchdog_s + 0.1  # of which 0.1 s for our own looking, on a busy machine
    with capsys.disabled():
        text = f"client {way}: watchdog tripped after {tripped_s * 1e3:.0f} ms, standstill after {still_s * 1e3:.0f} ms"
        sys.stdout.write(f"\n{text} (watchdog set to {watchdog_s * 1e3:.0f} ms)\n")


async def test_the_bound_from_the_last_packet_to_standstill_in_the_servos_own_time() -> None:
    """The same in simulated time, free of the machine's scheduling, from full speed: trip and braking fit in."""
    servo = VirtualServo()
    servo.advance(0.0)
    servo.write(556, (600).to_bytes(4, "little") + (500).to_bytes(4, "little") + (150_000).to_bytes(4, "little"))
    servo.write(546, bytes((watchdog_counts(Ph54Settings()),)))
    servo.write(512, b"\x01")
    servo.write(564, (150_000).to_bytes(4, "little"))
    now_s = 0.0
    while now_s < 1.0:
        now_s += 0.02
        servo.note_traffic(now_s)
        servo.advance(now_s)
    last_s = now_s
    assert servo.shaft_velocity_deg_per_s > 25.0
    while not servo.tripped:
        now_s += 0.001
        servo.advance(now_s)
    while abs(servo.shaft_velocity_deg_per_s) > 0.5:
        now_s += 0.001
        servo.advance(now_s)
    assert now_s - last_s <= Ph54Settings().watchdog_s == 0.2


@pytest.mark.parametrize(("at_exit", "torque_on"), [("off", False), ("on", True)])
async def test_close_in_mid_turn_leaves_torque_as_configured(tmp_path: Path, at_exit: str, torque_on: bool) -> None:
    async with bench(tmp_path, torque_at_exit=at_exit, torque_at_disarm="on") as rig:
        await rig.rotator.arm()
        await rig.drive(50.0, rig.past(17.0))
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        await rig.rotator.close()
        assert loop.time() - began_s < 2.0
        assert rig.servo.torque_enabled is torque_on
        await asyncio.sleep(0.4)
        assert abs(rig.servo.shaft_velocity_deg_per_s) < 0.5
        assert not rig.servo.tripped


async def test_disarm_with_torque_kept_holds_against_a_load(tmp_path: Path) -> None:
    async with bench(tmp_path, torque_at_disarm="on") as rig:
        await rig.rotator.arm()
        await rig.drive(20.0, rig.at(20.0))
        await rig.rotator.disarm()
        assert rig.rotator.lifecycle is Lifecycle.STANDBY
        assert rig.servo.torque_enabled
        rig.servo.load_torque_nm = 25.0
        await asyncio.sleep(1.5)
        assert rig.servo.shaft_deg == pytest.approx(20.0, abs=0.5)
        await rig.rotator.arm()
        rig.rotator.set_goal_deg(20.0)


@pytest.mark.parametrize("at_exit", ["off", "on"])
async def test_safe_off_after_the_daemon_died(tmp_path: Path, at_exit: str) -> None:
    servo = VirtualServo()
    servo.shaft_deg = 12.0
    wire = VirtualServoBus([servo], tmp_path / "servo")
    await wire.start()
    servo.write(512, b"\x01")
    servo.write(564, (0).to_bytes(4, "little"))
    settings = Ph54Settings(port=str(wire.link), torque_at_exit=at_exit)
    text = await asyncio.to_thread(safe_off, settings)
    assert "rotation" in text
    assert servo.torque_enabled is (at_exit == "on")
    await until(lambda: abs(servo.shaft_velocity_deg_per_s) < 0.5, "does not come to rest")
    await wire.close()


async def test_safe_off_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissingError):
        await asyncio.to_thread(safe_off, Ph54Settings(port=str(tmp_path / "none")))
    wire = VirtualServoBus([VirtualServo()], tmp_path / "servo")
    await wire.start()
    wire.inject("drop")
    with pytest.raises(DeviceTimeoutError, match="safe-off"):
        await asyncio.to_thread(safe_off, Ph54Settings(port=str(wire.link)))
    wire.clear_faults()
    wire.inject("flip", rate=0.3)
    await asyncio.to_thread(safe_off, Ph54Settings(port=str(wire.link)))
    await wire.close()


def test_the_virtual_servo_alone_takes_commands_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with servo_process(tmp_path / "servo", "--id", "5", "--shaft-deg", "30", "--fault", "drop:rate=0.5") as servo:
        assert "id 5, 57600 bit/s" in servo.hello
        assert servo.tell("status")["servos"][0]["shaft_deg"] == 30.0
        assert "drop" in servo.tell("help")["faults"]
        assert "no fault" in servo.tell("nonsense")["error"]
        assert "key=number" in servo.tell("drop rate")["error"]
        assert servo.tell("unplug")["link"] is None
        assert servo.tell("replug")["link"] == str(servo.link)
        assert json.dumps(servo.tell("load torque_nm=5"))
    assert not servo.link.exists()
    assert not servo.link.is_symlink()
    bad = subprocess.run(
        [sys.executable, "-m", "graderd.simulator.servo", "--link", str(tmp_path / "x"), "--baud", "1234"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert bad.returncode == 2
    assert "--baud 1234 is none of 9600" in bad.stderr
