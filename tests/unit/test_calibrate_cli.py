"""``graderd calibrate camera``: shows, asks, writes atomically; cancelled it changes nothing."""

from __future__ import annotations

import base64
import errno
import json
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer

from graderd.cli import calibrate as command
from graderd.cli.app import run_app
from graderd.cli.calibrate import write_calibration
from graderd.cli.console import CliError
from graderd.config.loader import load
from graderd.core.blade import BladeGeometry
from graderd.perception import CameraCalibration
from graderd.perception.calibration import with_pose
from graderd.perception.frame_set import Entry, FrameSetWriter
from graderd.perception.settings import StreamCalibration
from harness.perception_scenes import Scene, render

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("calibrate cli")]  # one set of pictures for all

Captured = pytest.CaptureFixture[str]
COLOR, DEPTH = (480, 300), (424, 240)
CONFIG = '# mine\n[perception]\nmethod = "depth"  # on purpose\n\n[rotation]\nspeed_deg_per_s = 20.0\n'


def sized(calibration: CameraCalibration) -> CameraCalibration:
    streams = {
        name: StreamCalibration.from_pose(
            getattr(calibration, name).intrinsics().scaled(*size),
            getattr(calibration, name).pose(calibration.mounting),
            calibration.mounting,
        )
        for name, size in (("color", COLOR), ("depth", DEPTH))
    }
    return calibration.model_copy(update=streams)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of a camera 3 cm further ahead than the drawing says; the set's own camera data are the drawing's."""
    true = with_pose(CameraCalibration(), {"position_x_m": 0.83})
    folder = tmp_path_factory.mktemp("calibration") / "empty_blade"
    writer = FrameSetWriter(folder, sized(CameraCalibration()), BladeGeometry())
    for number, angle_deg in enumerate((-40.0, 0.0, 40.0)):
        scene = Scene(angle_deg=angle_deg, seed=number)
        writer.add(Entry(f"{number:03d}", None, angle_deg), render(scene, true, COLOR, DEPTH))
    return folder


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "graderd.toml"
    path.write_text(CONFIG)
    return path


def run(frames: Path, config: Path, *more: str) -> int:
    picture = config.parent / "shown.png"
    return run_app(
        ["calibrate", "camera", "--from", str(frames), "--config", str(config), "--save", str(picture), *more]
    )


def backups(config: Path) -> list[Path]:
    return sorted(config.parent.glob("graderd.toml.*.bak"))


def test_solved_shown_and_written(frames: Path, config: Path, capsys: Captured) -> None:
    assert run(frames, config, "--yes") == 0
    text = capsys.readouterr().out
    assert re.search(r"position_x_m +0\.8000 +0\.8[23]\d\d", text)
    assert re.search(r"fits to [\d.]+ mm", text)
    after = load(config)
    assert after.camera.calibration.color.position_x_m == pytest.approx(0.83, abs=0.004)
    assert after.camera.calibration.depth.position_x_m == pytest.approx(0.83, abs=0.004)
    assert after.camera.calibration.calibrated_at.endswith("from empty_blade")
    assert after.camera.calibration.residual_mm > 0
    assert after.perception.method == "depth"
    assert "# on purpose" in config.read_text()  # comments stay
    (backup,) = backups(config)
    assert backup.read_text() == CONFIG
    picture = cv2.imread(str(config.parent / "shown.png"))
    assert picture is not None
    assert picture.shape == (2 * COLOR[1], COLOR[0], 3)


def test_json(frames: Path, config: Path, capsys: Captured) -> None:
    assert run(frames, config, "--yes", "--json") == 0
    result, written = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert result["found"]["position_x_m"]["found"] == pytest.approx(0.83, abs=0.004)
    assert result["residual_mm"] > 0
    assert written["written"] == str(config)
    assert Path(written["backup"]).exists()


@pytest.mark.parametrize("answer", [False, None])
def test_cancelling_changes_nothing(
    frames: Path, config: Path, answer: bool | None, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    def asked(_question: str, default: bool) -> bool:
        assert default is False
        if answer is None:
            raise typer.Abort  # Ctrl-C, or the end of the input
        return answer

    monkeypatch.setattr(typer, "confirm", asked)
    assert run(frames, config) == 1
    assert "nothing was changed" in capsys.readouterr().err
    assert config.read_text() == CONFIG
    assert backups(config) == []


def test_a_pose_measured_by_hand(config: Path, capsys: Captured) -> None:
    arguments = ["calibrate", "camera", "--pose", "0.9,0.05,0.6,30,1,-1", "--config", str(config), "--yes"]
    assert run_app(arguments) == 0
    capsys.readouterr()
    calibration = load(config).camera.calibration
    assert (calibration.color.position_x_m, calibration.color.pitch_down_deg) == (0.9, 30.0)
    assert calibration.depth.pitch_down_deg == pytest.approx(30.0)
    assert calibration.depth.position_y_m == pytest.approx(0.05 - 0.059, abs=0.002)
    assert calibration.calibrated_at.endswith("by hand")
    assert len(backups(config)) == 1


@pytest.mark.parametrize("pose", ["", "1,2,3", "a,b,c,d,e,f", "0.8,0,0.5,95,0,0", "nan,0,0.5,30,0,0"])
def test_a_pose_that_is_none(config: Path, pose: str, capsys: Captured) -> None:
    assert run_app(["calibrate", "camera", "--pose", pose, "--config", str(config), "--yes"]) == 2
    assert "six numbers" in capsys.readouterr().err
    assert config.read_text() == CONFIG


def test_frames_that_give_no_calibration(config: Path, frames: Path, tmp_path: Path, capsys: Captured) -> None:
    assert run(tmp_path / "nowhere", config, "--yes") == 2
    assert "no such folder" in capsys.readouterr().err
    few = tmp_path / "few"
    few.mkdir()
    for path in frames.iterdir():
        (few / path.name).write_bytes(path.read_bytes())
    lines = (few / "manifest.csv").read_text().splitlines()
    (few / "manifest.csv").write_text("\n".join(lines[:3]) + "\n")
    assert run(few, config, "--yes") == 1
    assert "2 frames, at least 3 are needed" in capsys.readouterr().err
    assert config.read_text() == CONFIG


def test_json_wants_consent_beforehand(config: Path, frames: Path, capsys: Captured) -> None:
    assert run(frames, config, "--json") == 2
    assert "--yes" in capsys.readouterr().err


def test_the_daemon_turns_the_blade_only_with_consent(
    frames: Path, config: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    asked: list[dict[str, Any]] = []

    names = ["000.color.png"]

    class Daemon:
        def service(self, name: str, timeout_s: float, **arguments: Any) -> dict[str, Any]:
            assert name == "camera.calibration_file"
            return {"base64": base64.b64encode((frames / arguments["file"]).read_bytes()).decode()}

        def maneuver(self, name: str, timeout_s: float, **arguments: Any) -> dict[str, Any]:
            asked.append({"name": name, **arguments})
            return {"frame_set": "calibration-1", "files": names}

    monkeypatch.setattr(command, "client_of", lambda _context: Daemon())
    monkeypatch.setattr(typer, "confirm", lambda _question, **_options: False)
    live = ["calibrate", "camera", "--config", str(config), "--save", str(config.parent / "x.jpg")]
    assert run_app(live) == 1
    assert asked == []
    names[:] = ["../../etc/passwd"]
    assert run_app([*live, "--yes"]) == 1
    assert "the daemon names a file" in capsys.readouterr().err
    asked.clear()
    names[:] = [path.name for path in frames.iterdir()]
    assert run_app([*live, "--angles-deg", "-30,0,30", "--yes"]) == 0
    capsys.readouterr()
    assert load(config).camera.calibration.calibrated_at.endswith("from calibration-1")
    assert asked == [{"name": "camera.calibrate", "consent": True, "angles_deg": [-30.0, 0.0, 30.0]}]
    assert load(config).camera.calibration.color.position_x_m == pytest.approx(0.83, abs=0.004)


def test_a_configuration_that_cannot_be_written_stays(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(CONFIG)
    with pytest.raises(CliError):
        write_calibration(path, {"blade": {"length_m": -1.0}})
    assert path.read_text() == CONFIG
    with pytest.raises(CliError, match="cannot be written"):
        write_calibration(tmp_path / "no" / "such" / "folder.toml", {"blade": {"length_m": 1.1}})
    path.write_text("this is no TOML")
    with pytest.raises(CliError):
        write_calibration(path, {"blade": {"length_m": 1.1}})
    assert path.read_text() == "this is no TOML"


def test_a_new_configuration(tmp_path: Path) -> None:
    path = tmp_path / "new.toml"
    assert write_calibration(path, {"blade": {"length_m": np.float64(1.25).item()}}) is None
    assert tomllib.loads(path.read_text()) == {"blade": {"length_m": 1.25}}
    assert [p.name for p in tmp_path.iterdir()] == ["new.toml"]


@pytest.mark.parametrize("kept", ["configuration", "picture"])
def test_nothing_moves_where_the_result_could_not_be_kept(
    config: Path, kept: str, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    """Neither is the daemon asked for anything, nor the person."""
    monkeypatch.setattr(command, "client_of", lambda _context: pytest.fail("the daemon was asked"))
    picture = config.parent / ("nowhere" if kept == "picture" else "") / "shown.png"
    if kept == "configuration":
        monkeypatch.setattr(os, "fsync", refuse)
    live = ["calibrate", "camera", "--config", str(config), "--save", str(picture), "--yes"]
    assert run_app(live) == 1
    assert "cannot be written" in capsys.readouterr().err
    assert config.read_text() == CONFIG


def refuse(*_: object) -> None:
    raise PermissionError(errno.EACCES, "Permission denied")
