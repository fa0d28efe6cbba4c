"""`graderd run --sim` by anybody: the daemon serves where the clients look, and `graderd rig` finds its rig."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from graderd import places
from graderd.cli.app import run_app
from graderd.client import Client, default_socket
from graderd.config import Config, load
from graderd.runtime.app.daemon import served_at
from graderd.wires import MachineWires


def test_server_and_clients_agree_on_a_place_of_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "SOCKET", tmp_path / "run" / "graderd.sock")
    monkeypatch.setattr(places, "CONFIG", tmp_path / "none.toml")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("GRADERD_SOCKET", raising=False)
    unset = type(Config().api).model_construct(
        _fields_set=set(), **{**dict(Config().api), "socket": str(places.SOCKET)}
    )
    config = Config().model_copy(update={"api": unset})
    served = Path(served_at(config, None).api.socket)
    assert served == default_socket() == tmp_path / "graderd" / "graderd.sock"
    assert served.parent.stat().st_mode & 0o777 == 0o700
    monkeypatch.delenv("XDG_RUNTIME_DIR")  # as after su, and in a container
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    served = Path(served_at(config, None).api.socket)
    assert served == default_socket() == tmp_path / "home" / ".local" / "state" / "graderd" / "graderd.sock"
    assert served.parent.stat().st_mode & 0o777 == 0o700
    (tmp_path / "run").mkdir()
    assert Path(served_at(config, None).api.socket) == tmp_path / "run" / "graderd.sock", (
        "the service's, where it is ours"
    )
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert Path(served_at(config, None).api.socket) != tmp_path / "run" / "graderd.sock", "where it is not"
    (tmp_path / "run" / "graderd.sock").touch()
    assert Path(served_at(config, None).api.socket) == tmp_path / "run" / "graderd.sock" == default_socket(), (
        "but not beside the service, which the clients would talk to"
    )


def test_a_socket_that_is_named_counts_more_than_any_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert served_at(Config(), tmp_path / "mine.sock").api.socket == str(tmp_path / "mine.sock")
    named = Config.model_validate({"api": {"socket": "/somewhere/else.sock"}})
    assert served_at(named, None).api.socket == "/somewhere/else.sock"


@pytest.fixture
def runtime() -> Iterator[Path]:
    """Short, as /run/user/1000 is: a socket's path has 107 bytes at most, and pytest's own directories take 70."""
    with tempfile.TemporaryDirectory(prefix="g-") as directory:
        yield Path(directory)


@pytest.mark.live
@pytest.mark.whole_machine
def test_run_sim_without_root_and_configuration_and_soil_laid_by_a_command(runtime: Path) -> None:
    environment = {**os.environ, "GRADERD_SOCKET": str(runtime / "my.sock"), "XDG_RUNTIME_DIR": str(runtime)}
    graderd = [sys.executable, "-m", "graderd"]
    daemon = subprocess.Popen([*graderd, "run", "--sim"], env=environment, stderr=subprocess.DEVNULL)
    try:
        client = Client(runtime / "my.sock")
        client.until(lambda status: status.soil.frames_per_s > 0, 60, "pictures")
        laid = subprocess.run([*graderd, "rig", "scene", "left"], env=environment, check=True, capture_output=True)
        assert b"ok" in laid.stdout
        client.until(lambda status: status.soil.zone == "left", 30, "soil is seen left")
        driven = subprocess.run([*graderd, "rig", "drive", "--distance-m", "0.5"], env=environment, check=True)
        assert driven.returncode == 0
        client.until(lambda status: (status.vehicle.travelled_m or 0) > 0.4, 30, "driven")
        refused = subprocess.run([*graderd, "rig", "scene", "up"], env=environment, capture_output=True, check=False)
        assert refused.returncode == 2
    finally:
        daemon.send_signal(signal.SIGINT)
        assert daemon.wait(20) == 0
    assert list(runtime.iterdir()) == [], "nothing is left behind"


def test_an_ordinary_users_configuration_is_made_where_his_daemon_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(places, "CONFIG", tmp_path / "etc" / "graderd.toml")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    own = tmp_path / "config" / "graderd" / "graderd.toml"
    assert load() == Config(), "there is none yet"
    assert run_app(["config", "init"]) == 0
    assert str(own) in capsys.readouterr().out
    read = load()
    assert read.recording.directory == str(tmp_path / "state" / "graderd" / "recordings")
    assert read.state.directory == str(tmp_path / "state" / "graderd")
    assert run_app(["config", "set", "rotation.max_deg", "45"]) == 0
    assert load().rotation.max_deg == 45
    assert places.tokens() == tmp_path / "state" / "graderd" / "api-tokens"

    monkeypatch.setenv("XDG_CONFIG_HOME", "somewhere/relative")  # which counts for nothing
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert places.config() == tmp_path / "home" / ".config" / "graderd" / "graderd.toml"
    places.CONFIG.parent.mkdir()
    places.CONFIG.touch()
    assert places.config() == places.CONFIG, "a machine has one configuration"
    assert places.state_of(places.CONFIG) == places.STATE
    places.CONFIG.unlink()
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert places.config() == places.CONFIG, "what root makes is the machine's"


def test_a_new_users_setup_begins_with_a_file_where_his_daemon_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a home where nothing is yet, and without a machine: it comes as far as looking for the adapter."""
    monkeypatch.setattr(places, "CONFIG", tmp_path / "etc" / "graderd.toml")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(MachineWires, "serial_ports", lambda _: {})
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("GRADERD_SOCKET", str(tmp_path / "nobody.sock"))
    (tmp_path / "answers").write_text("")
    assert run_app(["setup", "--answers", str(tmp_path / "answers")]) == 1
    own = tmp_path / ".config" / "graderd" / "graderd.toml"
    said = capsys.readouterr()
    assert said.out.startswith(f"{own}: made, with every key")
    assert "adapter" in said.err
    assert load().state.directory == str(places.state_of(own))
    assert run_app(["setup", "--answers", str(tmp_path / "answers")]) == 1
    assert capsys.readouterr().out.startswith(f"{own}: is there already")
