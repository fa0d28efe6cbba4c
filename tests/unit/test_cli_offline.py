"""Commands that need no daemon: help, explain, config, hand-overs, consent."""

from __future__ import annotations

import importlib.util
import json
import logging
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from graderd.cli.app import make_cli, run_app
from graderd.core.faults.catalogue import CATALOGUE
from harness.api_daemon import serving
from tests.unit.test_cli_modes import Capture, cli


def leaf_commands() -> list[list[str]]:
    """The words of every command that does something."""

    def walk(group: Any, words: list[str]) -> list[list[str]]:
        found: list[list[str]] = []
        for name, command in group.commands.items():
            below = [*words, name]
            found += walk(command, below) if hasattr(command, "commands") else [below]
        return found

    return walk(get_command(make_cli()), [])


@pytest.mark.parametrize("words", leaf_commands(), ids=" ".join)
def test_every_command_has_help_with_an_example_and_json(words: list[str]) -> None:
    result = CliRunner().invoke(make_cli(), [*words, "--help"])
    assert result.exit_code == 0
    assert "Example" in result.output
    assert f"graderd {' '.join(words)}" in " ".join(result.output.split())
    # `rig` and `can dump` hand over to programs that know --json themselves or announce themselves as JSON.
    # `can database` writes a file in another tool's format; `calibrate lifts`, `calibrate rotation` and `setup` are
    # talks with a person, and `watch` is a screen.
    talks = (["calibrate", "lifts"], ["calibrate", "rotation"], ["setup"], ["watch"])
    told_otherwise = words in (["can", "database"], *talks)
    assert told_otherwise or "--json" in result.output or "JSON" in result.output


def test_the_manual_page_names_every_command() -> None:
    """By its first word; and each of those that a group has, where the page lists any of them."""
    page = (Path(__file__).parents[2] / "packaging" / "graderd.1").read_text(encoding="utf-8")
    items = [line.removeprefix(".It").split() for line in page.splitlines() if line.startswith(".It Cm ")]
    named = {word: item for item in items for mark, word in pairwise(item) if mark == "Cm"}
    for words in leaf_commands():
        assert words[0] in named, f"{words[0]} is not in the manual page"
        listed = named[words[0]] if "|" in named[words[0]] and len(words) > 1 else words
        assert words[-1] in listed, f"{' '.join(words)} is not in the manual page"


def test_all_commands_of_the_issue_are_there() -> None:
    assert {" ".join(words) for words in leaf_commands()} >= {
        *("run", "demo", "rig", "guard", "status", "arm", "disarm", "stop", "reset", "auto", "manual", "jog"),
        *("preset", "explain", "config check", "config show", "rotation reboot", "rotation step", "rotation dump"),
        *("profile verify", "can dump", "classify", "calibrate camera"),
    }


