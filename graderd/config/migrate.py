"""Brings an older configuration file up to date: ``python -m graderd.config.migrate FILE``.

The package calls it at every upgrade. A file that is already up to date is not touched. Otherwise the former file is
kept beside it, comments and order survive, and :mod:`graderd.config.rewrite` sees to the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, MutableMapping
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.exceptions import TOMLKitError

from graderd.config.loader import ConfigError
from graderd.config.models import Config
from graderd.config.rewrite import rewrite

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


# Version 1 told limits, speeds and tolerances in up to three places; the machine did what the narrowest of them said.
# Place in version 2 -> which of the values counts, and where they stood in version 1 with their defaults there.
_Sources = tuple[tuple[str, float], ...]
_MERGED: Final[Mapping[str, tuple[Callable[[list[float]], float], _Sources]]] = {
    "rotation.min_deg": (max, (("gate.rotation_min_deg", -60.0), ("rotation.min_deg", -60.0))),
    "rotation.max_deg": (min, (("gate.rotation_max_deg", 60.0), ("rotation.max_deg", 60.0))),
    "rotation.window_deg": (min, (("gate.rotation_window_deg", 120.0),)),
    "rotation.speed_deg_per_s": (
        min,
        (("gate.rotation_speed_deg_per_s", 25.0), ("rotation.velocity_deg_per_s", 30.0)),
    ),
    "rotation.acceleration_deg_per_s2": (
        min,
        (("gate.rotation_acceleration_deg_per_s2", 50.0), ("rotation.acceleration_deg_per_s2", 60.0)),
    ),
    "rotation.lead_deg": (min, (("gate.rotation_lead_deg", 10.0),)),
    "rotation.tolerance_deg": (min, (("control.rotation_tolerance_deg", 0.5), ("rotation.in_position_deg", 0.5))),
    "rotation.max_age_s": (min, (("control.rotation_max_age_s", 0.2),)),
    **{
        f"{axis}.{name}": (choose, sources)
        for axis, part, low_mm, high_mm in (
            ("lift_left", "lift", 5.0, 295.0),
            ("lift_right", "lift", 5.0, 295.0),
            ("tilt", "tilt", 3.0, 97.0),
        )
        for name, choose, sources in (
            ("min_mm", max, ((f"gate.{part}_min_mm", low_mm), (f"{axis}.min_mm", low_mm))),
            ("max_mm", min, ((f"gate.{part}_max_mm", high_mm), (f"{axis}.max_mm", high_mm))),
            ("window_mm", min, ((f"gate.{part}_window_mm", 0.0),)),
            ("speed_mm_per_s", min, ((f"gate.{part}_speed_mm_per_s", 0.0),)),
            ("acceleration_mm_per_s2", min, ((f"gate.{part}_acceleration_mm_per_s2", 0.0),)),
            ("lead_mm", min, ((f"gate.{part}_lead_mm", 0.0),)),
            ("tolerance_mm", min, (("control.actuator_tolerance_mm", 0.0),)),
            ("max_age_s", min, (("control.actuator_max_age_s", 0.0),)),
        )
    },
}
_DROPPED: Final[Mapping[str, str]] = {"recording.rate_hz": "every tick is recorded"}
"""What version 2 has no more use for, and why."""
_GONE_IN_2: Final = frozenset(old for _, sources in _MERGED.values() for old, _ in sources) - set(_MERGED) | set(
    _DROPPED
)


def _to_2(document: Document) -> list[str]:
    """One source for each limit, speed and tolerance: the section of the device."""
    changes = []
    for new, (choose, sources) in _MERGED.items():
        given = {old: value for old, _ in sources if (value := _get(document, old)) is not None}
        values = [given.get(old, default) for old, default in sources]
        if not given or not all(isinstance(value, int | float) for value in values):
            continue  # nothing to move; or no number, which the check of the result tells
        value = choose(values)
        if _get(document, new) != value:
            _set(document, new, value)
        if set(given) != {new} or given[new] != value:
            changes.append(f"{' and '.join(given)}: now {new} = {value:g}")
    changes += [f"{old} is gone: {why}" for old, why in _DROPPED.items() if _get(document, old) is not None]
    for old in sorted(_GONE_IN_2):
        _drop(document, old)
    return changes


def _get(document: Document, place: str) -> Any:
    *path, key = place.split(".")
    table = _table(document, path, create=False)
    return None if table is None else table.get(key)


def _set(document: Document, place: str, value: Any) -> None:
    *path, key = place.split(".")
    table = _table(document, path, create=True)
    if table is not None:
        table[key] = value


def _drop(document: Document, place: str) -> None:
    """Take a key away, and its table where that was the last one."""
    *path, key = place.split(".")
    table = _table(document, path, create=False)
    if table is None or key not in table:
        return
    del table[key]
    if path and not table:
        parent = _table(document, path[:-1], create=False)
        assert parent is not None  # its table was found
        del parent[path[-1]]


STEPS: Final[Mapping[int, Step]] = {1: _to_2}
"""From each version to the next."""


def _version_of(document: Document) -> Any:
    """What the document says; one that says nothing is of the present version unless it has keys that are gone."""
    if "version" in document:
        return document["version"]
    return 1 if any(_get(document, old) is not None for old in _GONE_IN_2) else CURRENT_VERSION


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
    version = document.get("version", current) if steps is not STEPS else _version_of(document)
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
    changes: list[str] = []

    def migrated(text: str) -> str:
        new, changes[:] = migrate_text(text, steps)
        return new

    return rewrite(path, migrated), changes


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
