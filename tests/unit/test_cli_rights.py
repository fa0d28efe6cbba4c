"""A user without rights gets one line and the right exit status from every command, never a traceback.

Everywhere, whoever runs the tests: the rights are taken away from the user there is, root included.
"""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graderd import client, places
from graderd.cli.app import run_app
from graderd.config import ConfigError, load
from graderd.config.rewrite import check_rights, rewrite
from tests.users import bound_by_file_rights


def wait_for_the_log() -> None:
    """It is written by a thread, which ends with the process."""
    for handler in logging.getLogger().handlers:
        handler.close()


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Directories of a service that this user may not look into: ``etc``, ``run``, ``state``."""
    for name in ("etc", "run", "state"):
        (tmp_path / name).mkdir()
    (tmp_path / "etc" / "graderd.toml").write_text("# of the service\n")
    (tmp_path / "run" / "graderd.sock").touch()
    monkeypatch.setattr(places, "CONFIG", tmp_path / "etc" / "graderd.toml")
    monkeypatch.setattr(places, "SOCKET", tmp_path / "run" / "graderd.sock")
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    monkeypatch.delenv("GRADERD_SOCKET", raising=False)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.chdir(tmp_path)
    closed = [tmp_path / name for name in ("etc", "run", "state")]
    for folder in closed:
        folder.chmod(0o000)
    with bound_by_file_rights():
        yield tmp_path
    for folder in closed:
        folder.chmod(0o700)


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["status"], 1),
        (["status", "--watch"], 1),
        (["stop"], 1),
        (["preset", "transport"], 1),
        (["can", "dump"], 1),
        (["rotation", "dump"], 1),
        (["run"], 2),
        (["config", "check"], 2),
        (["config", "show"], 2),
        (["calibrate", "camera", "--yes"], 1),
        (["calibrate", "camera", "--pose", "0.9,0,0.6,30,0,0", "--yes"], 1),
        (["classify", "etc/graderd.toml"], 1),
        (["classify", "etc"], 1),
    ],
)
def test_one_line_and_the_right_status(
    machine: Path, words: list[str], status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app(words) == status
    wait_for_the_log()
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert "ermission denied" in said.err or "may not use" in said.err
    assert said.out == ""


def test_the_guard_acts_all_the_same(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["guard"]) == 1  # neither wire is there
    wait_for_the_log()
    said = capsys.readouterr().err
    assert "taking the defaults" in said
    assert '{"failed": ["lift_left, lift_right, tilt", "rotation"]}' in said
    assert "Traceback" not in said


def test_nothing_is_written_without_a_right(machine: Path) -> None:
    for act in (load, check_rights, lambda path: rewrite(path, lambda text: text + "\n")):
        with pytest.raises(ConfigError, match="Permission denied"):
            act(places.CONFIG)


def test_a_socket_that_is_kept_from_us_comes_before_one_that_is_not_there(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = machine / "own" / "graderd" / "graderd.sock"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(machine / "own"))
    assert client.default_socket() == places.SOCKET
    own.parent.mkdir(parents=True)
    own.touch()
    assert client.default_socket() == own


def test_the_configured_socket_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = tmp_path / "elsewhere.sock"
    monkeypatch.setattr(places, "CONFIG", tmp_path / "graderd.toml")
    monkeypatch.setattr(places, "SOCKET", tmp_path / "graderd.sock")
    monkeypatch.delenv("GRADERD_SOCKET", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    places.SOCKET.touch()
    named.touch()
    for text in (f'[api]\nsocket = "{named}"\n', f'version = 99\n[api]\nsocket = "{named}"\n'):
        places.CONFIG.write_text(text)
        assert client.default_socket() == named
    for text in ("[[[", "api = 1\n", "[api]\nsocket = 7\n", '[api]\nsocket = ""\n', "\ufeff[api]\n"):
        places.CONFIG.write_text(text)
        assert client.default_socket() == places.SOCKET
    named.unlink()
    places.CONFIG.write_text(f'[api]\nsocket = "{named}"\n')
    assert client.default_socket() == places.SOCKET


@pytest.mark.live
def test_stop_loads_nothing_heavy_to_find_its_socket() -> None:
    code = "import sys, graderd.client as c; c.default_socket(); "
    code += "print([m for m in ('pydantic', 'numpy', 'tomlkit', 'graderd.config') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