def test_explain_prints_everything_about_a_fault(capsys: Capture) -> None:
    row = CATALOGUE["actuator.overload"]
    assert run_app(["explain", "tilt.overload"]) == 0
    out = capsys.readouterr().out
    for text in (row.reads, row.cause, row.remedy, row.reaction.name.lower(), str(row.clear)):
        assert text in out
    assert run_app(["explain", "tilt.overload", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["faults"]
    assert told["reaction"] == row.reaction.name.lower()
    assert told["remedy"] == row.remedy


def test_explain_lists_all_and_suggests_the_nearest(capsys: Capture) -> None:
    assert run_app(["explain"]) == 0
    out = capsys.readouterr().out
    assert all(key in out for key in CATALOGUE)
    assert run_app(["explain", "lift_left.overlod"]) == 1
    assert "Did you mean lift_left.overload?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[tilt]\nprofile = "electrak_xx"\n', "electrak_xx"),
        ('[rotation]\nprofile = "ph45"\n', "no firmware profile 'ph45'"),
        (f'[api]\nsocket = "/run/{"x" * 120}"\n', "api.socket"),
        ('[api]\nsocket = ""\n', "api.socket"),
        ('[api]\nsocket_group = "no such group"\n', "api.socket_group"),
        ("[camera]\nrate_hz = -1\n", "camera.rate_hz"),
    ],
)
@pytest.mark.live
def test_check_refuses_what_run_refuses_and_run_before_anything_starts(
    tmp_path: Path, text: str, says: str, capsys: Capture
) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(text)
    assert run_app(["config", "check", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert says in said
    run = [sys.executable, "-m", "graderd", "run", "--sim", "--config", str(path)]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr


def test_config_check_tells_each_mistake_in_a_line(tmp_path: Path, capsys: Capture) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text("[rotation]\nmax_deg = 60.0\n")
    bad.write_text('[rotation]\nmax_dg = 45.0\n[machine]\nlease_s = "soon"\n')
    assert run_app(["config", "check", str(good)]) == 0
    assert "valid" in capsys.readouterr().out
    assert run_app(["config", "check", str(bad)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 2
    assert "Did you mean rotation.max_deg?" in said.err
    assert all(line.startswith("graderd: ") for line in said.err.splitlines())
    assert run_app(["config", "check", str(bad), "--json"]) == 2
    assert len(json.loads(capsys.readouterr().out)["problems"]) == 2
    assert run_app(["config", "check", str(tmp_path / "none.toml")]) == 2
    assert "none.toml" in capsys.readouterr().err


def test_config_show_prints_a_file_that_is_valid_again(tmp_path: Path, capsys: Capture) -> None:
    given, shown = tmp_path / "given.toml", tmp_path / "shown.toml"
    given.write_text("[machine]\nlease_s = 0.25\n")
    assert run_app(["config", "show", str(given)]) == 0
    shown.write_text(capsys.readouterr().out)
    assert "lease_s = 0.25" in shown.read_text()
    assert run_app(["config", "check", str(shown)]) == 0
    capsys.readouterr()
    assert run_app(["config", "show", str(given), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["machine"]["lease_s"] == 0.25


@pytest.mark.parametrize(
    ("arguments", "module", "handed"),
    [
        (["rig", "--dir", "d", "--seed", "1"], "graderd.simulator", ["--dir", "d", "--seed", "1"]),
        (["rig", "dataset", "--out", "x"], "graderd.simulator.dataset", ["--out", "x"]),
        (["rig", "--", "--help"], "graderd.simulator", ["--help"]),
        (["rig", "dataset", "--help"], "graderd.simulator.dataset", ["--help"]),
        (["rig", "dataset", "--", "--help"], "graderd.simulator.dataset", ["--help"]),
        (["can", "dump", "can0", "--json"], "graderd.drivers.electrak.dump", ["can0", "--json"]),
        (["can", "database", "--kcd"], "graderd.runtime.app.can_database", ["--kcd"]),
        (["can", "dump", "--", "--help"], "graderd.drivers.electrak.dump", ["--help"]),
        (["rotation", "dump", "x.log", "--json"], "graderd.drivers.dynamixel.dump", ["x.log", "--json"]),
        (["demo", "--json"], "graderd.simulator.demo", ["--json"]),
    ],
)
def test_hand_overs(monkeypatch: pytest.MonkeyPatch, arguments: list[str], module: str, handed: list[str]) -> None:
    became: list[list[str]] = []
    monkeypatch.setattr("graderd.cli.console.os.execv", lambda _, argv: became.append(argv))
    assert run_app(arguments) == 0
    assert became == [[sys.executable, "-P", "-m", module, *handed]]


@pytest.mark.live
def test_no_driver_is_imported_to_start_its_program() -> None:
    """The contract of the command line holds at run time too."""
    code = (
        "import os, sys; os.execv = print; from graderd.cli.app import run_app; "
        "run_app(['can', 'dump', '--', '--help']); "
        "print([name for name in sys.modules if name.startswith(('graderd.drivers.', 'graderd.runtime'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_program_that_is_not_installed_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture, tmp_path: Path
) -> None:
    monkeypatch.setattr("graderd.cli.console._PACKAGE", tmp_path)
    assert run_app(["rig"]) == 1
    assert "does not contain it" in capsys.readouterr().err


def test_run_and_guard_give_the_daemons_exit_status(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    calls: list[tuple[Any, ...]] = []

    def fake(name: str, status: int) -> Any:
        def called(*arguments: Any) -> int:
            calls.append((name, *arguments))
            return status

        return called

    monkeypatch.delenv("GRADERD_SOCKET", raising=False)
    monkeypatch.setattr("graderd.runtime.app.run_daemon", fake("daemon", 1))
    monkeypatch.setattr("graderd.runtime.app.run_guard", fake("guard", 1))
    assert run_app(["run", "--config", "c.toml", "--rig-dir", "r", "--json"]) == 1
    assert run_app(["run", "--sim", "--log-level", "error"]) == 1
    assert run_app(["guard", "--config", "c.toml", "--json"]) == 1
    assert calls == [
        ("daemon", Path("c.toml"), False, Path("r"), True, logging.INFO, None),
        ("daemon", None, True, None, False, logging.ERROR, None),
        ("guard", Path("c.toml")),
    ]
    assert json.loads(capsys.readouterr().out) == {"safe": False}
    assert run_app(["run", "--sim", "--rig-dir", "r"]) == 2
    assert run_app(["run", "--log-level", "all"]) == 2
    assert "'debug', 'info', 'warning', 'error'" in capsys.readouterr().err


@pytest.mark.live
async def test_services_of_the_servo_want_consent(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (_, path):
        assert await cli(path, "rotation", "reboot") == 2
        assert "Repeat with --yes" in capsys.readouterr().err
        assert await cli(path, "rotation", "reboot", "--yes", "--json") == 0
        assert json.loads(capsys.readouterr().out) == {"rebooted": True}
        assert await cli(path, "rotation", "step") == 2
        assert "Repeat with --yes" in capsys.readouterr().err
        assert await cli(path, "profile", "verify", "rotation") == 0
        assert "as its profile says" in capsys.readouterr().out


@pytest.mark.live
def test_the_module_and_the_command_are_the_same(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "graderd", "--socket", str(tmp_path / "none"), "stop", "--json"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.returncode == 1
    assert json.loads(run.stdout)["error"] == "no daemon serves this socket"
    assert run.stderr.count("\n") == 1


@pytest.mark.parametrize("module", ["graderd.runtime.app.guard", "graderd.runtime.app.daemon"])
@pytest.mark.live
def test_daemon_and_guard_load_no_opencv(module: str) -> None:
    code = f"import sys, {module}; sys.exit('cv2' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    "module", ["graderd.runtime.app.guard", "graderd.runtime.app.daemon", "graderd.simulator.process"]
)
@pytest.mark.live
def test_no_process_loads_what_only_mf4_logs_need(module: str) -> None:
    assert importlib.util.find_spec("asammdf"), "else it proves nothing"
    code = f"import sys, {module}; sys.exit('asammdf' in sys.modules or 'pandas' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.live
def test_stop_does_not_wait_for_large_imports() -> None:
    code = (
        "import sys, graderd.cli.app as app; app.run_app(['--socket', 'none', 'stop']);"
        # typer loads pydantic itself; the models built on it take as long again
        "heavy = ('cv2', 'numpy', 'fastapi', 'httpx', 'websockets', 'rich.console', 'graderd.core.status');"
        "sys.exit(any(name in sys.modules for name in heavy))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
