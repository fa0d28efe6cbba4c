"""The calibration's pictures leave nothing behind: fetched, replaced, or left by a daemon that was killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from graderd.hal.errors import CommandRangeError
from graderd.runtime.app.services import CalibrationFrames


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    return tmp_path


def fill(frames: CalibrationFrames) -> Path:
    folder = frames.begin()
    for name in ("camera.json", "000.color.png"):
        (folder / name).write_text(name)
    return folder


def test_each_file_goes_when_it_was_fetched_and_the_folder_with_the_last(state: Path) -> None:
    frames = CalibrationFrames()
    folder = fill(frames)
    assert folder.parent == state
    assert frames.names() == ["000.color.png", "camera.json"]
    assert frames.take("camera.json") == b"camera.json"
    assert frames.names() == ["000.color.png"]
    with pytest.raises(CommandRangeError, match=r"no file 'camera.json' waits"):
        frames.take("camera.json")
    frames.take("000.color.png")
    assert list(state.iterdir()) == []


def test_there_is_one_set_at_most(state: Path) -> None:
    frames = CalibrationFrames()
    former, folder = fill(frames), fill(frames)
    assert list(state.iterdir()) == [folder] != [former]
    frames.discard()
    frames.discard()
    assert list(state.iterdir()) == []


def test_what_a_killed_daemon_left_goes_and_nothing_else(state: Path) -> None:
    (state / "calibration-abc").mkdir()
    (state / "calibration-abc" / "000.color.png").write_text("old")
    (state / "last_stop.json").write_text("{}")
    CalibrationFrames()
    assert [path.name for path in state.iterdir()] == ["last_stop.json"]


@pytest.mark.parametrize("name", ["../last_stop.json", "/etc/passwd", "", ".", ".."])
def test_no_other_file_is_given(state: Path, name: str) -> None:
    (state / "last_stop.json").write_text("{}")
    frames = CalibrationFrames()
    fill(frames)
    with pytest.raises(CommandRangeError):
        frames.take(name)
    frames.discard()
    with pytest.raises(CommandRangeError):
        frames.take("camera.json")


@pytest.mark.live
def test_it_goes_with_the_daemon(state: Path) -> None:
    code = "from graderd.runtime.app.services import CalibrationFrames as F; print(F().begin().is_dir())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert list(state.iterdir()) == []
