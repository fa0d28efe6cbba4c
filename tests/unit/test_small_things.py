"""What a new user meets first: how values may be written, what a refusal says, and how a command ends."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest

from graderd.cli.app import run_app
from graderd.cli.move import JogValue, parse_value
from graderd.cli.status import _number
from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core.axes import JogName, Pose
from graderd.core.commands import Jog
from graderd.core.motion import resolve
from harness.api_daemon import serving

GRADERD = [sys.executable, "-m", "graderd"]


@pytest.mark.parametrize(
    ("axis", "text", "value"),
    [
        ("rotate", "−5°", JogValue(-5.0, True)),
        ("rotate", "−5 deg", JogValue(-5.0, True)),
        ("rotate", "=−30deg", JogValue(-30.0, False)),
        ("lift", "−2.5mm", JogValue(-2.5, True)),
        ("rotate", "+5°", JogValue(5.0, True)),
    ],
)
def test_a_value_may_be_written_as_people_write_it(axis: JogName, text: str, value: JogValue) -> None:
    assert parse_value(axis, text) == value


@pytest.mark.parametrize(
    ("axis", "value", "says"),
    [
        ("rotate", 90.0, "rotate can go from -60.0 to 60.0 deg"),
        ("height", 500.0, "height can go from -95.0 to 195.0 mm"),
        ("lift", 500.0, "lift can go from 5.0 to 295.0 mm"),
        ("slope", 60.0, "slope can go from -13.4 to 13.4 deg"),
        ("pitch", 60.0, "pitch can go from -14.1 to 14.1 deg"),
        ("tilt", 200.0, "tilt can go from 3.0 to 97.0 mm"),
    ],
)
def test_a_refusal_names_what_was_asked_for_and_how_far_it_can_go(axis: JogName, value: float, says: str) -> None:
    settings = tick_settings(Config())
    pose = Pose(0.0, 100.0, 100.0, 50.0)
    given = (pose, settings.attitude, settings.presets, settings.figures)
    refused = resolve(Jog(axis=axis, value=value), *given)
    assert isinstance(refused, str)
    assert says in refused
    low, high = (float(word) for word in refused.split(" can go from ")[1].split()[0:3:2])
    for end in (low, high):
        # What it says is so: nearly there is taken, a bit beyond is not.
        inward = 0.06 if end < 0 or end == low else -0.06
        assert not isinstance(resolve(Jog(axis=axis, value=end + inward), *given), str)
        assert isinstance(resolve(Jog(axis=axis, value=end - 3 * inward), *given), str)


def test_there_is_no_minus_nought() -> None:
    assert _number(-0.04, "deg") == "0.0 deg"
    assert _number(-0.06, "deg") == "-0.1 deg"


@pytest.mark.live
@pytest.mark.parametrize("command", [["explain"], ["--help"], ["config", "show", "--json"]])
def test_a_full_or_closed_standard_output_ends_without_a_traceback(command: list[str], tmp_path: Path) -> None:
    # Not one byte may be written there; /dev/full is not everywhere for everybody.
    with (tmp_path / "full").open("w") as full:
        done = subprocess.run(
            ["sh", "-c", 'ulimit -f 0; exec "$@"', "sh", *GRADERD, *command],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "standard output: File too large" in done.stderr
    closed = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *GRADERD, *command], stderr=subprocess.PIPE, text=True, check=False
    )
    assert (closed.returncode, closed.stderr) == (0, "")
    reading, writing = os.pipe()
    os.close(reading)
    piped = subprocess.run([*GRADERD, *command], stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (piped.returncode, piped.stderr) == (1, "")


def test_a_report_that_cannot_be_written_is_told_before_the_blade_moves(tmp_path: Path) -> None:
    nowhere = ["--socket", str(tmp_path / "none.sock"), "rotation", "step", "--yes", "--report"]
    assert run_app([*nowhere, str(tmp_path / "missing" / "step.html")]) == 1


@pytest.mark.live
async def test_the_shell_completes_faults_and_the_poses_of_the_daemon(tmp_path: Path) -> None:
    def completed(line: str) -> list[str]:
        environment = {
            **os.environ,
            "_GRADERD_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(line.split())),
            "GRADERD_SOCKET": str(tmp_path / "api.sock"),
        }
        program = "import sys; sys.argv[0] = 'graderd'; from graderd.cli import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
        )
        return done.stdout.split()

    assert completed("graderd preset ") == []
    async with serving(tmp_path):
        assert await asyncio.to_thread(completed, "graderd preset ") == ["transport"]
    assert "camera.missing" in await asyncio.to_thread(completed, "graderd explain ")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["--version"]) == 0
    assert capsys.readouterr().out.startswith("graderd 0.")
