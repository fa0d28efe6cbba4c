"""Jogging from the command line: values, arrival, refusals, and what is left when the command dies."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.api.settings import ApiLimits
from graderd.cli.console import CliError
from graderd.cli.move import VALUE, Arrival, JogValue, parse_value
from graderd.core import commands as cmd
from graderd.core.axes import JOG_AXES, JogName
from graderd.core.machine import Mode
from graderd.core.status import FaultStatus
from harness.api_daemon import FakeDaemon, serving, within
from tests.unit.test_cli_modes import Capture, cli, command_line

pytestmark = pytest.mark.live


@pytest.mark.parametrize(
    ("axis", "text", "expected"),
    [
        ("rotate", "+5deg", JogValue(5.0, True)),
        ("rotate", "-5deg", JogValue(-5.0, True)),
        ("rotate", "30deg", JogValue(30.0, False)),
        ("rotate", "=30deg", JogValue(30.0, False)),
        ("rotate", "=-30deg", JogValue(-30.0, False)),
        ("rotate", "=+30.5°", JogValue(30.5, False)),
        ("lift", "+20mm", JogValue(20.0, True)),
        ("height", ".5 mm", JogValue(0.5, False)),
        ("pitch", "-1.25deg", JogValue(-1.25, True)),
    ],
)
def test_values(axis: JogName, text: str, expected: JogValue) -> None:
    assert parse_value(axis, text) == expected


@pytest.mark.parametrize(
    ("axis", "text", "says"),
    [
        ("rotate", "5mm", "its unit is deg, not mm"),
        ("lift", "+5deg", "its unit is mm, not deg"),
        ("lift", "5", "has no unit"),
        ("rotate", "deg", "is no value"),
        ("rotate", "", "is no value"),
        ("rotate", "nandeg", "is no value"),
        ("rotate", "infdeg", "is no value"),
        ("rotate", "--5deg", "is no value"),
        ("rotate", "1e3deg", "is no value"),
        ("rotate", "5 5deg", "is no value"),
        ("rotate", "9" * 400 + "deg", "is no value"),
    ],
)
def test_what_is_no_value(axis: JogName, text: str, says: str) -> None:
    with pytest.raises(CliError) as error:
        parse_value(axis, text)
    assert says in error.value.cause
    assert error.value.exit_code == 2


@given(st.sampled_from(list(JOG_AXES)), st.text(max_size=20) | st.from_regex(VALUE))
def test_whatever_is_typed_is_a_finite_value_or_bad_usage(axis: JogName, text: str) -> None:
    value: float | None
    try:
        value = parse_value(axis, text).value
    except CliError as error:
        value = None if error.exit_code == 2 else math.nan
    assert value is None or math.isfinite(value)


@pytest.mark.parametrize(
    ("axis", "value", "moved", "ends_at"),
    [
        ("rotate", "+5deg", "rotation", 5.0),
        ("rotate", "-5deg", "rotation", -5.0),
        ("rotate", "=-12deg", "rotation", -12.0),
        ("lift", "+20mm", "lift_right", 120.0),
        ("height", "40mm", "lift_left", 140.0),
        ("tilt", "60mm", "tilt", 60.0),
        ("pitch", "-3deg", "tilt", 40.0),
        ("slope", "2deg", "lift_left", 114.0),
    ],
)
async def test_a_jog_ends_on_arrival_and_gives_the_lease_back(
    tmp_path: Path, capsys: Capture, axis: str, value: str, moved: str, ends_at: float
) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        capsys.readouterr()
        assert await cli(path, "jog", axis, value, "--json") == 0
        result = json.loads(capsys.readouterr().out)
        assert result["arrived"] is True
        assert result["measured"][moved] == pytest.approx(ends_at, abs=0.01)
        assert daemon.positions[moved] == pytest.approx(ends_at)
        assert daemon.state.lease is None
        assert daemon.state.reason == "released"


@pytest.mark.parametrize(
    ("mode", "arguments", "says"),
    [
        (None, ["jog", "rotate", "+5deg"], "Arm first"),
        ("auto", ["jog", "rotate", "+5deg"], "Send manual first"),
        ("manual", ["jog", "rotate", "100deg"], "beyond the limit of +60.0 deg"),
        ("manual", ["preset", "moon"], "there is no preset 'moon'"),
    ],
)
async def test_refused_jogs_move_nothing(
    tmp_path: Path, capsys: Capture, mode: str | None, arguments: list[str], says: str
) -> None:
    async with serving(tmp_path) as (daemon, path):
        if mode is not None:
            assert await cli(path, "arm") == 0
            assert await cli(path, mode) == 0
        before = dict(daemon.positions)
        capsys.readouterr()
        assert await cli(path, *arguments) == 1
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1
        assert daemon.positions == before


def lifts(time_s: float, limited: float | None, *faults: str) -> dict[str, Any]:
    """What the stream says of two lifts on their way to 130 mm."""
    axis = {
        "unit": "mm",
        "limited_because": "",
        "measured": 110.0,
        "requested": 130.0,
        "limited": limited,
        "arrived": False,
        "moving": 0,
    }
    axes = {name: {"name": name, **axis} for name in ("lift_left", "lift_right")}
    present = [
        {"name": n, "present": True, "detail": "7.7 mm apart", "reads": "", "remedy": "level it"} for n in faults
    ]
    return {"time_s": time_s, "axes": axes, "faults": present}


def test_lifts_that_the_daemon_holds_for_a_fault_will_not_arrive() -> None:
    arrival = Arrival(("lift_left", "lift_right"))
    apart = "lift_left.sides_apart"
    # Side by side they are waited for: a fault of another axis, a short hold, a side that waits for the other.
    for second, status in enumerate(
        [lifts(1.0, None, "rotation.hot"), lifts(2.0, None, apart), lifts(2.9, None, apart), lifts(3.5, 120.0, apart)]
    ):
        arrival.update(status)
        assert arrival.held_by is None, second
    for time_s in (4.0, 4.6, 5.1):
        assert not arrival.update(lifts(time_s, None, apart))
    assert arrival.held_by is not None
    assert arrival.held_by["remedy"] == "level it"


async def test_a_jog_that_a_fault_holds_ends_and_says_why(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        apart = FaultStatus(
            name="lift_left.sides_apart", reads="the two lifts are apart", detail="lift_left does not move",
            remedy="level the blade", reaction="retreat", clears="auto", age_s=0.5, present=True,
        )  # fmt: skip
        daemon.held = {"lift_left": apart, "lift_right": apart}
        assert await cli(path, "jog", "height", "30mm") == 1
        said = capsys.readouterr().err
        assert "held on its way: lift_left does not move (lift_left 100.0 mm, lift_right 100.0 mm)" in said
        assert "evel the blade" in said
        await daemon.until(lambda: daemon.state.lease is None)


async def test_the_lease_is_kept_for_as_long_as_asked(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        daemon.seen.clear()
        assert await cli(path, "jog", "rotate", "+1deg", "--hold-s", "1") == 0
        assert 6 <= sum(command.command == "renew" for command in daemon.seen) <= 11
        assert "rotation 1.0 deg" in capsys.readouterr().out


async def test_a_preset_goes_through_its_stages(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        daemon.positions["rotation"] = 20.0
        assert await cli(path, "arm") == 0
        assert await cli(path, "preset") == 0
        assert "transport" in capsys.readouterr().out
        assert await cli(path, "preset", "transport") == 0
        assert daemon.positions["lift_left"] == pytest.approx(200.0)
        assert daemon.positions["rotation"] == pytest.approx(0.0)


async def test_a_second_client_is_refused_while_the_first_moves(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        daemon.hold_lease("somebody else")
        assert await cli(path, "jog", "rotate", "+5deg") == 1
        assert "somebody else is moving the blade" in capsys.readouterr().err


async def test_a_stop_ends_the_jog_and_the_command_says_why(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        jog = asyncio.create_task(cli(path, "jog", "rotate", "+50deg", "--hold-s", "20"), name="jog")
        await daemon.until(lambda: daemon.state.lease is not None)
        assert await cli(path, "stop", "--reason", "enough") == 0
        assert await within(10, jog) == 1
        said = capsys.readouterr().err
        assert "ended on the way: stopped, enough" in said


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
async def test_the_blade_holds_when_the_command_dies(tmp_path: Path, how: signal.Signals) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        process = await asyncio.create_subprocess_exec(
            *command_line(path, "jog", "rotate", "+30deg", "--hold-s", "50"), stdout=asyncio.subprocess.DEVNULL
        )
        await daemon.until(lambda: daemon.state.lease is not None, timeout_s=30)
        process.send_signal(how)
        await daemon.until(lambda: daemon.state.lease is None)
        stood = dict(daemon.positions)
        await process.wait()
        assert process.returncode == -how  # not 0: `graderd jog … && graderd jog …` must not go on
        assert daemon.status().mode is Mode.MANUAL
        assert daemon.state.reason == "released"
        assert daemon.positions == stood


@pytest.mark.parametrize(("line", "moved_n"), [("{jog} && {next}", 1), ("for i in 1 2 3; do {next}; done", 1)])
async def test_ctrl_c_ends_what_the_shell_would_do_next(tmp_path: Path, line: str, moved_n: int) -> None:
    """As a terminal sends it: to the shell and its command alike."""
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        jog = shlex.join(command_line(path, "jog", "rotate", "+30deg", "--hold-s", "50"))
        shell = await asyncio.create_subprocess_exec(
            *("bash", "-c", line.format(jog=jog, next=jog)), stdout=asyncio.subprocess.DEVNULL, start_new_session=True
        )
        await daemon.until(lambda: daemon.state.lease is not None, timeout_s=30)
        os.killpg(shell.pid, signal.SIGINT)
        await within(20, shell.wait())
        jogs_n = sum(isinstance(command, cmd.Jog) for command in daemon.seen)
        assert jogs_n == moved_n
        await daemon.until(lambda: daemon.state.lease is None)


@pytest.mark.parametrize("module", ["typer", "graderd.cli.app", "graderd.client", "websockets.sync.client"])
async def test_ctrl_c_during_the_start_ends_by_sigint_too(tmp_path: Path, module: str) -> None:
    """Interrupted in the import of ``module``."""
    code = f"""
