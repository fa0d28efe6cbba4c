"""Reads a configuration file, checks it strictly, and says in one line per mistake where it is and what to write."""

from __future__ import annotations

import difflib
import tomllib
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from graderd.config.models import Config

DEFAULT_PATHS = (Path("/etc/graderd/graderd.toml"),)


class ConfigError(Exception):
    """The configuration cannot be used; each line of ``problems`` names the place, the cause and the remedy."""

    def __init__(self, path: Path | None, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.path = path
        self.problems = problems


def load(path: Path | None = None) -> Config:
    """Read ``path``, or the first of the default paths that exists, or take the defaults.

    Raises:
        ConfigError: unreadable, not TOML, or not a valid configuration.
    """
    if path is None:
        path = next((p for p in DEFAULT_PATHS if p.exists()), None)
        if path is None:
            return Config()
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            path, [f"{path}: cannot be read ({error.strerror}). Name another file with --config"]
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigError(path, [f"{path}: not UTF-8 text at byte {error.start}. Save it as UTF-8"]) from None
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(path, [f"{path}: not valid TOML: {error}. Correct that line"]) from None
    except RecursionError:
        raise ConfigError(path, [f"{path}: nested far too deeply to be a configuration. Restore the file"]) from None
    return parse(data, path, text)


def parse(data: dict[str, Any], path: Path | None = None, text: str = "") -> Config:
    """Check a parsed configuration.

    Raises:
        ConfigError: with one line per mistake, unknown keys with the nearest right one.
    """
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        where = str(path) if path else "configuration"
        raise ConfigError(path, [_explain(where, text, dict(e)) for e in error.errors()]) from None


def _explain(where: str, text: str, error: dict[str, Any]) -> str:
    location = [str(part) for part in error["loc"]]
    name = _dotted(location)
    line = _line_of(text, location)
    place = f"{where}:{line}" if line else where
    if error["type"] == "extra_forbidden":
        near = difflib.get_close_matches(location[-1], _known_keys(location[:-1]), n=1, cutoff=0.5)
        remedy = f"Did you mean {_dotted([*location[:-1], near[0]])}?" if near else "Remove it"
        return f"{place}: {name}: unknown key. {remedy}"
    cause = error["msg"].removeprefix("Value error, ")
    given = "" if isinstance(error["input"], dict) else f" (given: {error['input']!r})"
    return f"{place}: {name or 'configuration'}: {cause}{given}"


def _dotted(location: list[str]) -> str:
    return ".".join(location)


def _line_of(text: str, location: list[str]) -> int:
    """Line number of the key, 0 where it cannot be told. TOML parsers keep none, so the text is searched."""
    key, table = location[-1] if location else "", _dotted(location[:-1])
    current = ""
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if line.startswith("["):
            current = line.strip("[]").strip()
            if current == _dotted(location):
                return number
        elif current == table and line.split("=")[0].strip().strip('"') == key:
            return number
    return 0


def _known_keys(location: list[str]) -> list[str]:
    """Keys allowed at a place of the configuration."""
    model: type[BaseModel] | None = Config
    for part in location:
        if model is None or part not in model.model_fields:
            return []
        model = _model_in(model.model_fields[part].annotation)
    return list(model.model_fields) if model else []


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return next((m for a in typing.get_args(annotation) if (m := _model_in(a))), None)
    return None
