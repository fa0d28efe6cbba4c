"""``graderd calibrate color``: a colour method drives where frames of the site have shown its worth, nowhere else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graderd.cli.app import run_app
from graderd.config.loader import load
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Method, Zone
from graderd.hal.camera import Frame
from graderd.perception import METHODS, CameraCalibration, PerceptionSettings, classifier
from graderd.perception.decide import Verdict
from graderd.perception.frame_set import Entry, FrameSetWriter
from graderd.perception.geometry import U8, Region
from graderd.perception.scoring import Score, site_figure
from graderd.perception.settings import (
    COLOR_METHODS,
    FRAMES_LEAST_N,
    ColorSettings,
    DecisionSettings,
    SiteFigure,
    StreamCalibration,
)

Captured = pytest.CaptureFixture[str]
ZONES = (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE)
CONFIG = '# mine\n[perception]\nmethod = "fast_color"\n'
SIZE = (160, 100)
NO_DEPTH = np.zeros((48, 80), np.uint16)


def small() -> CameraCalibration:
    """The nominal camera with pictures that are quick to write."""
    camera = CameraCalibration()
    streams = {
        name: StreamCalibration.from_pose(
            stream.intrinsics().scaled(*size), stream.pose(camera.mounting), camera.mounting
        )
        for name, stream, size in (("color", camera.color, SIZE), ("depth", camera.depth, NO_DEPTH.shape[::-1]))
    }
    return camera.model_copy(update=streams)


def site(folder: Path, each_n: int = FRAMES_LEAST_N, swapped_n: int = 0) -> Path:
    """Frames whose brightness tells the bed, ``swapped_n`` of the left ones labelled right."""
    writer = FrameSetWriter(folder, small(), BladeGeometry())
    rng = np.random.default_rng(1)
    for number in range(each_n * len(ZONES)):
        zone = ZONES[number % len(ZONES)]
        coarse = rng.normal(60 + 30 * ZONES.index(zone), 12, (SIZE[1] // 4, SIZE[0] // 4, 3))
        picture = coarse.repeat(4, axis=0).repeat(4, axis=1).clip(0, 255).astype(np.uint8)
        if zone is Zone.LEFT and number < swapped_n * len(ZONES):
            zone = Zone.RIGHT
        writer.add(Entry(f"{number:03d}", zone, 0.0), Frame(picture, NO_DEPTH, None, None, 0.0))
    return folder


def by_brightness(picture: U8, region: Region, color: ColorSettings, decision: DecisionSettings) -> Verdict:
    return Verdict(ZONES[round((float(picture.mean()) - 60) / 30)], 1.0, "")


@pytest.fixture(autouse=True)
def telling_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(classifier, "BY_COLOR", {"fast_color": by_brightness, "paper": by_brightness})


def test_a_good_figure_is_written_and_lets_the_method_drive(tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(CONFIG)
    assert load(path).perception.why_not_to_drive()
    run_app(["calibrate", "color", "--from", str(site(tmp_path / "site")), "--config", str(path), "--yes"])
    perception = load(path).perception
    assert perception.why_not_to_drive() == ""
    assert path.read_text().startswith(CONFIG)
    figure = perception.color.site_figure
    assert figure is not None
    assert (figure.right_percent, figure.frames_least_n, figure.sides_swapped_n) == (100.0, FRAMES_LEAST_N, 0)
    assert "right 100.0 % of the answers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("each_n", "swapped_n", "why"),
    [
        (FRAMES_LEAST_N - 1, 0, "19 frames of one of the beds"),
        (FRAMES_LEAST_N + 4, 4, "96.6 % of the answers were right"),
        (FRAMES_LEAST_N + 1, 1, "left and right were taken for each other 1 times"),
    ],
)
def test_what_falls_short_is_told_and_nothing_is_written(
    tmp_path: Path, capsys: Captured, each_n: int, swapped_n: int, why: str
) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(CONFIG)
    frames = site(tmp_path / "site", each_n, swapped_n)
    status = run_app(["calibrate", "color", "--from", str(frames), "--config", str(path), "--yes", "--json"])
    assert status == 1
    out, err = capsys.readouterr()
    assert why in json.loads(out.splitlines()[0])["falls_short"]
    assert why in err
    assert path.read_text() == CONFIG
    assert [one.name for one in tmp_path.iterdir() if "bak" in one.name] == []


def figure_for(settings: PerceptionSettings, **other: float) -> PerceptionSettings:
    measured = {
        "frames_least_n": FRAMES_LEAST_N,
        "right_percent": 99.0,
        "answered_percent": 96.0,
        "sides_swapped_n": 0,
        "false_piles_percent": 0.0,
    } | other
    figure = SiteFigure(method="fast_color", settings_mark=settings.color_mark(), **measured)
    return settings.model_copy(update={"color": settings.color.model_copy(update={"site_figure": figure})})


def test_a_figure_speaks_for_its_own_method_and_settings_alone() -> None:
    settings = figure_for(PerceptionSettings(method="fast_color"))
    assert settings.why_not_to_drive() == ""
    assert "nobody has measured" in settings.model_copy(update={"method": "paper"}).why_not_to_drive()
    changed = settings.color.model_copy(update={"none_area_percent": 9.0})
    assert "are not those that were measured" in settings.model_copy(update={"color": changed}).why_not_to_drive()
    assert PerceptionSettings().why_not_to_drive() == ""
    assert PerceptionSettings(method="fused").why_not_to_drive() == ""


@pytest.mark.parametrize(
    "other",
    [
        {"right_percent": 97.9},
        {"answered_percent": 94.9},
        {"sides_swapped_n": 1},
        {"false_piles_percent": 1.0},
        {"frames_least_n": 3},
    ],
)
def test_a_figure_written_by_hand_is_judged_again(other: dict[str, float]) -> None:
    assert "is not good enough" in figure_for(PerceptionSettings(method="fast_color"), **other).why_not_to_drive()


@pytest.mark.parametrize("method", METHODS)
def test_every_colour_method_and_no_other_can_have_a_figure(method: Method) -> None:
    settings = PerceptionSettings(method=method)
    if method in COLOR_METHODS:
        assert site_figure(Score(), settings, "today").method == method
    else:
        with pytest.raises(ValueError, match="does not go by colour"):
            site_figure(Score(), settings, "today")