import importlib.abc, os, signal, sys
class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
from graderd.cli import main
main(["--socket", {str(tmp_path / "api.sock")!r}, "jog", "rotate", "+30deg"])
"""
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        process = await asyncio.create_subprocess_exec(sys.executable, "-c", code, stderr=asyncio.subprocess.PIPE)
        _, said = await within(30, process.communicate())
        assert process.returncode == -signal.SIGINT, said
        assert b"Traceback" not in said
        assert not any(isinstance(command, cmd.Jog) for command in daemon.seen)


async def test_a_stalled_client_loses_its_lease(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        process = await asyncio.create_subprocess_exec(
            *command_line(path, "jog", "rotate", "+50deg", "--hold-s", "50"), stderr=asyncio.subprocess.PIPE
        )
        await daemon.until(lambda: daemon.state.lease is not None, timeout_s=30)
        process.send_signal(signal.SIGSTOP)
        await daemon.until(lambda: daemon.state.lease is None)
        assert "lapsed" in daemon.state.reason
        stood = dict(daemon.positions)
        process.send_signal(signal.SIGCONT)
        _, said = await within(10, process.communicate())
        assert process.returncode == 1
        assert b"lapsed" in said
        assert daemon.positions == stood


async def test_a_frozen_daemon_is_told(tmp_path: Path, capsys: Capture) -> None:
    daemon, limits = FakeDaemon(frozen=True), ApiLimits(command_timeout_s=0.3)
    async with serving(tmp_path, daemon, limits=limits) as (_, path):
        assert await cli(path, "jog", "rotate", "+5deg") == 1
        assert "the control tick did not answer" in capsys.readouterr().err


def test_numpy_computes_with_one_thread_in_each_process_that_the_command_line_starts() -> None:
    """Said before numpy is imported, so that this process hears it too; what somebody else said stays."""
    program = (
        "import os, subprocess, sys\nfrom graderd.cli import main\nassert 'numpy' not in sys.modules\n"
        "try:\n    main(['--help'])\nexcept SystemExit: pass\n"
        "sys.stderr.write(subprocess.check_output(['printenv', 'OPENBLAS_NUM_THREADS'], text=True))"
    )
    for said in ("", "3"):
        environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
        environment |= {"OPENBLAS_NUM_THREADS": said} if said else {}
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stderr.strip() == (said or "1")
