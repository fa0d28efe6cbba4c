"""The step response on the virtual servo, and its numbers and page from made-up samples."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from graderd.drivers.dynamixel.step import StepSample, analyse, render, step_response
from graderd.hal.errors import CommandRangeError, LifecycleError
from tests.dynamixel_sim import bench


async def test_the_manoeuvre_measures_the_virtual_blade(tmp_path: Path) -> None:
    async with bench(tmp_path) as rig:
        await rig.rotator.arm()
        recording = await step_response(rig.rotator, 8.0, 0.8, reference_deg=lambda: rig.servo.shaft_deg)
        up = recording.steps[0]
        assert up.to_deg - up.from_deg == pytest.approx(8.0, abs=0.2)
        # A trapezoid of 60 °/s and 240 °/s² takes 2 * sqrt(8 / 240) = 0.37 s; 10-90 % of it is 0.20 s.
        assert up.rise_s == pytest.approx(0.20, abs=0.06)
        assert up.settling_s is not None
        assert up.settling_s < 0.6
        assert up.overshoot_deg < 0.5
        assert up.peak_current_a is not None
        assert up.peak_current_a > 0.3
        assert all(abs(s.error_deg) < 0.2 for s in recording.steps)
        assert recording.backlash_from == "reference"
        assert recording.backlash_deg == pytest.approx(rig.servo.plant.settings.backlash_deg, abs=0.03)
        assert rig.servo.shaft_deg == pytest.approx(0.0, abs=0.3)
        page = render(recording, when="today")
        assert "http" not in page.replace("http://www.w3.org", "")
        assert "PH54-200-S500-R" in page


async def test_nothing_moves_where_it_may_not(tmp_path: Path) -> None:
    async with bench(tmp_path) as rig:
        with pytest.raises(LifecycleError):
            await step_response(rig.rotator)
        await rig.rotator.arm()
        with pytest.raises(CommandRangeError, match="outside the limits"):
            await step_response(rig.rotator, 61.0)
        with pytest.raises(CommandRangeError):
            await step_response(rig.rotator, 0.0)
        assert abs(rig.servo.shaft_deg) < 0.1


def made_up(lag_s: float, overshoot_deg: float) -> list[StepSample]:
    samples = []
    for i in range(300):
        time_s = i * 0.01
        goal_deg = 0.0 if time_s < 1.0 else 10.0
        into_s = time_s - 1.0
        rise = min(1.0, max(0.0, into_s / lag_s))
        bump = overshoot_deg if lag_s <= into_s < lag_s + 0.2 else 0.0
        samples.append(StepSample(time_s, goal_deg, 10.0 * rise + bump, 0.0, 2.0 * rise))
    return samples


def test_numbers_of_a_known_curve() -> None:
    recording = analyse(made_up(0.5, 1.5), 0.5, {})
    (step,) = recording.steps
    assert step.rise_s == pytest.approx(0.40, abs=0.02)
    assert step.overshoot_deg == pytest.approx(1.5, abs=0.01)
    assert step.settling_s == pytest.approx(0.70, abs=0.03)
    assert step.error_deg == pytest.approx(0.0, abs=1e-9)
    assert (recording.backlash_deg, recording.backlash_from) == (0.0, "none")


def test_a_goal_not_reached_has_no_times() -> None:
    (step,) = analyse(made_up(5.0, 0.0), 0.5, {}).steps
    assert step.rise_s is None
    assert step.settling_s is None
    assert "not reached" in render(analyse(made_up(5.0, 0.0), 0.5, {"a": "<b>"}))


def test_samples_without_a_step_are_refused() -> None:
    with pytest.raises(ValueError, match="no step"):
        analyse(made_up(0.5, 0.0)[:50], 0.5, {})


def test_the_page_is_well_formed_where_it_matters() -> None:
    page = render(analyse(made_up(0.5, 0.0), 0.5, {"<k>": "<v>"}))
    assert "<k>" not in page
    for svg in page.split("<svg")[1:]:
        ET.fromstring("<svg" + svg.partition("</svg>")[0] + "</svg>")
