"""Whole passes in virtual time: world, pictures, perception, control tick. The matrix is ``benchmarks/passes.py``."""

from __future__ import annotations

from itertools import islice

import pytest

from graderd.core.soil import Zone
from graderd.runtime.control import tick_settings
from graderd.simulator.camera.materials import Materials
from harness.passes import Case, LoopPass, fixed_width_mm, loop_config, loop_pass

CONFIG = loop_config()


def test_a_heap_dead_ahead_of_a_blade_at_45_degrees_is_center() -> None:
    """It lies before the right third, square to the blade; the blade swung 75 degrees across the pile."""
    one = LoopPass(Case("center", 45.0, 0.5, 2), tick_settings(CONFIG), CONFIG, Materials(0))
    decisions = [tick.state.decision for tick in islice(one.ticks(), 60)]
    assert {decision.zone for decision in decisions} == {None, Zone.CENTER}
    assert decisions[-1].angle_deg == 15.0


@pytest.mark.parametrize("start_deg", [-30.0, 45.0])
def test_a_center_pile_keeps_its_angle_and_is_spread_as_by_a_fixed_blade(start_deg: float) -> None:
    """Carried it spreads over the whole blade; deciding again on that ended at 45 degrees, a fifth narrower."""
    outcome = loop_pass(Case("center", start_deg, 1.0, 1), CONFIG, Materials(0))
    assert outcome.decisions == ("center",)
    assert outcome.angle_deg == pytest.approx(15.0, abs=0.5)
    assert outcome.width_mm > 0.95 * fixed_width_mm(1, 1.0)
