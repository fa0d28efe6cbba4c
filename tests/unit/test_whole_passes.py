"""Whole passes in virtual time: world, pictures, perception, control tick. The matrix is ``benchmarks/passes.py``."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from graderd.config.tick import tick_settings
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Frame
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.classifier import make_classifier
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import materials_of
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import World, scene_heights
from harness.passes import DRIVE_M, Case, LoopPass, fixed_width_mm, loop_config, loop_pass
from harness.perception_scenes import ON_GROUND

pytestmark = pytest.mark.slow

CONFIG = loop_config()


def test_a_heap_dead_ahead_of_a_blade_at_45_degrees_is_center() -> None:
    """It lies before the right third, square to the blade; the blade swung 75 degrees across the pile."""
    one = LoopPass(Case("center", 45.0, 0.5, 2), tick_settings(CONFIG), CONFIG, materials_of(0))
    decisions = [tick.state.decision for tick in islice(one.ticks(), 60)]
    assert {decision.zone for decision in decisions} == {None, Zone.CENTER}
    assert decisions[-1].angle_deg == 15.0


@pytest.mark.parametrize("start_deg", [-30.0, 45.0])
def test_a_center_pile_keeps_its_angle_and_is_spread_as_by_a_fixed_blade(start_deg: float) -> None:
    """Carried it spreads over the whole blade; deciding again on that ended at 45 degrees, a fifth narrower."""
    outcome = loop_pass(Case("center", start_deg, 1.0, 1), CONFIG, materials_of(0))
    assert outcome.decisions == ("center",)
    assert outcome.note == ""
    assert outcome.angle_deg == pytest.approx(15.0, abs=0.5)
    assert outcome.width_mm > 0.95 * fixed_width_mm(1, 1.0)


@pytest.mark.parametrize(
    ("zone", "angle_deg", "speed_m_per_s", "from_m", "to_m"),
    [(SceneZone.EVEN, 45.0, 0.5, 1.2, 2.4), (SceneZone.CENTER, 15.0, 1.0, 0.4, 1.2)],
)
def test_what_a_blade_carries_is_no_person_and_no_knocked_camera(
    zone: SceneZone, angle_deg: float, speed_m_per_s: float, from_m: float, to_m: float
) -> None:
    """A full blade's heap up to the machine's arms stood there; a heap's flank beside the face was a turned blade.

    A single picture may be taken so as the heap runs off the blade (2 of 100): it counts after a second, ten pictures.
    """
    world = World()
    world.blade = BladePose(angle_deg)
    world.lay(scene_heights(zone, world.vehicle.x_m, world.blade, 1))
    world.vehicle.drive(speed_m_per_s, DRIVE_M)
    renderer = Renderer((640, 400), (424, 240), seed=1, materials=materials_of(0))
    judge = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)
    seen = in_a_row = 0
    while world.vehicle.travelled_m < to_m:
        world.step(0.01, world.blade)
        if world.vehicle.travelled_m < from_m + seen * 0.1:
            continue
        seen += 1
        field = world.field
        state = SceneState(field.heights_m.astype(np.float32), field.cell_m, world.vehicle.x_m, world.blade)
        pictures = renderer.render(state, Appearance())
        frame = Frame(*pictures, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)
        observation = judge.classify(frame, angle_deg, 0.0, ON_GROUND)
        in_a_row = in_a_row + 1 if observation.faults else 0
        assert in_a_row < 2, (world.vehicle.travelled_m, observation.faults)
    assert seen >= 8
