"""Reads a configuration file, checks it strictly, and says in one line per mistake where it is and what to write."""

from __future__ import annotations

import codecs
import difflib
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Tag, ValidationError

from graderd import places
from graderd.config.models import Config
from graderd.hal.settings import Settings

S = TypeVar("S", bound=Settings)

_MARKS = {codecs.BOM_UTF8: "a byte order mark", codecs.BOM_UTF16_LE: "UTF-16 text", codecs.BOM_UTF16_BE: "UTF-16 text"}


class ConfigError(Exception):
    """The configuration cannot be used; each line of ``problems`` names the place, the cause and the remedy."""

    def __init__(self, path: Path | None, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.path = path
        self.problems = problems


def load(path: Path | None = None) -> Config:
    """Read ``path``, or the one that is meant (:func:`graderd.places.config`) where it is there, or take the defaults.

    Raises:
        ConfigError: unreadable, not TOML, or not a valid configuration.
    """
    wanted = path or places.config()
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
        raise ConfigError(path, explain(error, Config, where=where, text=text)) from None


def parse_section(name: str, section: Settings, model: type[S]) -> S:
    """A section of the configuration as ``model`` takes it: for a driver from elsewhere, which brings its own.

    Raises:
        ConfigError: as :func:`parse`.
    """
    try:
        return model.model_validate(section.model_dump())
    except ValidationError as error:
        raise ConfigError(None, explain(error, model, (name,))) from None


def explain(
    error: ValidationError,
    model: type[BaseModel],
    under: tuple[str, ...] = (),
    *,
    where: str = "configuration",
    text: str = "",
    file: str = "configuration",
) -> list[str]:
    """One line per mistake. ``under``: where in the file ``model`` belongs; ``file``: what kind of file that is."""
    return [_explain(dict(each), model, list(under), where, text, file) for each in error.errors()]


def _explain(error: dict[str, Any], model: type[BaseModel], under: list[str], where: str, text: str, file: str) -> str:
    inner, parent = _place_of([str(part) for part in error["loc"]], model)
    location = under + inner
    name = _dotted(location)
    line = _line_of(text, location)
    place = f"{where}:{line}" if line else where
    if error["type"] == "extra_forbidden":
        near = difflib.get_close_matches(location[-1], list(parent.model_fields) if parent else [], n=1, cutoff=0.5)
        remedy = f"Did you mean {_dotted([*location[:-1], near[0]])}?" if near else "Remove it"
        return f"{place}: {name}: unknown key. {remedy}"
    cause = error["msg"].removeprefix("Value error, ")
    given = "" if isinstance(error["input"], dict) else f" (given: {error['input']!r})"
    return f"{place}: {name or file}: {cause}{given}"


def _dotted(location: list[str]) -> str:
    return ".".join(location)


def _line_of(text: str, location: list[str]) -> int:
    """Line number of the key, or of what it belongs in, 0 where it cannot be told. TOML parsers keep none, so the text
    is searched."""
    key, table = location[-1] if location else "", _dotted(location[:-1])
    current = ""
    lengths: dict[str, int] = {}  # of the arrays of tables so far, as far as this line
    for number, raw in enumerate(text.split("\n"), 1):
        line = raw.strip()
        if line.startswith("["):
            *above, last = line.partition("#")[0].strip("[] ").split(".")
            current = ""
            for part in above:
                current += part
                current += f"[{lengths[current]}]." if current in lengths else "."
            current += last
            if line.startswith("[["):
                lengths[current] = lengths.get(current, 0) + 1
                current += f"[{lengths[current]}]"
            if current == _dotted(location):
                return number
        elif current == table and line.split("=")[0].strip().strip('"') == key.partition("[")[0]:
            return number
    return _line_of(text, location[:-1]) if len(location) > 1 else 0


def _place_of(parts: list[str], model: type[BaseModel] | None) -> tuple[list[str], type[BaseModel] | None]:
    """Keys on the way to a mistake, and the model that the last of them belongs to.

    Where a section has several models, pydantic names the tag of the one it took after the section's key; a file has
    no such word. The elements of a list are counted from 1: ``trial[2]`` is the second.
    """
    location: list[str] = []
    while parts:
        if location and parts[0].isdecimal():
            location[-1] += f"[{int(parts.pop(0)) + 1}]"
            continue
        location.append(parts.pop(0))
        if not parts:
            break
        field = model.model_fields.get(location[-1]) if model else None
        models = _models_in(field.annotation) if field else {}
        model = models[parts.pop(0)] if len(models) > 1 and parts[0] in models else next(iter(models.values()), None)
    return location, model


def _models_in(annotation: Any) -> dict[str, type[BaseModel]]:
    """The models that may stand somewhere, by their tag; one without a tag by its name."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation.__name__: annotation}
    if typing.get_origin(annotation) is typing.Annotated:
        inner, *notes = typing.get_args(annotation)
        tag = next((note.tag for note in notes if isinstance(note, Tag)), None)
        return {tag or name: model for name, model in _models_in(inner).items()}
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, list, tuple):
        return {name: model for each in typing.get_args(annotation) for name, model in _models_in(each).items()}
    return {}
