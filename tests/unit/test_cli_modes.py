"""The mode commands and status against a daemon on a real socket: what they print, and how they exit."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import pty
import signal
import struct
import sys
import termios
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from graderd import places
from graderd.cli import modes
from graderd.cli.app import run_app
from graderd.cli.status import sections
from graderd.core.machine import Mode, Unmet
from harness.api_daemon import FakeDaemon, serving, within

pytestmark = pytest.mark.live

Capture = pytest.CaptureFixture[str]


async def cli(path: Path, *arguments: str) -> int:
    """Run the command line in a thread: the daemon it talks to lives in this event loop."""
    return await asyncio.to_thread(run_app, ["--socket", str(path), *arguments])


async def test_from_disarmed_to_auto_and_stopped(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        assert await cli(path, "arm") == 0
        assert "armed: manual" in capsys.readouterr().out
        assert await cli(path, "auto") == 0
        assert daemon.state.mode is Mode.AUTO
        assert await cli(path, "stop", "--reason", "enough") == 0
        assert daemon.status().mode is Mode.STOPPED
        assert "enough" in daemon.status().reason
        assert await cli(path, "stop") == 0
        capsys.readouterr()
        assert await cli(path, "arm") == 1
        said = capsys.readouterr()
        assert said.err.startswith("graderd: arm: stopped: enough")
        assert said.err.endswith("Reset first, then arm\n")
        assert said.err.count("\n") == 1
        assert await cli(path, "reset") == 0
        assert daemon.status().mode is Mode.DISARMED
        assert await cli(path, "manual") == 1
        assert await cli(path, "disarm") == 0


def test_arm_waits_for_as_long_as_the_daemon_arms(monkeypatch: pytest.MonkeyPatch) -> None:
    """It failed after 8 s, with arming going on: the machine became armed after a command that had failed."""
    waited_s = 0.0

    def wait(seconds: float) -> None:
        nonlocal waited_s
        waited_s += seconds

    def status(_: str) -> dict[str, Any]:
        armed = waited_s > 29.0
        return {"mode": "manual" if armed else "disarmed", "arming": not armed, "reason": "arming"}

    monkeypatch.setattr(modes, "time", SimpleNamespace(monotonic=lambda: waited_s, sleep=wait))
    client: Any = SimpleNamespace(get=status)
    assert modes._after_arming(client)["mode"] == "manual"


async def test_arm_lists_what_is_unmet(tmp_path: Path, capsys: Capture) -> None:
    daemon = FakeDaemon(unmet=(Unmet("camera fresh", "no picture yet", "look at the camera's cable"),))
    async with serving(tmp_path, daemon) as (_, path):
        assert await cli(path, "arm") == 1
        said = capsys.readouterr()
        assert "UNMET" in said.out
        assert "camera fresh" in said.out
        assert "Look at the camera's cable" in said.err
        assert await cli(path, "arm", "--json") == 1
        problem = json.loads(capsys.readouterr().out)
        assert problem == {
            "error": "not ready: camera fresh: no picture yet",
            "where": "arm",
            "remedy": "look at the camera's cable",
        }


@pytest.mark.parametrize("command", ["arm", "disarm", "stop", "reset", "status"])
async def test_json_is_one_object(tmp_path: Path, capsys: Capture, command: str) -> None:
    async with serving(tmp_path) as (_, path):
        assert await cli(path, command, "--json") == 0
        out = capsys.readouterr().out
        assert out.count("\n") == 1
        assert isinstance(json.loads(out), dict)


async def test_status_for_people_shows_what_matters(tmp_path: Path, capsys: Capture) -> None:
    daemon = FakeDaemon(unmet=(Unmet("camera fresh", "no picture yet", "look at the camera's cable"),))
    async with serving(tmp_path, daemon) as (_, path):
        assert await cli(path, "status") == 0
        out = capsys.readouterr().out
        for text in ("disarmed: started disarmed", "rotation", "lift_left", "0.0 deg", "camera fresh", "no picture"):
            assert text in out
        assert "\x1b" not in out


async def test_what_the_camera_is_set_to_is_shown_as_the_camera_says_it(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, _):
        status = daemon.status().model_dump(mode="json")
    assert "camera set" not in {row[0]: row[1] for row in sections(status)[0][2]}
    status["camera"]["settings_read_back"] = {"exposure_us": 8000.0, "depth_emitter": 1.0, "depth_laser_mw": 150.0}
    overview = {row[0]: row[1] for row in sections(status)[0][2]}
    assert overview["camera set"] == "exposure_us 8000, depth_emitter 1, depth_laser_mw 150"


async def test_what_arming_needs_and_what_it_goes_without_are_told_apart(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, _):
        status = daemon.status().model_dump(mode="json")
    status["readiness"] = [
        {"name": "rotation", "met": False, "mandatory": True, "reason": "closed", "remedy": "check power"},
        {"name": "camera", "met": False, "mandatory": False, "reason": "no frame", "remedy": "wait"},
        {"name": "tilt", "met": True, "mandatory": True, "reason": "standby", "remedy": ""},
    ]
    tables = {title: rows for title, _, rows in sections(status)}
    assert tables["Not ready to arm"] == [("rotation", "closed", "check power")]
    assert tables["Missing; arming goes without"] == [("camera", "no frame", "wait")]


async def test_watch_prints_one_object_a_line(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path):
        process = await asyncio.create_subprocess_exec(
            *command_line(path, "status", "--watch", "--json"), stdout=asyncio.subprocess.PIPE
        )
        assert process.stdout is not None
        times = [json.loads(await within(20, process.stdout.readline()))["time_s"] for _ in range(3)]
        assert times == sorted(set(times))
        process.terminate()
        await process.wait()


async def test_watch_on_a_terminal_redraws_until_ctrl_c(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path):
        ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 150, 0, 0))
        process = await asyncio.create_subprocess_exec(
            *command_line(path, "status", "--watch"),
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, "TERM": "xterm"},
        )
        os.close(theirs)
        shown, drawn_twice = bytearray(), asyncio.Event()

        def read() -> None:
            try:
                shown.extend(os.read(ours, 65536))
            except OSError:  # the terminal's other end is closed
                asyncio.get_running_loop().remove_reader(ours)
            if shown.count(b"started disarmed") >= 2:
                drawn_twice.set()

        asyncio.get_running_loop().add_reader(ours, read)
        try:
            await within(30, drawn_twice.wait())
            process.send_signal(signal.SIGINT)
            assert await within(10, process.wait()) == 0
        finally:
            asyncio.get_running_loop().remove_reader(ours)
            os.close(ours)
        assert b"Traceback" not in shown


def command_line(path: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "graderd", "--socket", str(path), *arguments]


@pytest.mark.parametrize("command", ["status", "arm", "stop", "auto", "preset"])
def test_no_daemon_is_exit_status_3(tmp_path: Path, capsys: Capture, command: str) -> None:
    path = tmp_path / "none.sock"
    assert run_app(["--socket", str(path), command]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"graderd: {path}: no daemon serves this socket. Start it with")
    assert said.err.count("\n") == 1
    if command == "stop":
        assert "emergency stop" in said.err


def test_the_socket_is_found_by_the_environment(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRADERD_SOCKET", str(tmp_path / "named.sock"))
    assert run_app(["status"]) == 1
    assert "named.sock" in capsys.readouterr().err
    monkeypatch.delenv("GRADERD_SOCKET")
    monkeypatch.setattr(places, "SOCKET", tmp_path / "system.sock")
    monkeypatch.setattr(places, "CONFIG", tmp_path / "graderd.toml")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "user"))
    assert run_app(["status"]) == 1
    assert str(tmp_path / "user" / "graderd" / "graderd.sock") in capsys.readouterr().err
    (tmp_path / "system.sock").touch()
    assert run_app(["status"]) == 1
    assert "system.sock" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fly"], "fly"),
        (["status", "--nonsense"], "--nonsense"),
        (["jog", "wheel", "1deg"], "wheel"),
        (["jog", "rotate"], "Missing argument 'value'"),
        (["jog", "rotate", "5mm"], "its unit is deg, not mm"),
        ([], ""),
    ],
)
def test_bad_usage_is_exit_status_2(capsys: Capture, arguments: list[str], says: str) -> None:
    assert run_app(arguments) == 2
    said = capsys.readouterr()
    if arguments:
        assert said.err.count("\n") == 1
        assert said.err.startswith("graderd: ")
        assert says in said.err


def test_what_is_not_the_daemon_is_told(tmp_path: Path, capsys: Capture) -> None:
    import socket
    import threading

    def serve_nonsense(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello")

    path = tmp_path / "other.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        thread: Any = threading.Thread(target=serve_nonsense, args=(listener,))
        thread.start()
        assert run_app(["--socket", str(path), "status"]) == 1
        thread.join(5)
    assert "what answers is not graderd" in capsys.readouterr().err
