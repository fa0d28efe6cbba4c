"""Every number in the configuration and in the status says its unit in its name, and what was measured its validity."""

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


OF_THE_TICK = {
    "AxisStatus": {"requested", "limited", "arrived", "counters"},
    "AheadStatus": {"confidence"},
    "SoilStatus": {"confidence", "frames_per_s"},
    "DecisionStatus": {"angle_deg", "kept", "since_m", "decisions_n"},
    "FaultStatus": {"present"},
    "RequirementStatus": {"met", "mandatory"},
    "LeaseStatus": {"remaining_s"},
    "CameraStatus": {"frames_n", "restarts_n"},
    "TickStatus": {"rate_hz", "ticks_n", "overruns_n", "lateness_p99_ms"},
    "RecordingStatus": {"run", "incident", "waiting_n", "lost_n"},
    "Status": {"time_s", "simulated", "arming", "stop_n"},
}
"""What the daemon decided, counted or was told itself, and knows at ``time_s``."""
AGED_BY = {
    "AxisStatus": "ages_s",
    "AttitudeStatus.height_mm": "lifts_age_s",
    "AttitudeStatus.slope_deg": "lifts_age_s",
    "AttitudeStatus.pitch_deg": "pitch_age_s",
    "SoilStatus": "age_s",
    "ThirdsStatus": "",  # part of SoilStatus, which is null where it is not known
    "AheadStatus": "",  # likewise
    "VehicleStatus.speed_m_per_s": "age_s",
    "VehicleStatus.travelled_m": "travelled_age_s",
    "CameraStatus.settings_read_back": "settings_age_s",
}
"""Where the age of a measured value stands, by model or field."""


def _status_models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        for inner in models_in(field.annotation):
            yield from _status_models(inner)


def _values(model: type[BaseModel]) -> Iterator[tuple[str, object]]:
    """What has a value that may be wrong by now: numbers, truths, and the device's own words."""
    for name, field in model.model_fields.items():
        arguments = {field.annotation, *typing.get_args(field.annotation)}
        if is_number(field.annotation) or bool in arguments or {int, float} & arguments or name == "flags":
            yield name, field


STATUS_VALUES = sorted(
    {(model, name) for model in {*_status_models(Status)} for name, _ in _values(model)},
    key=lambda m: (str(m[0]), m[1]),
)


@pytest.mark.parametrize(("model", "name"), STATUS_VALUES, ids=lambda part: getattr(part, "__name__", part))
def test_what_was_measured_is_null_where_it_is_not_known_and_has_an_age(model: type[BaseModel], name: str) -> None:
    if name.endswith("age_s") or name == "ages_s" or name in OF_THE_TICK.get(model.__name__, set()):
        return
    aged_by = AGED_BY.get(f"{model.__name__}.{name}", AGED_BY.get(model.__name__))
    assert aged_by is not None, "say in this file where its age stands, or that it is of the tick"
    if not aged_by or (model.__name__, name) == ("SoilStatus", "frame_number_n"):
        return
    assert aged_by in model.model_fields
    default = model.model_fields[name].get_default()
    assert default in (None, {}), "a value that nobody measured is not told"
