"""The one way to change a configuration file: calibration and migration hand :func:`rewrite` a function of its text.

Whatever happens on the way (no right, a full disk, a crash, a second writer, a name somebody planted), the old file
stands whole or the new one does. The new text is checked before it is written, the former file stays beside it as
``NAME.YYYYMMDD-HHMMSS.bak``, and owner, group and mode are kept: who could read the file before can read it after.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import pwd
import re
import secrets
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.exceptions import TOMLKitError

from graderd.config.loader import ConfigError, decode, parse_text

BACKUPS_N: Final = 10
"""So many former files are kept, the newest."""
PLANTED_N: Final = 100
"""So many names for a backup are tried where somebody takes one before us."""
LOCK_WAIT_S: Final = 5.0
LOCK_POLL_S: Final = 0.02
LINKS_N: Final = 8

_REMEDIES: Final[Mapping[int, str]] = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "Make room on its file system"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), "Run it with sudo, or name another file with --config"),
    errno.EROFS: "Mount its file system writable",
}


def rewrite(path: Path, change: Callable[[str], str], *, create: bool = False) -> Path | None:
    """Put ``change(text)`` in the place of the file's text; returns the former file's backup.

    None where nothing changed, or where ``create`` allowed a file that was not there. Where ``path`` is a symbolic
    link, the file it leads to is changed and has the backups beside it.

    Raises:
        ConfigError: it cannot be read or written, or the new text is not a valid configuration; the file is as it was.
    """
    with _told(path), _opened(path, create=create) as place:
        raw = place.read()
        old = decode(raw, path)
        new = change(old)
        parse_text(new, path)
        if new == old and not place.made:
            return None
        if b"\r\n" in raw:
            new = new.replace("\n", "\r\n")
        temporary = place.create_temporary(new.encode())
        backup = None
        try:
            place.check_unchanged(raw)
            if not place.made:
                backup = place.create_backup(raw)
            os.replace(temporary, place.name, src_dir_fd=place.directory, dst_dir_fd=place.directory)
        except BaseException:
            place.remove(temporary, *filter(None, [backup]))
            raise
        place.made = False
        try:
            os.fsync(place.directory)
        except OSError as error:
            line = f"{path}: is written, but the disk does not confirm it ({error.strerror}). Look at the disk"
            raise ConfigError(path, [line]) from None
        place.prune_backups(keep=backup)
        return None if backup is None else place.target.with_name(backup)


def backups_of(path: Path) -> list[Path]:
    """The backups beside a configuration file, the oldest first (as text, the tenth of a second comes before the
    second, and both before the first).

    Raises:
        OSError: the directory cannot be read.
    """
    try:
        beside = os.listdir(path.parent)
    except FileNotFoundError:
        return []
    return [path.with_name(name) for _, _, name in _dated(path.name, beside)]


def _dated(name: str, beside: list[str]) -> list[tuple[str, int, str]]:
    """Date, number within its second, and name of each backup of ``name``, the oldest first."""
    ours = re.compile(re.escape(f"{name}.") + r"(\d{8}-\d{6})(?:-(\d{1,9}))?\.bak")
    matches = (ours.fullmatch(found) for found in beside)
    return sorted((match[1], int(match[2] or 1), match[0]) for match in matches if match)


def check_rights(path: Path) -> None:
    """Try all that :func:`rewrite` needs (of a file that may be new) and change nothing: ask before a long work.

    Raises:
        ConfigError: the rights, the owner or the file system do not allow it.
    """
    with _told(path), _opened(path, create=True) as place:
        place.remove(place.create_temporary(b""))


def merged(text: str, changes: Mapping[str, Any]) -> str:
    """The configuration ``text`` with ``changes`` (tables of tables) put in; comments and order stay. A key or a table
    that stands there as a comment (``graderd config init``) takes that line, beneath its explanation.

    Raises:
        ConfigError: the text is not TOML, or has a value where ``changes`` has a table.
    """
    try:
        document = tomlkit.parse(_with_room(text, changes))
        _merge(document, changes)
        return tomlkit.dumps(document)
    except (TOMLKitError, TypeError) as error:
        raise ConfigError(None, [f"not a configuration: {error}. Correct it first"]) from None


_HEADER = re.compile(r"\s*\[([\w.]+)\]\s*(#.*)?")
_COMMENTED_HEADER = re.compile(r"#\[([\w.]+)\]")
_EXPLAINS = re.compile(r"#(?!\s?\w+(: not set| = ))")


def _headers(lines: list[str], pattern: re.Pattern[str] = _HEADER) -> list[tuple[int, str]]:
    """Where tables begin, and their names."""
    return [(number, match[1]) for number, line in enumerate(lines) if (match := pattern.fullmatch(line))]


def _begin(lines: list[str], table: str) -> None:
    """A header for a table that has none: where it stands as a comment, else behind the tables beside it, before what
    explains the next one. (tomlkit would put it below that explanation.) Where neither is there, tomlkit finds room."""
    commented = [number for number, name in _headers(lines, _COMMENTED_HEADER) if name == table]
    if commented:
        lines[commented[0]] = f"[{table}]"
        return
    headers = _headers(lines)
    parent, _, _ = table.rpartition(".")
    beside = [number for number, name in headers if parent and f"{name}.".startswith(f"{parent}.")]
    if not beside:
        return
    end = next((number for number, _ in headers if number > beside[-1]), len(lines))
    while end < len(lines) and _EXPLAINS.match(lines[end - 1]):
        end -= 1
    lines[end:end] = [f"[{table}]", ""]


def _with_room(text: str, changes: Mapping[str, Any]) -> str:
    """``text`` with a line for each key of ``changes`` that its table lacks: the one where it stands as a comment, else
    the one below the table's header. (tomlkit would put it at the table's end, beneath what explains the next one.)"""
    present = tomlkit.parse(text).unwrap()
    lines = text.split("\n")
    for table, key, value in _plain_keys(changes):
        if _has(present, (*table, key)):
            continue
        name = ".".join(table)
        if name and not _has(present, table) and all(found != name for _, found in _headers(lines)):
            _begin(lines, name)
        headers = _headers(lines)
        starts = [number for number, found in headers if found == name] if name else [-1]
        if not starts:
            continue
        bounds = [number for number, _ in headers + _headers(lines, _COMMENTED_HEADER)]
        end = min((number for number in bounds if number > starts[0]), default=len(lines))
        commented = re.compile(rf"#\s?{re.escape(key)}(: not set| = .*)")
        places = [number for number in range(starts[0] + 1, end) if commented.fullmatch(lines[number])]
        written = f"{key} = {tomlkit.item(_value(value)).as_string()}"
        if places:
            lines[places[0]] = written
        elif table:
            lines.insert(starts[0] + 1, written)
    return "\n".join(lines)


def _plain_keys(changes: Mapping[str, Any], table: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    for key, value in changes.items():
        if isinstance(value, Mapping):
            yield from _plain_keys(value, (*table, key))
        else:
            yield table, key, value


def _has(values: Any, path: tuple[str, ...]) -> bool:
    for key in path:
        if not isinstance(values, Mapping) or key not in values:
            return False
        values = values[key]
    return True


def _merge(table: Any, changes: Mapping[str, Any]) -> None:
    for key, value in changes.items():
        if isinstance(value, Mapping):
            if key not in table:
                table[key] = tomlkit.table()
            _merge(table[key], value)
        else:
            table[key] = _value(value)


def _value(value: Any) -> Any:
    """As it is written."""
    return round(value, 6) if isinstance(value, float) else list(value) if isinstance(value, tuple) else value


@dataclass
class _Place:
    """The file, open and locked, in its directory, open too: names are looked up there and nowhere else."""

    path: Path
    target: Path
    directory: int
    file: int
    made: bool
    """It was not there before; unless a text is put into it, it goes again."""

    @property
    def name(self) -> str:
        return self.target.name

    def read(self) -> bytes:
        """All of the file. (By our own descriptor: closing another one would give up the lock.)"""
        return os.pread(self.file, os.fstat(self.file).st_size, 0)

    def check_unchanged(self, raw: bytes) -> None:
        """An editor knows nothing of our lock: what it saved meanwhile must not be lost."""
        if not _is_at(self.file, self.name, self.directory) or self.read() != raw:
            raise ConfigError(self.path, [f"{self.path}: somebody else changed it at the same moment. Try again"])

    def create_temporary(self, data: bytes) -> str:
        """A new file beside it, on the disk. Any older one is a crashed writer's: whoever writes has the lock."""
        stale = re.compile(re.escape(f".{self.name}.") + r"[0-9a-f]{8}\.new")
        self.remove(*(name for name in os.listdir(self.directory) if stale.fullmatch(name)))
        name = f".{self.name}.{secrets.token_hex(4)}.new"
        self._create(name, data)
        return name

    def create_backup(self, data: bytes) -> str:
        """The former file under its date, and the next number where that second has one already."""
        date = f"{datetime.now(UTC):%Y%m%d-%H%M%S}"
        first = 1 + max((number for when, number, _ in self._backups() if when == date), default=0)
        for number in range(first, first + PLANTED_N):
            name = f"{self.name}.{date}{f'-{number}' if number > 1 else ''}.bak"
            with suppress(FileExistsError):
                self._create(name, data, os.fstat(self.file).st_mtime_ns)
                return name
        raise FileExistsError(errno.EEXIST, "every name for a backup is taken")

    def _create(self, name: str, data: bytes, time_ns: int | None = None) -> None:
        """A file that was not there, with the old one's owner, group and mode; complete, or not at all."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(name, flags, 0o600, dir_fd=self.directory)
        try:
            was = os.fstat(self.file)
            _own(descriptor, was, self.path)
            os.fchmod(descriptor, stat.S_IMODE(was.st_mode))
            left = memoryview(data)
            while left:
                left = left[os.write(descriptor, left) :]
            if time_ns is not None:
                os.utime(descriptor, ns=(time_ns, time_ns))
            os.fsync(descriptor)
        except BaseException:
            self.remove(name)
            raise
        finally:
            os.close(descriptor)

    def remove(self, *names: str) -> None:
        for name in names:
            with suppress(OSError):
                os.unlink(name, dir_fd=self.directory)

    def prune_backups(self, keep: str | None) -> None:
        others = [name for _, _, name in self._backups() if name != keep]
        self.remove(*others[: max(0, len(others) - BACKUPS_N + 1)])

    def _backups(self) -> list[tuple[str, int, str]]:
        return _dated(self.name, os.listdir(self.directory))


@contextmanager
def _opened(path: Path, *, create: bool) -> Iterator[_Place]:
    target = _target(path)
    directory = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        file, made = _locked(path, target.name, directory, create=create)
        place = _Place(path, target, directory, file, made)
        try:
            yield place
        finally:
            if place.made:
                place.remove(place.name)
            os.close(file)
    finally:
        os.close(directory)


def _target(path: Path) -> Path:
    """Where ``path`` leads. A link is followed if it is root's or our own: anybody else's was put there for us."""
    target = path
    for _ in range(LINKS_N):
        try:
            found = target.lstat()
        except FileNotFoundError:
            return target
        if not stat.S_ISLNK(found.st_mode):
            return target
        if found.st_uid not in (0, os.geteuid()):
            line = f"{target}: is a symbolic link of {_user(found.st_uid)}'s, not followed. Name the file it leads to"
            raise ConfigError(path, [line])
        target = target.parent / target.readlink()
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))


def _locked(path: Path, name: str, directory: int, *, create: bool) -> tuple[int, bool]:
    """The file, open and ours alone, and whether it was made here.

    A POSIX lock asks for a descriptor that may write: who may only read the file can hold nobody up.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    give_up_s = time.monotonic() + LOCK_WAIT_S
    while True:
        made = False
        try:
            file = os.open(name, flags, dir_fd=directory)
        except FileNotFoundError:
            if not create:
                raise
            try:
                file, made = os.open(name, flags | os.O_CREAT | os.O_EXCL, 0o600, dir_fd=directory), True
            except FileExistsError:
                continue
        try:
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise ConfigError(path, [f"{path}: is no regular file. Name another with --config"])
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if made:
                _inherit(file, directory)
            if _is_at(file, name, directory):
                return file, made
        except BlockingIOError:
            if time.monotonic() > give_up_s:
                line = f"{path}: another program has been changing it for {LOCK_WAIT_S:g} s. Try again when it is done"
                raise ConfigError(path, [line]) from None
            time.sleep(LOCK_POLL_S)
        except BaseException:
            if made:
                os.unlink(name, dir_fd=directory)
            os.close(file)
            raise
        os.close(file)


