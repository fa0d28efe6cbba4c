"""Device facts as data: one TOML file per model (control table or CAN layout), looked up by name, or by path.

The package holds no behaviour: drivers read what they need from the plain dictionaries returned here. A JSON schema
beside the files (``*.schema.json``) says what a file must contain; the tests check every file against its schema.
"""

from __future__ import annotations

import difflib
import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

__all__ = ["UnknownProfileError", "load", "names"]


class UnknownProfileError(LookupError):
    """No profile of that name; the message names the nearest one and all there are. Or its file is none."""


def names() -> tuple[str, ...]:
    """Names of all profiles, sorted."""
    return tuple(sorted(f.name.removesuffix(".toml") for f in files(__name__).iterdir() if f.name.endswith(".toml")))


def load(name: str) -> dict[str, Any]:
    """The profile ``name`` (file name without ``.toml``) as a dictionary; a fresh copy on every call.

    One that ends with ``.toml`` is the path of a file elsewhere, such as ``graderd profile import`` writes.

    Raises:
        UnknownProfileError: there is no such profile, or its file is not readable or no TOML.
    """
    if not name.endswith(".toml"):
        return tomllib.loads(_text(name))
    remedy = "Write it with 'graderd profile import'"
    try:
        return tomllib.loads(Path(name).read_text(encoding="utf-8"))
    except OSError as error:
        raise UnknownProfileError(f"firmware profile {name}: {error.strerror}. {remedy}") from None
    except ValueError as error:
        raise UnknownProfileError(f"firmware profile {name}: {error}. {remedy}") from None


@cache
def _text(name: str) -> str:
    known = names()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise UnknownProfileError(f"no firmware profile {name!r}{hint} Known: {', '.join(known)}")
    return (files(__name__) / f"{name}.toml").read_text(encoding="utf-8")
