"""Who may come in by TCP: a token, a Host we are known by, and no foreign Origin.

On the unix socket the file's rights decide instead. On TCP any program on the machine, and any web page in a browser
on it, can open a connection: the token keeps out the programs, the Host check DNS rebinding, the Origin check pages of
other sites.
"""

from __future__ import annotations

import hmac
import os
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from urllib.parse import unquote_to_bytes

from graderd.api.problem import ProblemError
from graderd.api.settings import LOOPBACK_NAMES
from graderd.hal.errors import DeviceError

TOKEN_COOKIE = b"graderd_token"
TOKEN_QUERY = b"token"
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
    """Judges the head of every request that comes by TCP, before anything else of it is looked at."""

    def __init__(self, token: str, port_n: int, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._token = token.encode()
        names = {name.lower() for name in (*LOOPBACK_NAMES, *allowed_hosts)}
        self._hosts = names | {f"{name}:{port_n}" for name in names}
        self._origins = {f"{scheme}://{host}" for host in self._hosts for scheme in ("http", "https")}

    def refusal(self, target: bytes, headers: Iterable[tuple[bytes, bytes]]) -> ProblemError | None:
        """Why this request may not come in; None where it may. ``target``: path and query as they came; the names of
        ``headers`` are in lower case."""
        given = dict(headers)
        if _text(given.get(b"host", b"")).lower() not in self._hosts:
            remedy = "use localhost, or add the name to allowed_hosts"
            return ProblemError(403, "this name is not one of ours", "Host", remedy)
        origin = given.get(b"origin")
        if origin is not None and _text(origin).lower() not in self._origins:
            return ProblemError(403, "pages of other sites may not command this machine", "Origin")
        if not any(hmac.compare_digest(token, self._token) for token in _tokens_given(target, given)):
            remedy = "send 'Authorization: Bearer TOKEN' with the token from the daemon's token file"
            return ProblemError(401, "no token, or not the right one", "token", remedy)
        return None


def _tokens_given(target: bytes, headers: Mapping[bytes, bytes]) -> list[bytes]:
    """Tokens a request carries: bearer header, cookie, and for WebSockets, where a browser can set no header, the
    query ``?token=``. Each is found by cutting, in one pass: the library's parser of cookies needs a time that grows
    with the square of their length, on a header that anybody may send."""
    given: list[bytes] = []
    scheme, _, bearer = headers.get(b"authorization", b"").partition(b" ")
    if scheme.lower() == b"bearer":
        given.append(bearer.strip())
    given += _values(headers.get(b"cookie", b""), b";", TOKEN_COOKIE)
    if headers.get(b"upgrade", b"").lower() == b"websocket":
        given += [unquote_to_bytes(token) for token in _values(target.partition(b"?")[2], b"&", TOKEN_QUERY)]
    return given


def _values(text: bytes, separator: bytes, name: bytes) -> list[bytes]:
    """The values that ``name`` has in a list of ``name=value``."""
    pairs = (part.strip().partition(b"=") for part in text.split(separator))
    return [value for key, _, value in pairs if key == name]


def _text(value: bytes) -> str:
    return value.decode("latin-1")
