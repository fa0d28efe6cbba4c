"""The code on the developers' pages is code that runs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from graderd.config import parse
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.perception import CameraCalibration, PerceptionSettings, classifier
from graderd.runtime.app.backends import check_plugins, rotator_of
from harness.perception_scenes import Scene, render
from tests.contract import test_valve_rotator as valve

ROOT = Path(__file__).parents[2]


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / "docs/developers" / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_the_device_page_shows_the_example_as_it_is() -> None:
    source = Path(valve.__file__).read_text(encoding="utf-8")
    shown = blocks("add-a-device.md", "python")
    assert len(shown) >= 5
    for block in shown:
        assert block in source


def test_the_device_pages_configuration_is_taken_by_the_driver() -> None:
    (text,) = blocks("add-a-device.md", "toml")
    config = parse(tomllib.loads(text))
    check_plugins(config)
    backend, settings = rotator_of(config.rotation)
    assert backend.settings is valve.VALVE.settings
    assert settings.driver.valve_n == 2
    assert settings.max_deg == 50.0


@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE])
def test_the_classifier_pages_method_finds_the_soil(zone: Zone, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a known method's place, because the settings take no unknown one."""
    (code,) = blocks("add-a-classifier.md", "python")
    names: dict[str, Any] = {}
    exec(compile(code, "add-a-classifier.md", "exec"), names)
    monkeypatch.setattr(classifier, "BY_COLOR", {"fast_color": names["saturation_verdict"]})
    made = classifier.make_classifier(PerceptionSettings(method="fast_color"), CameraCalibration(), BladeGeometry())
    frame = render(Scene(zone=zone, angle_deg=-15.0, seed=6), color_size=(480, 300), depth_size=(424, 240))
    assert made.classify(frame, -15.0, 0.02).zone is zone
