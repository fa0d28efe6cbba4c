"""Where soil meets a turned blade: the formula against a blade that is driven there in the vehicle frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.blade import STEEPEST_MEETING_DEG, blade_coordinates, meeting_point

X_OFFSET_M = 0.04
"""Of the face before the axis: it is carried round with the blade."""


@given(
    st.floats(-0.6, 0.6), st.floats(0.01, 0.6), st.floats(-STEEPEST_MEETING_DEG, STEEPEST_MEETING_DEG, allow_nan=False)
)
def test_soil_is_met_where_a_blade_that_drives_there_meets_it(s: float, d: float, angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = (d + X_OFFSET_M) * cos - s * sin, (d + X_OFFSET_M) * sin + s * cos
    met_s, travel_m = meeting_point(np.array(s), np.array(d), angle_deg)
    # Seen from the vehicle the soil comes nearer by the travel.
    then_s, then_d = blade_coordinates(np.array(x - travel_m), np.array(y), angle_deg)
    assert then_d - X_OFFSET_M == pytest.approx(0.0, abs=1e-9)
    assert then_s == pytest.approx(met_s, abs=1e-9)
    assert met_s - s == pytest.approx(travel_m * sin, abs=1e-9)


def test_a_square_blade_meets_soil_where_it_lies() -> None:
    met_s, travel_m = meeting_point(np.array([0.2, -0.3]), np.array([0.1, 0.5]), 0.0)
    assert met_s == pytest.approx([0.2, -0.3])
    assert travel_m == pytest.approx([0.1, 0.5])


@pytest.mark.parametrize("angle_deg", [-80.0, 75.1, 90.0])
def test_a_blade_along_the_travel_meets_nothing(angle_deg: float) -> None:
    with pytest.raises(ValueError, match="no soil ahead"):
        meeting_point(np.zeros(1), np.ones(1), angle_deg)
