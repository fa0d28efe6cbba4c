"""What asks for a stop, and how it is carried out: the request line is the stop, its body only adds a reason.

A stop is never bad input. Whatever its body is (no JSON, too long, not there yet, cut off), motion ends first; the body
is judged afterwards, and what was not understood of it is told in the answer.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from typing import Any

from starlette.types import Receive

from graderd.api.port import DaemonPort
from graderd.api.settings import ApiLimits
from graderd.core.commands import Reply, Stop
from graderd.core.machine import Mode
from graderd.hal.clock import Pace
from graderd.hal.text import printable

STOP_PATH = "/v1/stop"
REASON = "stop request"
GRACE_S = 0.005
"""A body that comes with its request line is read with it. One that does not is not waited for."""
DRAIN_S = 0.5
"""What still comes of the body after the stop is thrown away for so long, so that its sender can read the answer."""

log = logging.getLogger(__name__)
_AROUND_A_WORD = b" \t\r\n\"'!"
_MOST_CHARACTERS = {"reason": 200, "client": 80}
# Looked for in all of a body again with each piece that comes of it: it begins with a plain word, which is found fifty
# times as quickly as one whose letters may be large.
_COMMAND = re.compile(rb"""command["']?\s*[:=]\s*["']?stop\b""")


def is_stop_path(path: str) -> bool:
    """Whether a request for ``path`` is a stop, however its slashes and letters are written."""
    return [part for part in path.lower().split("/") if part] == ["v1", "stop"]


def is_stop_target(target: bytes) -> bool:
    """Whether a request for ``target``, a path and perhaps a query, is a stop."""
    return is_stop_path(target.partition(b"?")[0].decode("latin-1"))


def is_stop_line(line: bytes) -> bool:
    """Whether a request that begins so is a stop; the rest of its head may be no HTTP at all."""
    words = line.partition(b"\n")[0].split()
    return len(words) >= 2 and is_stop_target(words[1])


def is_stop_command(message: bytes | bytearray, complete: bool = True) -> bool:
    """Whether a command, or as much of it as has come, asks for a stop: also one that is not valid otherwise, such as a
    form, what Python prints, or the bare word."""
    if _COMMAND.search(message.lower()) or (complete and message.strip(_AROUND_A_WORD).lower() == b"stop"):
        return True
    if not complete or b"\\u" not in message:
        return False
    try:
        command = json.loads(message)  # "stop" may be written with escapes
    except (ValueError, RecursionError):
        return False
    return isinstance(command, dict) and command.get("command") == "stop"


def stop_of(body: bytes) -> tuple[Stop, str]:
    """The stop, with as much of its body as can be understood, and what could not."""
    text = _text(body).strip()
    if not text:
        return Stop(reason=REASON), ""
    try:
        given = json.loads(text)
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict):
        # Somebody's words all the same: they are the reason.
        return _stop({"reason": text}), "the body is no JSON object"
    odd = [name for name in given if name not in (*_MOST_CHARACTERS, "command")]
    odd += [name for name in _MOST_CHARACTERS if name in given and not isinstance(given[name], str)]
    return _stop(given), f"not understood: {', '.join(printable(name)[:40] for name in odd[:5])}" if odd else ""


def _stop(given: dict[str, Any]) -> Stop:
    said = {name: given.get(name) for name in _MOST_CHARACTERS}
    texts = {
        name: printable(value[: _MOST_CHARACTERS[name]])[: _MOST_CHARACTERS[name]]
        for name, value in said.items()
        if isinstance(value, str) and value.strip()
    }
    return Stop(**{"reason": REASON, **texts})


def _text(body: bytes) -> str:
    try:
        return body.decode()
    except UnicodeDecodeError:
        return body.decode("latin-1")


class StopLane:
    """Carries stops out, one like the other, whichever way they came."""

    def __init__(self, port: DaemonPort, limits: ApiLimits) -> None:
        self._port = port
        self._pace = Pace(limits.stop_rate_hz, max(1, round(limits.stop_rate_hz / 10)))

    async def carry_out(self, body: bytes, client: str = "", by: str = "") -> Reply:
        """Stop now. ``client``: the name that counts, where it is not the body's to give; ``by``: who that is, for the
        log."""
        command, problem = stop_of(body)
        if client:
            command = command.model_copy(update={"client": client})
        await self._turn()
        reply = self._port.stop(command)
        log.info("stop by %s (%s): %s", command.client or "-", by, reply.message, extra={"client": command.client})
        return reply.model_copy(update={"message": f"{reply.message} ({problem})"}) if problem else reply

    def at_once(self) -> Reply:
        """Stop for a request of which only the first line could be read."""
        return self._port.stop(Stop(reason=REASON))

    def overtake(self) -> None:
        """Stop for a request whose turn has not come yet; it gets its answer then. Not one for each of a flood."""
        if self._pace.take(asyncio.get_running_loop().time()) or self._port.status().mode is not Mode.STOPPED:
            self._port.stop(Stop(reason=REASON))

    async def serve(self, receive: Receive, by: str) -> Reply:
        """Stop for an HTTP request whose line has come; its body is taken as far as it has come with it."""
        body = bytearray()
        complete = False
        try:
            async with asyncio.timeout(GRACE_S):
                complete = await _read(receive, body)
        except TimeoutError:
            pass
        reply = await self.carry_out(bytes(body), by=by)
        if not complete:
            try:
                async with asyncio.timeout(DRAIN_S):
                    await _read(receive, bytearray())
            except TimeoutError:
                pass
        return reply

    async def _turn(self) -> None:
        """Wait for the turn of one of thousands of stops a second to a machine that the first has stopped. Each is
        carried out and counted (a reset names the last), and one that finds the machine in any other mode at once."""
        now_s = asyncio.get_running_loop().time()
        if not self._pace.take(now_s) and self._port.status().mode is Mode.STOPPED:
            await asyncio.sleep(self._pace.delay_s(now_s))


async def _read(receive: Receive, body: bytearray) -> bool:
    """Read to the end of the body, and keep its beginning; returns whether it ended as a body ends."""
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return False
        body += message.get("body", b"")[: max(0, 4096 - len(body))]
        if not message.get("more_body", False):
            return True
