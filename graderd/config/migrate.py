"""Brings an older configuration file up to date: ``python -m graderd.config.migrate FILE``.

The package calls it at every upgrade. A file that is already up to date is not touched. Otherwise the former file is
kept beside it as ``NAME.YYYYMMDD-HHMMSS.bak``, comments and order survive, the result is checked before anything is
written, and the new file takes the old one's place in one step, with its owner and rights.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Mapping, MutableMapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.exceptions import TOMLKitError

from graderd.config.loader import ConfigError, parse
from graderd.config.models import Config

CURRENT_VERSION: Final[int] = Config.model_fields["version"].default

Document = MutableMapping[str, Any]
Step = Callable[[Document], list[str]]
"""Changes a document of one version into the next in place; returns a line for each change."""


def rename(document: Document, old: str, new: str) -> list[str]:
    """Move the value at the dotted place ``old`` to ``new``; nothing happens where there is none, or where both are.

    A table that is empty then goes too.
    """
    *old_path, old_key = old.split(".")
    *new_path, new_key = new.split(".")
    source = _table(document, old_path, create=False)
    if source is None or old_key not in source:
        return []
    target = _table(document, new_path, create=True)
    assert target is not None  # made where it was absent
    if new_key in target:
        return []
    target[new_key] = source.pop(old_key)
    if old_path and not source:
        parent = _table(document, old_path[:-1], create=False)
        assert parent is not None  # its table was found
        del parent[old_path[-1]]
    return [f"{old} is now {new}"]


def _table(document: Document, path: list[str], *, create: bool) -> Document | None:
    table: Any = document
    for name in path:
        if name not in table:
            if not create:
                return None
            table[name] = tomlkit.table()
        table = table[name]
        if not isinstance(table, MutableMapping):
            return None
    found: Document = table
    return found


STEPS: Final[Mapping[int, Step]] = {}
"""From each version to the next; none, as long as there has been one format only."""


def migrate_text(text: str, steps: Mapping[int, Step] = STEPS, current: int = CURRENT_VERSION) -> tuple[str, list[str]]:
    """The file's text brought up to ``current``, and a line for each change; the same text where nothing is to do.

    Raises:
        ConfigError: not TOML, or of a version nobody here knows.
    """
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise ConfigError(None, [f"not valid TOML: {error}. Correct that line"]) from None
    except RecursionError:
        raise ConfigError(None, ["nested far too deeply to be a configuration. Restore the file"]) from None
    version = document.get("version", current)
    if not isinstance(version, int) or version > current or any(v not in steps for v in range(int(version), current)):
        raise ConfigError(
            None,
            [f"version: {version} is not one of {[*sorted(steps), current]}. Was the file made by a newer graderd?"],
        )
    changes: list[str] = []
    for number in range(version, current):
        changes += steps[number](document)
        document["version"] = number + 1
    return (tomlkit.dumps(document) if version < current else text), changes


def migrate_file(path: Path, steps: Mapping[int, Step] = STEPS) -> tuple[Path | None, list[str]]:
    """Bring ``path`` up to date; returns the backup's path (None where nothing was to do) and the changes.

    Raises:
        ConfigError: unreadable, or the result would not be a valid configuration; the file is as it was.
    """
    try:
        old = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(path, [f"{path}: cannot be read ({error}). Check the file"]) from None
    try:
        new, changes = migrate_text(old, steps)
        parse(tomlkit.parse(new).unwrap(), path, new)
    except ConfigError as error:
        raise ConfigError(path, [line if str(path) in line else f"{path}: {line}" for line in error.problems]) from None
    if new == old:
        return None, []
    backup = path.with_name(f"{path.name}.{datetime.now(UTC):%Y%m%d-%H%M%S}.bak")
    shutil.copy2(path, backup)
    temporary = path.with_name(f".{path.name}.new")
    temporary.write_text(new, encoding="utf-8")
    shutil.copystat(path, temporary)
    was = path.stat()
    os.chown(temporary, was.st_uid, was.st_gid)
    os.chown(backup, was.st_uid, was.st_gid)
    temporary.replace(path)
    return backup, changes


def main() -> int:
    """Command line: one file. Status 0 when it is up to date afterwards, 2 when it cannot be brought there."""
    path = Path(sys.argv[1])
    try:
        backup, changes = migrate_file(path)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    if backup is not None:
        sys.stdout.write(f"{path}: brought to version {CURRENT_VERSION}; the former file is {backup}\n")
        sys.stdout.writelines(f"  {change}\n" for change in changes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
