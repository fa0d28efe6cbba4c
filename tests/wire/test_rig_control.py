"""The rig's control socket: what it does when asked properly, and that nonsense changes nothing."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from graderd.hal.errors import DeviceLostError, DeviceMissingError, DeviceRefusedError
from graderd.simulator.control_client import RigControl, rig_request
from graderd.simulator.process import Rig
from harness.electrak_sim import until
from tests.rig_process import rig_here

READY_S = 30.0


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[tuple[Rig, RigControl]]:
    async with rig_here(tmp_path / "rig") as rig:
        yield rig


async def state_when(control: RigControl, key: str, value: object) -> dict[str, Any]:
    """The rig's state once ``key`` has ``value``."""
    async with asyncio.timeout(10.0):
        while True:
            state = await control.state()
            if state[key] == value:
                return state
            await asyncio.sleep(0.02)


async def steps(machine: Rig, count: int = 3) -> None:
    """Wait until the rig's world was moved on so many times more."""
    seen_n, step = 0, machine.machine.step

    def counted(step_s: float) -> None:
        nonlocal seen_n
        step(step_s)
        seen_n += 1

    machine.machine.step = counted  # type: ignore[method-assign]
    try:
        await until(lambda: seen_n >= count)
    finally:
        del machine.machine.step  # the class's own is found again


NONSENSE = (
    b"\n",
    b"hello\n",
    b"[]\n",
    b"{}\n",
    b'{"cmd": 7}\n',
    b'{"cmd": "explode"}\n',
    b'{"cmd": "scene"}\n',
    b'{"cmd": "scene", "zone": "up"}\n',
    b'{"cmd": "scene", "zone": "left", "seed": -1}\n',
    b'{"cmd": "scene", "zone": "left", "sede": 1}\n',
    b'{"cmd": "drive", "speed_m_per_s": 99, "distance_m": 1}\n',
    b'{"cmd": "drive", "speed_m_per_s": 0, "distance_m": 1}\n',
    b'{"cmd": "drive", "speed_m_per_s": NaN, "distance_m": 1}\n',
    b'{"cmd": "drive", "speed_m_per_s": 1, "distance_m": -1}\n',
    b'{"cmd": "drive", "speed_m_per_s": "fast", "distance_m": 1}\n',
    b'{"cmd": "place", "x_m": 0.3, "y_m": 5}\n',
    b'{"cmd": "place", "x_m": 7.9, "y_m": 0}\n',
    b'{"cmd": "place", "x_m": 0.3, "y_m": 0, "height_m": 3}\n',
    b'{"cmd": "light", "soil": "gold"}\n',
    b'{"cmd": "light", "exposure": -1}\n',
    b'{"cmd": "light", "sun_elevation_deg": 1e400}\n',
    b'{"cmd": "camera_fault", "name": "haunted"}\n',
    b'{"cmd": "camera_fault", "name": "knocked", "params": {"speed": 1}}\n',
    b'{"cmd": "camera_fault", "name": "knocked", "params": {"x_m": 1e9}}\n',
    b'{"cmd": "camera_fault", "name": "blurred", "params": {"sigma_px": 0}}\n',
    b'{"cmd": "camera_fault", "name": "blocked", "params": {"share": NaN}}\n',
    b'{"cmd": "servo_fault", "name": "haunted"}\n',
    b'{"cmd": "servo_fault", "name": "drop", "params": {"colour": 1}}\n',
    b'{"cmd": "actuator_fault", "name": "haunted"}\n',
    b'{"cmd": "actuator_fault", "name": "stuck", "device": "steering"}\n',
    b'{"cmd": "actuator_fault", "name": "stuck", "params": {"address": 19}}\n',
    b'{"cmd": "clear_faults", "part": "everything"}\n',
    b'{"cmd": "topview", "path": ""}\n',
    b'{"cmd": "topview", "path": "/nowhere/at/all/view.png"}\n',
    b'{"cmd": "topdepth", "path": "/nowhere/at/all/view.png"}\n',
    b'{"cmd": "state", "please": true}\n',
    b"\xff\xfe\x00\n",
)


