"""The commissioning record: what was done and measured on this machine before it was used, when, by whom, with what.

One JSON file beside the configuration. Each step of ``graderd setup`` is kept with what it found and with the values of
the configuration that it rests on: where one of those changes, the step counts as not done. A signature is a name, a
time and a digest of everything above it; it says who answers for the record, and whether somebody has changed it since.
It is no proof against forgery: whoever may write the file may sign it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from graderd.hal.errors import DeviceError

NAME: Final = "commissioning.json"
Values = Mapping[str, Any]


class RecordError(DeviceError):
    """The record cannot be read or written."""


def digest(values: Any) -> str:
    """SHA-256 of a value as canonical JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, ensure_ascii=False).encode()).hexdigest()


def picked(config: Values, keys: Sequence[str]) -> dict[str, Any]:
    """The values of dotted ``keys`` in the configuration as ``graderd config show --json`` gives it; a key that is not
    there (another driver's section) is None."""
    found: dict[str, Any] = {}
    for key in keys:
        value: Any = config
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        found[key] = value
    return found


class Commissioning:
    """The record at ``path``, read if it is there, written whole at each change."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(self._content, dict) or not isinstance(self._content.get("steps", {}), dict):
                raise ValueError("no object with steps")
        except FileNotFoundError:
            self._content = {}
        except (OSError, ValueError) as error:
            raise RecordError(str(path), f"is no commissioning record ({error})", "Move it away") from None

    @property
    def steps(self) -> dict[str, Any]:
        """What was done, by step."""
        steps: dict[str, Any] = self._content.get("steps", {})
        return steps

    @property
    def signature(self) -> dict[str, str] | None:
        """Who signed, when, over which digest; None: nobody."""
        return self._content.get("signed")

    def is_done(self, step: str, config: Values) -> bool:
        """Whether the step was done, and everything it rests on is as it was."""
        done = self.steps.get(step)
        return done is not None and done["rests_on"] == picked(config, list(done["rests_on"]))

    def done(self, step: str, config: Values, rests_on: Sequence[str], found: Values) -> None:
        """Keep what a step found. A signature over what was there before is none any more."""
        entry = {"at": _now(), "found": dict(found), "rests_on": picked(config, rests_on)}
        self._write({"steps": {**self.steps, step: entry}})

    def sign(self, name: str, config_sha256: str) -> str:
        """Put a name under everything, with versions and the digest of the configuration (``Config.sha256``, which
        recordings carry too); returns the record's own digest."""
        body = {
            "steps": self.steps,
            "graderd": version("graderd"),
            "python": platform.python_version(),
            "kernel": platform.release(),
            "computer": platform.node(),
            "config_sha256": config_sha256,
        }
        sealed = digest(body)
        self._write({**body, "signed": {"by": name, "at": _now(), "sha256": sealed}})
        return sealed

    def is_as_signed(self) -> bool:
        """Whether nothing was changed since it was signed."""
        body = {name: value for name, value in self._content.items() if name != "signed"}
        return self.signature is not None and self.signature["sha256"] == digest(body)

    def _write(self, content: dict[str, Any]) -> None:
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            partial.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            os.replace(partial, self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise RecordError(
                str(self.path), f"cannot be written ({error.strerror})", "Name another: --record"
            ) from None
        self._content = content


def _now() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
