"""The configuration file a fresh installation starts with: every key with its meaning and its default.

``graderd config init``, or ``python -m graderd.config.template FILE`` for the package. Made from the models, so it
cannot fall behind them. Defaults stand as comments: a key somebody sets is one they meant to set, and a better default
reaches everybody else with an upgrade.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import tomlkit
from pydantic import BaseModel

from graderd import places
from graderd.config.loader import parse
from graderd.config.models import Config

HEAD = """\
# graderd's configuration. Read at start: after a change end the daemon and start it again, which begins disarmed (an
# installed one: `systemctl restart graderd`).
# A line that starts with #key shows a default: take the # away to set something else. Unknown keys are errors.
# Names end in their unit: _deg _mm _m _s _hz _a _v _c _px, _n for counts and addresses. Left and right are the
# operator's, facing forward. First steps on a machine: /usr/share/doc/graderd, or man graderd.

"""


def _begun_with(state: Path) -> dict[str, Any]:
    """What differs from the defaults: a daemon whose files are at ``state``. The service has that from systemd, but for
    its recordings, which the commands look for without it."""
    own = {} if state == places.STATE else {"state.directory": str(state)}
    return {
        "version": Config.model_fields["version"].default,
        "recording.directory": str(state / "recordings"),
        **own,
    }


def sections(model: BaseModel, begun_with: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[str]:
    """The text of one table: its own keys first, then its sub-tables."""
    fields = type(model).model_fields
    tables = {name: getattr(model, name) for name in fields if isinstance(getattr(model, name), BaseModel)}
    absent = {
        name: section
        for name, field in fields.items()
        if getattr(model, name) is None and (section := _by_defaults(field.annotation)) is not None
    }
    plain = {name: field for name, field in fields.items() if name not in tables and name not in absent}
    if path:
        summary = (type(model).__doc__ or "").split("\n\n")[0].replace("``", "`")
        yield "".join(f"# {line}\n" for line in textwrap.wrap(" ".join(summary.split()), 116))
        # A table that is only whole with all its keys stands in comments with them.
        whole = any(field.is_required() for field in plain.values())
        yield f"{'#' if whole else ''}[{'.'.join(path)}]\n"
    for name, field in plain.items():
        # A section that is present starts from its class: what this instance has otherwise must be set.
        own = not field.is_required() and getattr(model, name) != field.get_default(call_default_factory=True)
        dotted = ".".join((*path, name))
        if field.description:
            yield "".join(f"# {line}\n" for line in textwrap.wrap(field.description, 116))
        if dotted in begun_with:
            yield f"{name} = {_toml(begun_with[dotted])}\n"
        else:
            yield from _key(name, getattr(model, name), active=own)
    yield "\n"
    for name, value in tables.items():
        yield from sections(value, begun_with, (*path, name))
    for name, value in absent.items():
        yield re.sub(r"(?m)^(?=[^#\n])", "#", "".join(sections(value, begun_with, (*path, name))))


def _by_defaults(annotation: Any) -> BaseModel | None:
    """A section that is not there unless somebody asks for it, as its defaults make it; None where it has none."""
    models = [each for each in get_args(annotation) if isinstance(each, type) and issubclass(each, BaseModel)]
    if not models or any(field.is_required() for field in models[0].model_fields.values()):
        return None
    return models[0]()


def _key(name: str, value: Any, *, active: bool) -> Iterator[str]:
    if active:
        yield f"{name} = {_toml(_plain(value))}\n"
    elif value is None:
        yield f"# {name}: not set\n"
    elif isinstance(value, dict) and any(isinstance(item, BaseModel) for item in value.values()):
        for key, item in value.items():
            yield f"#{name}.{key} = {_toml(item.model_dump(mode='json', exclude_none=True))}\n"
    else:
        yield f"#{name} = {_toml(_plain(value))}\n"


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_none=True)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return str(tomlkit.item(value).as_string())


def template(state: Path = places.STATE) -> str:
    """The whole file, for a daemon that keeps its files at ``state``.

    Raises:
        ConfigError: the file, as it is or with every default taken out of its comment, would not be accepted.
    """
    text = HEAD + "".join(sections(Config(), _begun_with(state))).rstrip() + "\n"
    for variant in (text, re.sub(r"(?m)^#(?=[\w\[])", "", text)):
        parse(tomlkit.parse(variant).unwrap(), text=variant)
    return text


def begin(path: Path) -> None:
    """Write a file to begin with where none is, in a folder that may be new.

    Raises:
        FileExistsError: there is one; it is left as it is.
        OSError: it cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("x", encoding="utf-8") as made:
        made.write(template(places.state_of(path)))


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(template(), encoding="utf-8")
