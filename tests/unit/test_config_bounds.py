"""Every time, rate and speed that a safety function rests on has an upper bound, and detectors get what they need."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import annotated_types
import pytest
from pydantic import BaseModel, ValidationError

import hil.usb_guest
import tests.hil.conftest
from graderd.config import Config
from tests.unit.test_config_units import is_number, models_in

RESTS_ON = re.compile(r"_(s|hz|deg_per_s2?|mm_per_s2?)$")
WHOLE_SECTIONS = {
    "rotation",
    "lift_left",
    "lift_right",
    "tilt",
    "lift_pair",
    "machine",
    "control",
    "rule",
    "gate",
    "stop_input",
}
"""Every number here is one that a safety function rests on, whatever its unit."""
NO_BOUND_NEEDED = {
    "rotation.baud_n": "the servo's driver refuses what it cannot do",
    "stop_input.gpio_drive_n": "number of a line",
    "stop_input.gpio_sense_n": "number of a line",
}


def bounds(
    model: type[BaseModel], path: str = "", above: tuple[type[BaseModel], ...] = ()
) -> Iterator[tuple[str, Any]]:
    """Path of every number in the configuration, with its upper bound or None."""
    for name, field in model.model_fields.items():
        here = f"{path}.{name}" if path else name
        if is_number(field.annotation):
            upper = [
                m.le if isinstance(m, annotated_types.Le) else m.lt
                for m in field.metadata
                if isinstance(m, annotated_types.Le | annotated_types.Lt)
            ]
            yield here, upper[0] if upper else None
        for inner in models_in(field.annotation):
            if inner not in above:
                yield from bounds(inner, here, (*above, model))


BOUNDS: dict[str, Any] = {}
for _path, _bound in bounds(Config):
    if (RESTS_ON.search(_path) or _path.split(".")[0] in WHOLE_SECTIONS) and _path not in NO_BOUND_NEEDED:
        # a section may be one of several models: each of them needs the bound
        BOUNDS[_path] = None if _bound is None else BOUNDS.get(_path, _bound)


def config(**changes: Any) -> Config:
    """A configuration by dotted names."""
    tree: dict[str, Any] = {}
    for path, value in changes.items():
        *sections, name = path.split(".")
        node = tree
        for section in sections:
            node = node.setdefault(section, {})
        node[name] = value
    return Config.model_validate(tree)


def test_the_walk_finds_them() -> None:
    assert len(BOUNDS) > 90
    assert {"machine.lease_s", "tilt.speed_mm_per_s", "lift_pair.silent_s", "camera.stale_s"} <= BOUNDS.keys()


@pytest.mark.parametrize("path", sorted(BOUNDS))
def test_it_has_an_upper_bound_that_is_kept(path: str) -> None:
    bound = BOUNDS[path]
    assert bound is not None, f"{path} has no upper bound: name the largest value that is still safe, and why"
    if path.startswith(("api.tcp", "camera.calibration")):
        return
    for value in (int(bound) + 5, 10**9):
        with pytest.raises(ValidationError, match="less than"):
            config(**{path: value})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"machine.lease_s": 300}, "lease_s"),
        ({"rotation.goal_timeout_s": 100000}, "goal_timeout_s"),
        ({"rotation.speed_deg_per_s": 1e300}, "speed_deg_per_s"),
        ({"control.tick_hz": 10, "rotation.goal_timeout_s": 0.15}, "is shorter than 2 periods of control.tick_hz"),
        ({"control.tick_hz": 10, "machine.lease_s": 0.15}, "machine.lease_s"),
        ({"control.tick_hz": 10, "tilt.target_timeout_s": 0.1}, "tilt.target_timeout_s"),
        ({"control.tick_hz": 10, "control.overrun_s": 0.05}, "control.overrun_s"),
        ({"rotation.poll_hz": 5}, "rotation.max_age_s"),
        ({"rotation.poll_hz": 9, "rotation.max_age_s": 0.4}, "rotation.watchdog_s"),
        ({"rotation.speed_deg_per_s": 60, "rotation.max_age_s": 2.0}, "with nobody watching"),
        ({"lift_left.max_age_s": 0.3}, "lift_pair.reading_max_age_s"),
        ({"lift_pair.min_share": 0.3}, "lift_pair.min_share"),
        ({"lift_pair.silent_s": 0.5}, "silent_s"),
    ],
)  # fmt: skip
def test_a_configuration_under_which_a_detector_is_blind_is_refused_in_one_line(
    changes: dict[str, Any], named: str
) -> None:
    with pytest.raises(ValidationError) as refused:
        config(**changes)
    texts = [str(error["msg"]) for error in refused.value.errors()]
    places = [".".join(map(str, error["loc"])) for error in refused.value.errors()]
    assert any(named in text for text in (*texts, *places))
    assert all("\n" not in text for text in texts)


@pytest.mark.parametrize("settings", [tests.hil.conftest.FOR_THE_GUEST, hil.usb_guest.SETTINGS], ids=["guest", "usb"])
def test_the_slow_guests_of_the_hardware_tests_are_admitted(settings: dict[str, Any]) -> None:
    config(**settings)


def test_the_package_test_in_a_slow_root_is_admitted() -> None:
    text = (Path(__file__).parents[1] / "hil" / "lifecycle.sh").read_text(encoding="utf-8")
    told = dict(
        re.findall(
            r"\b(lease_s|watchdog_s|goal_timeout_s|reply_timeout_s|max_age_s|feedback_timeout_s|overrun_s)=([0-9.]+)",
            text,
        )
    )
    assert len(told) == 7
    sections = {
        "machine": ("lease_s",),
        "control": ("overrun_s",),
        "rotation": ("watchdog_s", "goal_timeout_s", "reply_timeout_s", "max_age_s"),
    }
    sections |= dict.fromkeys(("lift_left", "lift_right", "tilt"), ("max_age_s", "feedback_timeout_s"))
    lines = [
        f"[{section}]\n" + "".join(f"{name} = {told[name]}\n" for name in names) for section, names in sections.items()
    ]
    Config.model_validate(tomllib.loads("\n".join(lines)))
