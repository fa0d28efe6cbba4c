"""Cases from files: one case, or a sweep over some of its fields."""

from __future__ import annotations

import tomllib
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from graderd.studies.blade_rotation import case as named
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.engine import StudyError

BLADES = {"full_size": named.FULL_SIZE, "quarter_size": named.QUARTER_SIZE}
PILES = {"scattered": named.SCATTERED, "layer_across": named.LAYER_ACROSS, "layer_along": named.LAYER_ALONG}


def load(path: Path) -> Case:
    """One case. ``blade`` and ``pile`` are tables, or names of :data:`BLADES` and :data:`PILES`.

    Raises:
        StudyError: the file is missing or wrong.
    """
    return _case(_read(path), str(path))


def load_sweep(path: Path) -> list[Case]:
    """All cases of a sweep: the table ``case`` with each combination of the lists in the table ``sweep``.

    Raises:
        StudyError: the file is missing or wrong.
    """
    data = _read(path)
    if set(data) != {"case", "sweep"} or not all(isinstance(each, list) and each for each in data["sweep"].values()):
        raise StudyError(str(path), "a sweep has the tables case and sweep, and lists in the latter", "See the docs")
    names = list(data["sweep"])
    return [
        _case(data["case"] | dict(zip(names, values, strict=True)), str(path))
        for values in product(*data["sweep"].values())
    ]


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(str(path), f"cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise StudyError(str(path), f"is no TOML: {error}") from None


def _case(data: dict[str, Any], where: str) -> Case:
    for field, known in (("blade", BLADES), ("pile", PILES)):
        if isinstance(name := data.get(field), str):
            if name not in known:
                raise StudyError(where, f"{field}: nothing is named {name!r}", f"Name one of {', '.join(known)}")
            data = data | {field: known[name]}
    try:
        return Case.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "case"
        raise StudyError(where, f"{place}: {first['msg'].removeprefix('Value error, ')}", "See the docs") from None
