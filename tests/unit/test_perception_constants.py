"""The numbers that perception goes by and nobody sets: each says why it is so, and no answer hangs on one of them.

What a site may have to change is a setting. The rest are properties of the method: a tenth more or less of any of them
gives the same answers on soil left, even and none.
"""

from __future__ import annotations

import ast
import functools
from pathlib import Path
from types import ModuleType

import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Frame
from graderd.perception import (
    CameraCalibration,
    PerceptionSettings,
    calibration,
    calibration_evidence,
    classifier,
    color,
    depth,
    forms,
    geometry,
    ground,
    health,
    registration,
)
from graderd.perception.geometry import View
from harness.perception_scenes import ON_GROUND, PoseError, Scene, render

MODULES: tuple[ModuleType, ...] = (registration, ground, forms, depth)
STATED: tuple[ModuleType, ...] = (*MODULES, calibration, calibration_evidence, classifier, color, geometry, health)
"""The others judge pictures by settings, or a calibration by its own fit: their numbers say why as well."""
COUNTS = (0, 1, 2, 3, 4, -1)
"""Bare in the code: indices, counts of ends, thirds and levels of a tuple."""
UNITS = (0.5, 100, 255, 1000, 1000.0, 0.001, 100.0, 0.0, 1.0, 2.0, 2.5, 3.0)
"""Halves, percent, millimetres and litres; a mask's inside, and full brightness."""
EXACT = {
    "graderd.perception.ground.EXTENT_M": "bounds of what is looked at, in whole cells",
    "graderd.perception.registration.ABOVE_PX": "a range of pixels",
}


def constants(module: ModuleType) -> dict[str, ast.Assign]:
    """Assignments of numbers at the module's level, by the names they give."""
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    found: dict[str, ast.Assign] = {}
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(isinstance(part, ast.Constant) for part in ast.walk(node.value)):
            target = node.targets[0]
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            found |= {name.id: node for name in names if isinstance(name, ast.Name) and name.id.isupper()}
    return found


def numbers() -> list[tuple[ModuleType, str]]:
    """The numbers that can be a tenth more or less."""
    return [
        (module, name)
        for module in MODULES
        for name in constants(module)
        if isinstance(getattr(module, name), int | float) and f"{module.__name__}.{name}" not in EXACT
    ]


@pytest.mark.parametrize("module", STATED)
def test_every_number_says_why(module: ModuleType) -> None:
    body = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body
    for name, node in constants(module).items():
        if not isinstance(getattr(module, name), int | float):
            continue
        after = body[[ast.dump(one) for one in body].index(ast.dump(node)) + 1]
        assert isinstance(after, ast.Expr), name
        assert isinstance(after.value, ast.Constant), name


@pytest.mark.parametrize("module", STATED)
def test_no_tuned_number_stands_in_the_code(module: ModuleType) -> None:
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    bare = {
        (function.name, part.value)
        for function in functions
        for part in ast.walk(function)
        if isinstance(part, ast.Constant) and type(part.value) in (int, float) and part.value not in COUNTS + UNITS
    }
    assert bare == set()


SCENES = (
    (
        Scene(zone=Zone.LEFT, angle_deg=20.0, seed=1, noise_px=0.15, pose=PoseError(z_m=0.02, pitch_deg=1.5)),
        ON_GROUND,
    ),
    (Scene(zone=Zone.EVEN, seed=4, noise_px=0.15), ON_GROUND),
    (Scene(zone=Zone.NONE, angle_deg=40.0, seed=5, noise_px=0.15), ON_GROUND),
)


@functools.cache
def frames() -> tuple[Frame, ...]:
    return tuple(render(scene, color_size=(64, 40)) for scene, _ in SCENES)


def answers() -> list[Zone]:
    settings, calibration = PerceptionSettings(), CameraCalibration()
    found = []
    for frame, (scene, attitude) in zip(frames(), SCENES, strict=True):
        assert frame.depth_mm is not None
        assert frame.depth_intrinsics is not None
        view = View(frame.depth_intrinsics, calibration.depth.pose(calibration.mounting))
        judge = depth.DepthJudge(view, BladeGeometry(), settings.depth, settings.decision)
        soil = judge.height_map(frame.depth_mm, registration.Stance(scene.angle_deg, attitude))
        found.append(judge.verdict(soil).zone)
    return found


@pytest.mark.parametrize(("module", "name"), numbers(), ids=lambda value: getattr(value, "__name__", value))
def test_no_answer_hangs_on_one_number(monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str) -> None:
    value = getattr(module, name)
    for ratio in (0.9, 1.1):
        changed = value * ratio
        if isinstance(value, int):
            changed = round(changed) if round(changed) != value else value + (1 if ratio > 1 else -1)
        monkeypatch.setattr(module, name, changed)
        assert answers() == [scene.zone for scene, _ in SCENES], (name, changed)
