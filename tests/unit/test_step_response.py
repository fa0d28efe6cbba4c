"""The numbers and the page of a step response, from made-up samples."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from graderd.runtime.step_response import StepSample, analyse, render


def made_up(lag_s: float, overshoot_deg: float) -> list[StepSample]:
    samples = []
    for i in range(300):
        time_s = i * 0.01
        goal_deg = 0.0 if time_s < 1.0 else 10.0
        into_s = time_s - 1.0
        rise = min(1.0, max(0.0, into_s / lag_s))
        bump = overshoot_deg if lag_s <= into_s < lag_s + 0.2 else 0.0
        samples.append(StepSample(time_s, goal_deg, 10.0 * rise + bump, 2.0 * rise))
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


def test_play_is_what_two_ways_to_one_goal_differ_by() -> None:
    parts = ((0.0, 0.0), (10.0, 0.0), (5.0, 0.2), (0.0, 0.0), (5.0, -0.1))
    offs = [part for part in parts for _ in range(9)]
    samples = [StepSample(n * 0.1, goal_deg, goal_deg + off_deg, None) for n, (goal_deg, off_deg) in enumerate(offs)]
    recording = analyse(samples, 0.5, {})
    assert recording.backlash_from == "encoder"
    assert recording.backlash_deg == pytest.approx(0.3)
    assert recording.steps[0].peak_current_a is None
    assert "motor current" not in render(recording)
