"""The demonstration on a person's terminal: it fits, and ends with its result in sight."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from graderd.core.soil import Zone
from graderd.core.status import SoilStatus, Status
from graderd.simulator.show import PanelShow
from tests.unit.test_watch import SIZES, status_of

PASSES = [
    {"zone": zone, "decided": zone, "requested_deg": angle, "measured_deg": angle + 0.12, "settle_s": 1.23}
    for zone, angle in (("left", 30.0), ("center", 0.0), ("right", -30.0), ("even", 45.0))
]


def console_of(size: tuple[int, int]) -> Console:
    return Console(file=io.StringIO(), width=size[0], height=size[1], force_terminal=True, color_system=None)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("faults_n", [0, 2])
def test_a_frame_fits_and_has_soil_status_and_events(size: tuple[int, int], faults_n: int) -> None:
    show = PanelShow(console_of(size))
    for number in range(9):
        show.event("decision", zone="left", requested_deg=30.0, number=number)
    status = Status.model_validate(status_of(faults_n))
    text = show.frame(status).plain.split("\n")
    assert len(text) < size[1]
    assert max(map(len, text)) <= size[0]
    assert text[0].startswith("left    49%  ███")
    assert any("-123.4 deg" in line for line in text)
    assert "number 8" in text[-1]
    unknown = status.model_copy(update={"soil": SoilStatus(zone=Zone.UNKNOWN)})
    assert show.frame(unknown).plain.split("\n")[0].split() == ["left", "?"]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("reason", ["", "soil left was taken for right"])
def test_the_result_is_the_last_thing_on_the_screen(size: tuple[int, int], reason: str) -> None:
    console = console_of(size)
    show = PanelShow(console)
    with show:
        show.status(Status.model_validate(status_of(1)))
        show.event("demo_finished", passes=PASSES, reason=reason)
    assert isinstance(console.file, io.StringIO)
    last = console.file.getvalue().rstrip("\n").split("\n")[-(size[1] - 1) :]
    for one in PASSES:
        assert any(str(one["zone"]) in line and f"{one['measured_deg']:+.2f}°" in line for line in last)
    assert last[-1].startswith(f"failed: {reason}" if reason else "all passes")
