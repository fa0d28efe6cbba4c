"""Reads a configuration file, checks it strictly, and says in one line per mistake where it is and what to write."""

from __future__ import annotations

import codecs
import difflib
import tomllib
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from graderd import places
from graderd.config.models import Config

_MARKS = {codecs.BOM_UTF8: "a byte order mark", codecs.BOM_UTF16_LE: "UTF-16 text", codecs.BOM_UTF16_BE: "UTF-16 text"}


class ConfigError(Exception):
    """The configuration cannot be used; each line of ``problems`` names the place, the cause and the remedy."""

    def __init__(self, path: Path | None, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.path = path
        self.problems = problems


def load(path: Path | None = None) -> Config:
    """Read ``path``, or the default path where a file is there, or take the defaults.

    Raises:
        ConfigError: unreadable, not TOML, or not a valid configuration.
    """
    wanted = path or places.CONFIG
    try:
        raw = wanted.read_bytes()
    except FileNotFoundError as error:
        if path is None:
            return Config()
        raise _unreadable(wanted, error, "Name another file with --config") from None
    except PermissionError as error:
        remedy = "Run it as root or as a member of the file's group, or name another file with --config"
        raise _unreadable(wanted, error, remedy) from None
    except OSError as error:
        raise _unreadable(wanted, error, "Name another file with --config") from None
    return parse_text(decode(raw, wanted), wanted)


def _unreadable(path: Path, error: OSError, remedy: str) -> ConfigError:
    return ConfigError(path, [f"{path}: cannot be read ({error.strerror}). {remedy}"])


def decode(raw: bytes, path: Path) -> str:
    """The file's text, its line ends as ``\\n``.

    Raises:
        ConfigError: not UTF-8, begins with a byte order mark, or has the line ends of an old Macintosh.
    """
    for mark, name in _MARKS.items():
        if raw.startswith(mark):
            raise ConfigError(path, [f"{path}:1: begins with {name}, not TOML. Save it as UTF-8 without such a mark"])
    try:
        text = raw.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(path, [f"{path}:{line}: not UTF-8 text at byte {error.start}. Save it as UTF-8"]) from None
    if "\r" in text:
        line = text.count("\n", 0, text.index("\r")) + 1
        cause = "a carriage return without a line feed, which ends no line in TOML"
        raise ConfigError(path, [f"{path}:{line}: {cause}. Save it with the line ends of Unix or Windows"])
    return text


def parse_text(text: str, path: Path) -> Config:
    """Check the text of a configuration file.

    Raises:
        ConfigError: not TOML, or not a valid configuration.
    """
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
    for number, raw in enumerate(text.split("\n"), 1):
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