def _is_at(file: int, name: str, directory: int) -> bool:
    """Whether the name still is the open file's: the writer before us may have put another in its place."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(name, dir_fd=directory, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _inherit(file: int, directory: int) -> None:
    """A new file may be read by whom its directory is for, whatever umask root has: the daemon must get at it."""
    around = os.fstat(directory)
    if os.geteuid() == 0:
        os.fchown(file, around.st_uid, around.st_gid)
    os.fchmod(file, stat.S_IMODE(around.st_mode) & 0o644)


def _own(file: int, was: os.stat_result, path: Path) -> None:
    now = os.fstat(file)
    if (now.st_uid, now.st_gid) == (was.st_uid, was.st_gid):
        return
    try:
        os.fchown(file, was.st_uid, was.st_gid)
    except PermissionError:
        line = (
            f"{path}: belongs to {_user(was.st_uid)}:{_group(was.st_gid)}, which only root can keep. Run it with sudo"
        )
        raise ConfigError(path, [line]) from None


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"uid {number}"


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return f"gid {number}"


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """The system's refusals as one line with place, cause and remedy; the place in every line."""
    try:
        yield
    except ConfigError as error:
        lines = [line if str(path) in line else f"{path}: {line}" for line in error.problems]
        raise ConfigError(path, lines) from None
    except OSError as error:
        number = error.errno or 0
        begin = f"Make it first: graderd config init {path}" if number == errno.ENOENT else ""
        remedy = begin or _REMEDIES.get(number, "Look at the file and its directory")
        line = f"{path}: cannot be written ({error.strerror}); it is as it was. {remedy}"
        raise ConfigError(path, [line]) from None
