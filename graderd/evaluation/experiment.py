"""The experiment file (TOML): which scans belong to which trial, and what is to be measured."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from graderd.config.loader import ConfigError, decode, explain
from graderd.core.blade import BladeGeometry
from graderd.evaluation.depth_files import Axis, Edge
from graderd.evaluation.measures import Spread

MEASURE_NAME = re.compile(r"^[a-z][a-z0-9_]*_(mm|l|l_per_m|n|s|percent)$")
_BLADE = BladeGeometry()

Range = tuple[float, float]
T = TypeVar("T")


def _at_least_one(value: tuple[T, ...]) -> tuple[T, ...]:
    if not value:
        raise ValueError("at least one belongs here")
    return value


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Trial(_Model):
    """One pass. File names count from the experiment file and may be patterns; several files are repeated scans."""

    angle_deg: Annotated[float, Field(ge=-90, le=90)]
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    blade_x_mm: float | None = None
    """Where the blade's axis stood at the end of the pass: the soil still carried is told apart by it."""
    blade_y_mm: float = 0.0
    load_csv: str = ""
    """A recording of the blade's load with a heading; ``load_column`` names the column, newtons."""
    load_column: str = "load_n"
    measured: dict[str, float] = {}
    """What was measured by other means, with its unit in the name: ``blade_load_n``, ``spread_mm``."""

    @field_validator("measured")
    @classmethod
    def _named_with_unit(cls, value: dict[str, float]) -> dict[str, float]:
        for name in value:
            if not MEASURE_NAME.match(name):
                raise ValueError(
                    f"{name!r} is no measure with its unit: small letters, ending in _mm, _l, _n, _s, _percent"
                )
        return value

    @model_validator(mode="after")
    def _has_something(self) -> Self:
        if not (self.after or self.measured or self.load_csv):
            raise ValueError("nothing to evaluate; name scans in 'after', a 'load_csv', or values in 'measured'")
        if self.before and not self.after:
            raise ValueError("'before' without 'after' tells nothing; name the scans after the pass in 'after'")
        return self


class Area(_Model):
    """The part of the bed that is looked at, in the bed frame: origin at the foot of the sensor, x forward, y left."""

    x_mm: Range | None = None
    y_mm: Range | None = None

    @field_validator("x_mm", "y_mm")
    @classmethod
    def _in_order(cls, value: Range | None) -> Range | None:
        if value is not None and value[0] >= value[1]:
            raise ValueError("write the smaller end first")
        return value


class Case(_Model):
    """One kind of work on one distribution of soil: a block of rows in the table."""

    name: Annotated[str, Field(min_length=1, max_length=120)]
    work: Literal["flattening", "scattering"]
    target_height_mm: float | None = None
    """Flattening: the target plane's height above the ground."""
    layer: Area | None = None
    """Flattening: the part whose height is judged, where the work went over no more of it; the experiment's ``area``
    otherwise."""
    trial: tuple[Trial, ...]

    _some = field_validator("trial")(_at_least_one)

    @model_validator(mode="after")
    def _has_a_target(self) -> Self:
        if self.work == "flattening" and self.target_height_mm is None and any(trial.after for trial in self.trial):
            raise ValueError("flattening is judged against a plane; set target_height_mm, its height above the ground")
        return self


class Experiment(_Model):
    """The whole file."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    camera: str = ""
    """The camera file of the depth pictures; empty: the ``camera.json`` beside each of them."""
    ground: tuple[str, ...] = ()
    """Scans of the empty bed from the same place; empty: the ground is found in every state's own scans."""
    travel: Edge = "up"
    """Which edge of the depth pictures lies forward."""
    cloud_up: Axis = "+z"
    cloud_travel: Axis = "+x"
    cell_mm: Annotated[float, Field(ge=2, le=200)] = 10.0
    edge_mm: Annotated[float, Field(gt=0, le=200)] = 10.0
    """Soil counts from this height."""
    spread: tuple[Spread, ...] = (Spread.EXTREME,)
    confidence_percent: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    blade_length_mm: Annotated[float, Field(gt=0)] = _BLADE.length_m * 1000.0
    blade_reach_mm: Annotated[float, Field(gt=0)] = _BLADE.reach_m * 1000.0
    """Soil from the blade's face to this distance ahead is carried."""
    area: Area = Area()
    case: tuple[Case, ...]

    _some = field_validator("spread", "case")(_at_least_one)

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [case.name for case in self.case]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two cases are named {twice!r}; give each its own name")
        if self.cloud_up[1] == self.cloud_travel[1]:
            raise ValueError("cloud_up and cloud_travel name the same axis")
        return self


def load(path: Path) -> Experiment:
    """Read an experiment file.

    Raises:
        ConfigError: unreadable, not TOML, or not an experiment; each line of ``problems`` names the place, the cause
        and
            the remedy.
    """
    try:
        text = decode(path.read_bytes(), path)
    except OSError as error:
        raise ConfigError(
            path, [f"{path}: cannot be read ({error.strerror}). Name an experiment file (TOML)"]
        ) from None
    try:
        return Experiment.model_validate(tomllib.loads(text))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(path, [f"{path}: not valid TOML: {error}. Correct that line"]) from None
    except ValidationError as error:
        raise ConfigError(path, explain(error, Experiment, where=str(path), text=text, file="experiment")) from None
