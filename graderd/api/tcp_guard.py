"""Who may come in by TCP: a token, a Host we are known by, and no foreign Origin.

On the unix socket the file's rights decide instead. On TCP any program on the machine, and any web page in a browser
on it, can open a connection: the token keeps out the programs, the Host check DNS rebinding, the Origin check pages of
other sites.
"""

from __future__ import annotations

import hmac
import os
import secrets
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from graderd.api.problem import Problem, answer
from graderd.api.settings import LOOPBACK_NAMES
from graderd.hal.errors import DeviceError

TOKEN_COOKIE = "graderd_token"
MIN_TOKEN_CHARACTERS = 16


def load_or_make_token(path: Path) -> str:
    """The token in ``path``; where there is none yet, a new one is made, readable by the owner alone.

    Raises:
        DeviceError: the file cannot be read or made, others may read it, or the token is too short to be one.
    """
    where = f"api token {path}"
    try:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            if path.stat().st_mode & 0o077:
                raise DeviceError(where, "others may read this file", f"chmod 600 {path}") from None
            token = path.read_text("utf-8").strip()
            if len(token) < MIN_TOKEN_CHARACTERS:
                raise DeviceError(
                    where, f"the token is shorter than {MIN_TOKEN_CHARACTERS} characters", "delete the file to get one"
                ) from None
            return token
        token = secrets.token_urlsafe(32)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(token + "\n")
        return token
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(where, str(error), "give the daemon a directory it may write to") from error


class TcpGuard:
    """ASGI middleware in front of everything that comes by TCP."""

    def __init__(self, app: ASGIApp, token: str, port_n: int, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._app = app
        self._token = token.encode()
        names = {name.lower() for name in (*LOOPBACK_NAMES, *allowed_hosts)}
        self._hosts = names | {f"{name}:{port_n}" for name in names}
        self._origins = {f"{scheme}://{host}" for host in self._hosts for scheme in ("http", "https")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        problem = self._problem(scope)
        if problem is None:
            await self._app(scope, receive, send)
            return
        status_code = 401 if problem.where == "token" else 403
        await answer(status_code, problem, scope, receive, send, {"Connection": "close"})

    def _problem(self, scope: Scope) -> Problem | None:
        headers = Headers(scope=scope)
        if headers.get("host", "").lower() not in self._hosts:
            return Problem(
                error="this name is not one of ours",
                where="Host",
                remedy="use localhost, or add the name to allowed_hosts",
            )
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in self._origins:
            return Problem(error="pages of other sites may not command this machine", where="Origin")
        if not any(hmac.compare_digest(given, self._token) for given in _tokens_given(scope, headers)):
            return Problem(
                error="no token, or not the right one",
                where="token",
                remedy="send 'Authorization: Bearer TOKEN' with the token from the daemon's token file",
            )
        return None


def _tokens_given(scope: Scope, headers: Headers) -> list[bytes]:
    """Tokens a request carries: bearer header, cookie, and for WebSockets, where a browser can set no header, the
    query ``?token=``."""
    given: list[bytes] = []
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        given.append(bearer.strip().encode("utf-8", "replace"))
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(TOKEN_COOKIE)
    except CookieError:
        cookie = None
    if cookie is not None:
        given.append(cookie.value.encode("utf-8", "replace"))
    if scope["type"] == "websocket":
        query = parse_qs(scope["query_string"].decode("latin-1"))
        given += [token.encode("utf-8", "replace") for token in query.get("token", [])]
    return given