async def test_rig_answers_nonsense_with_one_line_and_does_nothing(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    await control.scene("left", seed=2)
    before = await control.state()
    reader, writer = await asyncio.open_unix_connection(str(machine.paths.control))
    for line in NONSENSE:
        writer.write(line)
        async with asyncio.timeout(5.0):
            answer = json.loads(await reader.readline())
        assert set(answer) == {"error"}, line
        assert answer["error"], line
        assert "\n" not in answer["error"]
    writer.close()
    await writer.wait_closed()
    after = await control.state()
    known = await control.request("faults")
    assert known["present"] == {"camera": {}, "servo": {}, "actuators": {}}
    for key in ("blade_deg", "vehicle_x_m", "speed_m_per_s", "driving", "lift_left_mm", "tilt_mm"):
        assert after[key] == before[key], key
    assert after["soil_mass_kg"] == pytest.approx(before["soil_mass_kg"], rel=1e-12)


async def test_rig_hangs_up_on_a_line_without_end(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    reader, writer = await asyncio.open_unix_connection(str(machine.paths.control))
    writer.write(b"x" * 200_000)
    async with asyncio.timeout(5.0):
        assert "error" in json.loads(await reader.readline())
        assert await reader.read() == b""
    writer.close()
    assert (await control.state())["ok"]


async def test_rig_scene_drive_and_views(rig: tuple[Rig, RigControl], tmp_path: Path) -> None:
    machine, control = rig
    volumes = {}
    for zone in ("left", "center", "right", "even", "none"):
        await control.scene(zone, seed=5)
        await steps(machine)
        state = await control.state()
        volumes[zone] = [state["vol_left_l"], state["vol_center_l"], state["vol_right_l"]]
    for index, zone in enumerate(("left", "center", "right")):
        assert volumes[zone][index] > 8.0
        assert volumes[zone][index] > 0.7 * sum(volumes[zone])
    assert max(volumes["even"]) < 0.4 * sum(volumes["even"])
    assert sum(volumes["none"]) == 0.0

    await control.scene("center", seed=5)
    mass_kg = (await control.state())["soil_mass_kg"]
    answer = await control.drive(1.0, 0.5)
    assert answer["distance_m"] == pytest.approx(0.5)
    state = await state_when(control, "driving", False)
    assert state["vehicle_x_m"] == pytest.approx(1.7, abs=0.002)
    assert state["soil_mass_kg"] == pytest.approx(mass_kg, rel=1e-9)
    assert (await control.drive(1.0, 8.0))["distance_m"] == pytest.approx(5.3, abs=0.01)  # as far as the bed goes
    await control.halt()
    state = await state_when(control, "driving", False)
    assert state["vehicle_x_m"] < 2.5
    await control.request("reset_vehicle")
    assert (await control.state())["vehicle_x_m"] == pytest.approx(1.2)

    await control.request("topview", path=str(tmp_path / "view.png"))
    answer = await control.request("topdepth", path=str(tmp_path / "depth.png"))
    view = cv2.imread(str(tmp_path / "view.png"))
    depth = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert view is not None
    assert depth is not None
    assert depth.dtype == np.uint16
    assert depth.shape == (400, 100)
    soil_m3 = float((answer["camera_height_m"] - depth / 1000.0).sum()) * answer["pixel_m"] ** 2
    assert soil_m3 * 1600.0 == pytest.approx(mass_kg, rel=0.02)


async def test_rig_place_pours_more_soil_where_it_is_told(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    await control.request("place", x_m=0.3, y_m=-0.33, length_m=0.3, width_m=0.25, height_m=0.15)
    await steps(machine)
    first = await control.state()
    assert first["vol_right_l"] > 2.0
    assert first["vol_left_l"] < 0.1
    await control.request("place", x_m=0.3, y_m=0.33, length_m=0.3, width_m=0.25, height_m=0.15)
    second = await control.state()
    assert second["soil_mass_kg"] > first["soil_mass_kg"] + 3.0


async def test_rig_forwards_faults_and_clears_them(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    known = (await control.request("faults"))["known"]
    assert {"drop", "jam", "unplug", "power_cut"} <= set(known["servo"])
    assert {"silence", "stuck", "bus_off", "unplug"} <= set(known["actuators"])
    assert {"freeze", "black", "blown_out", "blocked", "blurred", "torn", "knocked"} <= set(known["camera"])
    await control.request("servo_fault", name="unplug")
    assert not machine.paths.servo.is_symlink()
    await control.request("actuator_fault", name="unplug")
    assert not machine.paths.can.is_symlink()
    await control.request("actuator_fault", name="stuck", device="lift_right")
    assert [unit.faults.stuck for unit in (machine.machine.lift_left, machine.machine.lift_right)] == [False, True]
    await control.request("servo_fault", name="push", params={"torque_nm": 33.0})
    await steps(machine)
    assert machine.machine.servo.load_torque_nm == 33.0  # the soil's load does not overwrite the fault
    await control.request("clear_faults")
    await steps(machine)
    assert machine.paths.servo.is_symlink()
    assert machine.paths.can.is_symlink()
    assert [unit.faults.stuck for unit in (machine.machine.lift_left, machine.machine.lift_right)] == [False, False]
    assert machine.machine.servo.load_torque_nm == 0.0


async def test_rig_lifts_carry_the_blade_and_feel_its_weight(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    machine.machine.lift_left.position_mm, machine.machine.lift_right.position_mm, machine.machine.tilt.position_mm = (
        160.0,
        140.0,
        60.0,
    )
    await steps(machine)
    state = await control.state()
    assert state["blade_height_mm"] == pytest.approx(50.0)
    assert state["blade_slope_deg"] == pytest.approx(1.43, abs=0.01)
    assert state["blade_pitch_deg"] == pytest.approx(3.0)
    assert machine.machine.lift_left.load_n == pytest.approx(150.0)


async def test_rig_light_changes_what_is_named_and_keeps_the_rest(rig: tuple[Rig, RigControl]) -> None:
    _, control = rig
    light = (await control.request("light", soil="sand", red_cast=0.2))["light"]
    assert light["soil"] == "sand"
    light = (await control.request("light", wetness=0.9))["light"]
    assert (light["soil"], light["red_cast"], light["wetness"]) == ("sand", 0.2, 0.9)


async def test_rig_quit_ends_it_and_clears_its_folder(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    await control.quit()
    async with asyncio.timeout(5.0):
        while any(machine.paths.directory.iterdir()):
            await asyncio.sleep(0.02)
    with pytest.raises(DeviceMissingError, match="no rig answers"):
        await control.state()


async def test_rig_sync_client(rig: tuple[Rig, RigControl]) -> None:
    machine, _ = rig
    state = await asyncio.to_thread(rig_request, machine.paths.control, "state")
    assert state["blade_deg"] == 0.0
    with pytest.raises(DeviceRefusedError, match="zone"):
        await asyncio.to_thread(rig_request, machine.paths.control, "scene", zone="up")


async def test_rig_clients_say_when_there_is_no_rig(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissingError, match="no rig answers"):
        rig_request(tmp_path / "control.sock", "state")
    with pytest.raises(DeviceMissingError, match="no rig answers"):
        await RigControl(tmp_path / "control.sock").state()


async def test_rig_client_notices_a_rig_that_hangs_up(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.close()

    server = await asyncio.start_unix_server(hang_up, str(path))
    async with server:
        with pytest.raises(DeviceLostError, match="hung up"):
            await RigControl(path).state()


async def test_rig_says_why_it_cannot_start(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("not a folder")
    with pytest.raises(DeviceMissingError, match="cannot be used as the rig's folder"):
        await Rig(blocker / "rig").run()
    with pytest.raises(DeviceMissingError, match="vcan"):
        await Rig(tmp_path / "rig", can_channel="socketcan:graderd-none").run()
    assert not (tmp_path / "rig" / "rig.json").exists()
