"""Every number in the configuration and in the status says its unit in its name."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterator

import pytest
from pydantic import BaseModel

from graderd.config import Config
from graderd.core.status import Status

UNITS = re.compile(
    r"_(deg|deg_per_s|deg_per_s2|deg_per_mm|mm|mm_per_s|mm_per_s2|m|s|ms|us|hz|a|v|c|n|px|l|mb|k|nm|mw|percent|ratio|share|per_s)$"
)
DIMENSIONLESS = {"share_left", "share_center", "share_right", "confidence", "min_confidence", "thermal_load"} | {
    "gain",
    "depth_gain",
}
UNIT_BESIDE = {"requested", "limited", "sent", "measured"}
"""AxisStatus: the unit stands in the field ``unit`` of the same object, because an axis is in deg or mm."""
EXEMPT = {"Config.version", "Intrinsics"}


def models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from models_in(argument)


def is_number(annotation: object) -> bool:
    if annotation in (int, float):
        return True
    if typing.get_origin(annotation) is typing.Literal:
        return False
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, typing.Annotated, tuple, list):
        return any(is_number(argument) for argument in typing.get_args(annotation))
    return False


def numeric_fields(model: type[BaseModel], seen: set[type[BaseModel]]) -> Iterator[str]:
    if model in seen:
        return
    seen.add(model)
    for name, field in model.model_fields.items():
        if is_number(field.annotation):
            yield f"{model.__name__}.{name}"
        for inner in models_in(field.annotation):
            yield from numeric_fields(inner, seen)


FIELDS = sorted({*numeric_fields(Config, set()), *numeric_fields(Status, set())} - EXEMPT)


def test_the_walk_finds_the_fields() -> None:
    assert len(FIELDS) > 150
    assert "Ph54Settings.speed_deg_per_s" in FIELDS
    assert "FaultStatus.age_s" in FIELDS


@pytest.mark.parametrize("field", FIELDS)
def test_number_says_its_unit(field: str) -> None:
    model, name = field.split(".")
    assert UNITS.search(name) or name in DIMENSIONLESS or (model == "AxisStatus" and name in UNIT_BESIDE)
