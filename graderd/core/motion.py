"""Turns what an operator asks (a jog, a preset) into goals of the axes, in stages; refuses what is out of reach."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from graderd.core.attitude import (
    Attitude,
    AttitudeGeometry,
    Preset,
    lift_attitude,
    lift_extensions,
    pitch_deg,
    tilt_extension,
)
from graderd.core.axes import JOG_AXES, UNITS, AxisFigures, Goals, Pose
from graderd.core.commands import Jog
from graderd.core.commands import Preset as PresetCommand


def resolve(
    command: Jog | PresetCommand,
    pose: Pose,
    geometry: AttitudeGeometry,
    presets: Mapping[str, Preset],
    figures: Mapping[str, AxisFigures],
) -> tuple[Goals, ...] | str:
    """Goals in stages, or why they cannot be: no measurement to start from, unknown preset, beyond a limit."""
    if isinstance(command, Jog):
        goals = _jog(command, pose, geometry)
        if isinstance(goals, str):
            return goals
        stages: tuple[Goals, ...] = (goals,)
    else:
        preset = presets.get(command.name)
        if preset is None:
            return f"there is no preset '{command.name}'; there are: {', '.join(sorted(presets)) or 'none'}"
        made = _preset(preset, pose, geometry)
        if isinstance(made, str):
            return made
        stages = made
    for goals in stages:
        problem = _beyond(goals, figures)
        if problem:
            return problem + (_reach(command, pose, geometry, figures) if isinstance(command, Jog) else "")
    return stages


def _reach(jog: Jog, pose: Pose, geometry: AttitudeGeometry, figures: Mapping[str, AxisFigures]) -> str:
    """How far what was asked for can go from here, in its own words and unit."""
    unit = JOG_AXES[jog.axis].unit
    if jog.axis == "rotate":
        ends = (figures["rotation"].low, figures["rotation"].high)
    elif jog.axis in ("tilt", "pitch"):
        tilt = figures["tilt"]
        ends = (tilt.low, tilt.high)
        if jog.axis == "pitch":
            ends = (pitch_deg(geometry, tilt.low), pitch_deg(geometry, tilt.high))
    else:
        left, right = figures["lift_left"], figures["lift_right"]
        if pose.lift_left_mm is None or pose.lift_right_mm is None:
            return ""
        low_mm = max(left.low - pose.lift_left_mm, right.low - pose.lift_right_mm)
        high_mm = min(left.high - pose.lift_left_mm, right.high - pose.lift_right_mm)
        if jog.axis == "lift":
            ends = (max(left.low, right.low), min(left.high, right.high))
        elif jog.axis == "height":
            moved = [(pose.lift_left_mm + by, pose.lift_right_mm + by) for by in (low_mm, high_mm)]
            ends = _both(lift_attitude(geometry, *at).height_mm for at in moved)
        else:
            middle_mm = (pose.lift_left_mm + pose.lift_right_mm) / 2
            low_mm = max(left.low - middle_mm, middle_mm - right.high)
            high_mm = min(left.high - middle_mm, middle_mm - right.low)
            ends = _both(lift_attitude(geometry, middle_mm + by, middle_mm - by).slope_deg for by in (low_mm, high_mm))
    low, high = min(ends), max(ends)
    return f". From here {jog.axis} can go from {low:z.1f} to {high:z.1f} {unit}"


def _both(ends: Iterable[float]) -> tuple[float, float]:
    first, second = ends
    return first, second


def _jog(jog: Jog, pose: Pose, geometry: AttitudeGeometry) -> Goals | str:
    if jog.axis == "rotate":
        start = pose.rotation_deg if jog.relative else 0.0
        return _no_start(jog) if start is None else Goals(rotation_deg=start + jog.value)
    if jog.axis in ("tilt", "pitch"):
        return _jog_tilt(jog, pose, geometry)
    if pose.lift_left_mm is None or pose.lift_right_mm is None:
        return _no_start(jog)
    if jog.axis == "lift":
        if jog.relative:
            return Goals(lift_left_mm=pose.lift_left_mm + jog.value, lift_right_mm=pose.lift_right_mm + jog.value)
        return Goals(lift_left_mm=jog.value, lift_right_mm=jog.value)
    now = lift_attitude(geometry, pose.lift_left_mm, pose.lift_right_mm)
    if jog.axis == "height":
        wanted = Attitude(jog.value + (now.height_mm if jog.relative else 0.0), now.slope_deg)
    else:
        wanted = Attitude(now.height_mm, jog.value + (now.slope_deg if jog.relative else 0.0))
    left_mm, right_mm = lift_extensions(geometry, wanted)
    return Goals(lift_left_mm=left_mm, lift_right_mm=right_mm)


def _jog_tilt(jog: Jog, pose: Pose, geometry: AttitudeGeometry) -> Goals | str:
    if jog.relative and pose.tilt_mm is None:
        return _no_start(jog)
    start_mm = pose.tilt_mm if jog.relative and pose.tilt_mm is not None else 0.0
    if jog.axis == "tilt":
        return Goals(tilt_mm=start_mm + jog.value)
    start_deg = pitch_deg(geometry, start_mm) if jog.relative else 0.0
    return Goals(tilt_mm=tilt_extension(geometry, start_deg + jog.value))


def _preset(preset: Preset, pose: Pose, geometry: AttitudeGeometry) -> tuple[Goals, ...] | str:
    left_mm = right_mm = None
    if preset.height_mm is not None or preset.slope_deg is not None:
        if pose.lift_left_mm is None or pose.lift_right_mm is None:
            return "the lifts' positions are not known now"
        now = lift_attitude(geometry, pose.lift_left_mm, pose.lift_right_mm)
        wanted = Attitude(
            now.height_mm if preset.height_mm is None else preset.height_mm,
            now.slope_deg if preset.slope_deg is None else preset.slope_deg,
        )
        left_mm, right_mm = lift_extensions(geometry, wanted)
    tilt_mm = None if preset.pitch_deg is None else tilt_extension(geometry, preset.pitch_deg)
    everything = Goals(preset.rotation_deg, left_mm, right_mm, tilt_mm)
    if preset.lift_before_rotation and preset.rotation_deg is not None and left_mm is not None:
        return (Goals(None, left_mm, right_mm, tilt_mm), everything)
    return (everything,)


def _no_start(jog: Jog) -> str:
    return f"the position of '{jog.axis}' is not known now, so it cannot be moved from there"


def _beyond(goals: Goals, figures: Mapping[str, AxisFigures]) -> str:
    for axis, value in goals.items():
        low, high, unit = figures[axis].low, figures[axis].high, UNITS[axis]
        if value is not None and not low <= value <= high:
            return f"{axis} would go to {value:z.1f} {unit}, beyond its limits of {low:g} to {high:g} {unit}"
    return ""
