"""Who may use the interface by TCP: names, rights and hashes of tokens, a line each in one file.

A token is 256 random bits: its SHA-256 tells it and does not give it away. The file is written whole and at once, so
that a daemon reading beside it sees the one state or the other.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from graderd.hal.errors import DeviceError

NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,31}")
HEADER = "# graderd: tokens of the interface on TCP, hashed. Written by 'graderd token'.\n# name right made sha256\n"


class Right(StrEnum):
    """What the bearer of a token may do. Whoever has one may stop the machine."""

    READ = "read"
    COMMAND = "command"


@dataclass(frozen=True, slots=True)
class Token:
    """What is kept of a token. ``made``: ISO 8601 UTC; ``digest``: its SHA-256 in hexadecimal digits."""

    name: str
    right: Right
    made: str
    digest: str


def digest_of(token: bytes) -> str:
    """What a token is known by."""
    return hashlib.sha256(token).hexdigest()


def read_tokens(path: Path) -> tuple[Token, ...]:
    """The tokens in ``path``; none where there is no such file.

    Raises:
        DeviceError: the file cannot be read, others may read it, or a line of it is none of ours.
    """
    where = f"tokens {path}"
    try:
        with path.open(encoding="ascii") as file:
            if os.fstat(file.fileno()).st_mode & 0o077:
                raise DeviceError(where, "others may read this file", f"chmod 600 {path}")
            lines = file.read().splitlines()
    except FileNotFoundError:
        return ()
    except UnicodeDecodeError:
        raise DeviceError(where, "it is no text", REMAKE) from None
    except OSError as error:
        raise DeviceError(where, error.strerror or str(error), "let the daemon's user own it") from error
    return tuple(
        _token_of(line, f"{where}:{number}") for number, line in enumerate(lines, 1) if line[:1] not in ("", "#")
    )


REMAKE = "move it away, and make new tokens with 'graderd token create'"


def _token_of(line: str, where: str) -> Token:
    """Raises: DeviceError: no line of ours; what it holds is not told, it may be a token."""
    parts = line.split()
    if len(parts) != 4 or not NAME.fullmatch(parts[0]) or not re.fullmatch(r"[0-9a-f]{64}", parts[3]):
        raise DeviceError(where, "this is no line 'name right made sha256'", REMAKE)
    try:
        return Token(parts[0], Right(parts[1]), parts[2], parts[3])
    except ValueError:
        raise DeviceError(where, f"there is no right '{parts[1]}'", "read or command") from None


def create_token(path: Path, name: str, right: Right) -> str:
    """A new token, which nobody can be told again.

    Raises:
        DeviceError: no such name can be, or there is one; the file cannot be read or written.
    """
    if not NAME.fullmatch(name):
        raise DeviceError("token", f"'{name}' is no name", "up to 32 of a-z 0-9 _ . -, such as tablet-2")
    known = read_tokens(path)
    if any(token.name == name for token in known):
        raise DeviceError("token", f"there is a token '{name}'", f"revoke it first: graderd token revoke {name}")
    token = secrets.token_urlsafe(32)
    made = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    _write(path, (*known, Token(name, right, made, digest_of(token.encode()))))
    return token


def revoke_token(path: Path, name: str) -> None:
    """Forget a token: from then on it is a stranger's.

    Raises:
        DeviceError: there is none of that name, or the file cannot be read or written.
    """
    known = read_tokens(path)
    left = tuple(token for token in known if token.name != name)
    if len(left) == len(known):
        names = ", ".join(token.name for token in known) or "none"
        raise DeviceError("token", f"there is no token '{name}'", f"there are: {names}")
    _write(path, left)


def _write(path: Path, tokens: tuple[Token, ...]) -> None:
    """The whole file anew, readable by its owner alone: who owned it before, else who owns its directory."""
    text = HEADER + "".join(f"{t.name} {t.right} {t.made} {t.digest}\n" for t in tokens)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.new")
    try:
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        owner = (path if path.exists() else path.parent).stat()
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        try:
            with os.fdopen(descriptor, "w", encoding="ascii") as file:
                file.write(text)
                file.flush()
                os.fsync(descriptor)
                if os.geteuid() == 0:
                    os.fchown(descriptor, owner.st_uid, owner.st_gid)
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise DeviceError(
            f"tokens {path}", error.strerror or str(error), "run it as the daemon's user or as root"
        ) from error
