"""What a client wrote reaches other people's terminals as text: it ends no line and commands nothing."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from rich.console import Console
from websockets.asyncio.client import unix_connect

from graderd.cli.console import error_line, plain_table, print_json, print_text, rich_table
from graderd.cli.status import summary
from graderd.core.machine import Mode
from graderd.drivers.electrak.dump import FrameDecoder, text_of
from graderd.drivers.j1939.python_can import can
from graderd.runtime.sd_notify import SystemdNotifier
from harness.api_daemon import serving, within
from tests.unit.test_cli_modes import Capture, cli

pytestmark = pytest.mark.live

HOSTILE = "stop\nmode  auto: all is well\x1b[2J\x1b]0;title\x07\x9b31m\u202e\r"
SHOWN = "stop\\nmode  auto: all is well\\x1b[2J\\x1b]0;title\\x07\\x9b31m\\u202e\\r"


def assert_harmless(text: str, lines_n: int | None = None) -> None:
    assert all(c.isprintable() or c == "\n" for c in text), repr(text)
    if lines_n is not None:
        assert len(text.splitlines()) == lines_n


def test_tables_lines_errors_and_json(capsys: Capture) -> None:
    assert_harmless(plain_table("", ("", ""), [("mode", HOSTILE)]), 1)
    screen = io.StringIO()
    Console(file=screen, force_terminal=False, width=200).print(rich_table("", ("", ""), [("mode", HOSTILE)]))
    assert_harmless(screen.getvalue())
    assert SHOWN in screen.getvalue()
    assert_harmless(error_line("stop", HOSTILE, HOSTILE), 1)
    print_text(HOSTILE)
    assert_harmless(capsys.readouterr().out)
    print_json({"reason": HOSTILE})
    out = capsys.readouterr().out
    assert_harmless(out, 1)
    assert json.loads(out) == {"reason": HOSTILE}


async def test_what_comes_in_is_harmless_in_status_and_for_every_reader(tmp_path: Path, capsys: Capture) -> None:
    async with serving(tmp_path) as (daemon, path):
        async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(path))) as client:
            body = {"reason": HOSTILE, "client": HOSTILE[:20]}
            assert (await client.post("http://localhost/v1/stop", json=body)).status_code == 200
            await daemon.until_mode(Mode.STOPPED)
            status = (await client.get("http://localhost/v1/status")).json()
        assert status["reason"] == f"{SHOWN} (by stop\\nmode  auto: all)"
        async with unix_connect(str(path), "ws://localhost/v1/jog?client=a%0Ab%1B%5B2J") as jog:
            await jog.send(json.dumps({"command": "preset", "name": HOSTILE}))
            assert_harmless(str(await within(5, jog.recv())), 1)
        assert daemon.seen[-1].client.startswith("a\\nb\\x1b[2J#")
        assert await cli(path, "status") == 0
    assert_harmless(capsys.readouterr().out)


async def test_the_command_line_trusts_no_daemon_either(tmp_path: Path, capsys: Capture) -> None:
    """An older daemon lets such text through; then the reader's side escapes it."""
    async with serving(tmp_path) as (daemon, path):
        daemon.state = replace(daemon.state, mode=Mode.STOPPED, reason=HOSTILE)
        await daemon.until(lambda: daemon.status().reason == HOSTILE)
        for arguments in (("status",), ("status", "--json"), ("arm",), ("stop",)):
            await cli(path, *arguments)
            said = capsys.readouterr()
            assert_harmless(said.out)
            assert_harmless(said.err)
            assert HOSTILE[:5] not in said.out, "the end of a line in it is shown, not made"
        assert_harmless(summary(daemon.status().model_dump(mode="json")), 1)


def test_a_unit_on_the_bus_does_not_command_the_terminal_of_who_dumps_it() -> None:
    frame = can.Message(arbitration_id=(6 << 26) | (0xFEDA << 8) | 0x13, data=b"\x01\x1b[2J\n\x07*")
    assert_harmless(text_of(FrameDecoder().decode(frame)), 1)


def test_systemd_is_told_one_assignment(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str] = []
    monkeypatch.setattr(SystemdNotifier, "_send", lambda _, message: sent.append(message))
    SystemdNotifier("").status("stopped: x\nWATCHDOG=1\nMAINPID=1")
    assert sent == ["STATUS=stopped: x\\nWATCHDOG=1\\nMAINPID=1"]
