"""Who may come in by TCP, and for what: a token with its right, a Host we are known by, and no foreign Origin.

On the unix socket the file's rights decide instead. On TCP any program on the machine, and any web page in a browser
on it, can open a connection: the token keeps out the programs, the Host check DNS rebinding, the Origin check pages of
other sites.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

from graderd.api.problem import ProblemError
from graderd.api.settings import LOOPBACK_NAMES
from graderd.api.stop import is_stop_path
from graderd.hal.errors import DeviceError
from graderd.tokens import Right, Token, digest_of, read_tokens

TOKEN_COOKIE = b"graderd_token"
TOKEN_QUERY = b"token"
TOKENS_CHECK_S = 0.5
TOKENS_GIVEN_N = 4
"""More than any client of ours sends: a head of 8 kB full of them is not hashed a hundred times."""
PAGE_PREFIX = "/page/"
SESSION_PATH = "/v1/session"
READING_SOCKETS = ("/v1/stream", "/v1/bus/")

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Grant:
    """Who asks, and what that one may do. ``ended`` is set once the token was revoked or given another right."""

    name: str
    right: Right
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class Tokens:
    """The tokens in force. A file that became unreadable leaves none in force but those that were: who can damage it
    must not lock the operator out, and a revocation is a file that can be read.

    Raises:
        DeviceError: the file is not usable.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen = _stamp(path)
        self._grants: dict[str, tuple[Token, Grant]] = {}
        self._take(read_tokens(path))
        if not self._grants:
            log.info("%s: no tokens yet: make one with 'graderd token create NAME'", path)

    def grant_of(self, token: bytes) -> Grant | None:
        """Whose it is; None: nobody's."""
        found = self._grants.get(digest_of(token))
        return found[1] if found is not None else None

    async def keep_watching(self) -> None:
        """Take changes of the file until cancelled."""
        while True:
            await asyncio.sleep(TOKENS_CHECK_S)
            self.reload()

    def reload(self) -> None:
        """Take what has changed since."""
        stamp = _stamp(self._path)
        if stamp == self._seen:
            return
        self._seen = stamp
        try:
            self._take(read_tokens(self._path))
        except DeviceError as error:
            log.error("%s", error)

    def _take(self, tokens: tuple[Token, ...]) -> None:
        before, self._grants = self._grants, {}
        for token in tokens:
            known = before.get(token.digest)
            kept = known if known is not None and known[0] == token else (token, Grant(token.name, token.right))
            self._grants[token.digest] = kept
        in_force = {grant for _, grant in self._grants.values()}
        for token, grant in before.values():
            if grant not in in_force:
                grant.ended.set()
                log.info("token %s is no longer in force", token.name, extra={"event": True, "client": token.name})


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


class TcpGuard:
    """Judges the head of every request that comes by TCP, before anything else of it is looked at."""

    def __init__(self, tokens: Tokens, port_n: int, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._tokens = tokens
        names = {name.lower() for name in (*LOOPBACK_NAMES, *allowed_hosts)}
        self._hosts = names | {f"{name}:{port_n}" for name in names}
        self._origins = {f"{scheme}://{host}" for host in self._hosts for scheme in ("http", "https")}

    def admit(self, method: bytes, target: bytes, headers: Iterable[tuple[bytes, bytes]]) -> Grant | None:
        """Who asks; None: anybody, for the page's own files, in which there is nothing to keep. ``target``: path and
        query as they came; the names of ``headers`` are in lower case.

        Raises:
            ProblemError: this request may not come in.
        """
        given = dict(headers)
        if _text(given.get(b"host", b"")).lower() not in self._hosts:
            remedy = "use localhost, or add the name to allowed_hosts"
            raise ProblemError(403, "this name is not one of ours", "Host", remedy)
        origin = given.get(b"origin")
        if origin is not None and _text(origin).lower() not in self._origins:
            raise ProblemError(403, "pages of other sites may not command this machine", "Origin")
        path = unquote(_text(target.partition(b"?")[0]))
        upgraded = b"upgrade" in given
        if method in (b"GET", b"HEAD") and not upgraded and (path == "/" or path.startswith(PAGE_PREFIX)):
            return None
        grant = next(filter(None, map(self._tokens.grant_of, _tokens_given(target, given))), None)
        if grant is None:
            remedy = "send 'Authorization: Bearer TOKEN'; 'graderd token create NAME' on the machine makes one"
            raise ProblemError(401, "no token, or not the right one", "token", remedy)
        if grant.right is not Right.COMMAND and not _only_reads(method, path, upgraded):
            remedy = "use one that was made with '--right command'; POST /v1/stop is everybody's"
            raise ProblemError(403, f"the token '{grant.name}' may read and stop, not command", "token", remedy)
        return grant


def _only_reads(method: bytes, path: str, upgraded: bool) -> bool:
    """Whether it commands nothing: what is not known to read does not."""
    if is_stop_path(path) or path == SESSION_PATH:
        return True
    if upgraded:
        return path == READING_SOCKETS[0] or path.startswith(READING_SOCKETS[1])
    return method in (b"GET", b"HEAD")


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
    return given[:TOKENS_GIVEN_N]


def _values(text: bytes, separator: bytes, name: bytes) -> list[bytes]:
    """The values that ``name`` has in a list of ``name=value``."""
    pairs = (part.strip().partition(b"=") for part in text.split(separator))
    return [value for key, _, value in pairs if key == name]


def _text(value: bytes) -> str:
    return value.decode("latin-1")
