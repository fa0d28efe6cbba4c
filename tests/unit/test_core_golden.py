"""State machine, gate and fault monitor, answer by answer, against ``golden/core.json``: every text and every number.

The other tests say what must hold; this one notices any change at all, which is what mutation testing asks for
(docs/developers/mutation.md). After a change that is meant: ``python -m tests.unit.test_core_golden`` writes the file
anew; read the difference before you commit it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.axes import AXES, Goals, Pose
from graderd.core.faults.catalogue import _by_key, find_rows
from graderd.core.faults.monitor import (
    ALL_AXES,
    ActiveFault,
    Clear,
    FaultRow,
    FaultState,
    Reaction,
    clear_faults,
    held_axes,
    row_for,
    update_faults,
    worst,
)
from graderd.core.gate import GateInputs, GateSettings, GateState, Setpoint, pass_gate
from graderd.core.machine import MachineSettings, Mode, State, Step, Unmet, step
from graderd.core.rule import RuleSettings, Travel
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.fault import DeviceFault
from tests.unit.test_core_machine import EVENTS, NOW_S, STATES, do, fault

GOLDEN = Path(__file__).parent / "golden" / "core.json"
MACHINE, RULE = MachineSettings(), RuleSettings()
GATE, FIGURES = GateSettings(), Config().figures()


def plain(value: Any) -> Any:
    """As JSON knows it; numbers rounded so that no platform's last bit matters."""
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else str(value)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, frozenset):
        return sorted(value)
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def told(result: Step) -> Any:
    """Everything of a step."""
    return plain(
        {
            "state": asdict(replace(result.state, decision=replace(result.state.decision, votes=()))),
            "intents": asdict(result.intents),
            "replies": [reply.model_dump() for reply in result.replies],
        }
    )


def machine_answers() -> Iterator[tuple[str, Any]]:
    for (name, state), (event, given) in product(STATES.items(), EVENTS.items()):
        yield f"{name}, {event}", told(step(state, given, MACHINE, RULE))
    jogging = STATES["jogging"]
    unnamed = do(STATES["manual"], cmd.Jog(axis="rotate", value=3.0), devices_active=True).state
    seen = SoilObservation(NOW_S, Zone.LEFT, 0.9, "", share_left=0.9)
    for reaction in Reaction:
        for axes in ({"rotation"}, {"lift"}, {"tilt"}, {"lift", "tilt"}, ALL_AXES):
            one = fault(reaction, frozenset(axes))
            blind = replace(one, row=replace(one.row, automatic_only=True))
            for mode in ("manual", "auto"):
                state = replace(STATES[mode], goals=Goals(1.0, 2.0, 3.0, 4.0))
                key = f"{mode}, {reaction.name} {sorted(axes)}"
                yield key, told(do(state, faults=(one,), devices_active=True))
                yield f"{key}, automatic only", told(do(state, faults=(blind,), devices_active=True))
    gone = replace(fault(Reaction.STOP), present=False)
    stages = (Goals(tilt_mm=5.0), Goals(tilt_mm=6.0), Goals(tilt_mm=7.0))
    two = (Unmet("tilt", "silent", "look"), Unmet("stop", "pressed", "release"), Unmet("lift_left", "far", "look"))
    many: dict[str, tuple[State, tuple[cmd.Command, ...], dict[str, Any]]] = {
        "stop and reset": (STATES["manual"], (cmd.Reset(stop_n=0), cmd.Stop(client="x", reason="why")), {}),
        "two commands": (STATES["manual"], (cmd.Auto(), cmd.Manual()), {}),
        "reset, fault present": (STATES["stopped"], (cmd.Reset(stop_n=0),), {"faults": (fault(Reaction.STOP),)}),
        "reset, fault gone": (STATES["stopped"], (cmd.Reset(stop_n=0),), {"faults": (gone,)}),
        "renew of another": (jogging, (cmd.Renew(client="b"),), {}),
        "release of another": (jogging, (cmd.Release(client="b"),), {}),
        "another while nobody's jog": (unnamed, (cmd.Manual(client="b"),), {}),
        "lease at its last moment": (jogging, (), {"now_s": NOW_S + 0.3}),
        "lease a moment later": (jogging, (), {"now_s": NOW_S + 0.3001}),
        "nobody's lease lapses": (unnamed, (), {"now_s": NOW_S + 0.4}),
        "arming at its last moment": (STATES["arming"], (), {"now_s": NOW_S + 4.9, "devices_active": False}),
        "arming a moment later": (STATES["arming"], (), {"now_s": NOW_S + 4.9001, "devices_active": False}),
        "arm while released": (STATES["disarmed"], (cmd.Arm(),), {"devices_active": True}),
        "arm with a latched fault": (STATES["disarmed"], (cmd.Arm(),), {"devices_active": False,
                                     "faults": (replace(fault(Reaction.DISARM), present=False),)}),
        "stop, reset, arm": (STATES["manual"], (cmd.Stop(), cmd.Reset(stop_n=0), cmd.Arm()), {}),
        "a preset from where it is": (STATES["manual"], (cmd.Preset(name="p"),), {
            "resolve": lambda _, pose: (Goals(pose.rotation_deg, pose.lift_left_mm),)}),
        "renewed later": (jogging, (cmd.Renew(client="a"),), {"now_s": NOW_S + 0.25}),
        "armed already": (STATES["manual"], (cmd.Arm(),), {}),
        "several unmet": (STATES["disarmed"], (cmd.Arm(),), {"devices_active": False, "unmet": two}),
        "several unmet for auto": (STATES["manual"], (cmd.Auto(),), {"unmet_for_auto": two}),
        "stage by stage": (replace(jogging, later=stages), (), {"settled": True}),
        "first picture": (STATES["auto"], (), {"observation": seen}),
        "next stage": (replace(jogging, later=(Goals(tilt_mm=5.0),)), (), {"settled": True}),
        "stage not reached": (replace(jogging, later=(Goals(tilt_mm=5.0),)), (), {"settled": False}),
    }  # fmt: skip
    for name, (state, commands, changes) in many.items():
        yield name, told(do(state, *commands, **({"devices_active": True} | changes)))


def automatic_answers() -> Iterator[tuple[str, Any]]:
    """A decision, a change of it before the machine has started, and a swing in between."""
    state = STATES["auto"]
    for tick in range(60):
        now_s = NOW_S + 0.1 * tick
        left = tick < 30
        shares = (0.9, 0.0, 0.0) if left else (0.0, 0.0, 0.9)
        seen = SoilObservation(now_s, Zone.LEFT if left else Zone.RIGHT, 0.9, "", *shares)
        settled = tick not in range(6, 9)
        travel = Travel(0.0, 3.0, now_s)
        result = do(state, now_s=now_s, observation=seen, travel=travel, settled=settled, devices_active=True)
        state = result.state
        yield f"automatic, tick {tick}", [told(result), len(state.decision.votes)]


def gate_answers() -> Iterator[tuple[str, Any]]:
    windows = {"rotation": 40.0, "lift_left": 50.0, "lift_right": 50.0, "tilt": 20.0}
    narrow = {axis: replace(figures, window=windows[axis]) for axis, figures in FIGURES.items()}
    high = GateSettings(rotation_min_height_mm=30.0)
    pose = Pose(5.0, 100.0, 110.0, 50.0)
    nan = Pose(math.nan, 100.0, math.inf, 50.0)
    lists = {
        "far up": Goals(90.0, 400.0, 400.0, 400.0),
        "far down": Goals(-90.0, -5.0, -5.0, -5.0),
        "near": Goals(5.5, 101.0, 109.0, 50.2),
        "here": Goals(5.0, 100.0, 110.0, 50.0),
        "nothing": Goals(),
        "no numbers": Goals(math.nan, math.inf, -math.inf, math.nan),
    }
    ways = [(Mode.MANUAL, True), (Mode.MANUAL, False), (Mode.AUTO, True), (Mode.DISARMED, True), (Mode.STOPPED, True)]
    for (name, goals), (mode, lease_ok) in product(lists.items(), ways):
        state = GateState()
        rows = []
        for tick in range(160 if mode is Mode.MANUAL and lease_ok else 10):
            now = nan if tick == 3 else Pose() if tick == 4 else pose
            height_mm = None if tick < 2 else 20.0 if tick < 6 else 30.0
            used = (high, FIGURES) if 0 < tick < 9 else (GATE, narrow)
            inputs = GateInputs(*used, mode, now, 0.0 if tick == 5 else 0.02, lease_ok, height_mm)
            state, passed = pass_gate(state, goals, inputs)
            pose_now = {axis: passed[axis].limited for axis in AXES}
            pose = Pose(
                pose.rotation_deg if pose_now["rotation"] is None else pose_now["rotation"],
                pose.lift_left_mm if pose_now["lift_left"] is None else pose_now["lift_left"],
                pose.lift_right_mm,  # jammed
                pose.tilt_mm if pose_now["tilt"] is None else pose_now["tilt"],
            )
            if tick < 12 or tick % 12 == 0:
                rows.append([[p.requested, p.limited, p.reason] for p in passed.values()])
                rows.append([list(s) for s in state.setpoints.values()])
        pose = Pose(5.0, 100.0, 110.0, 50.0)
        yield f"{name}, {mode}, lease {lease_ok}", plain(rows)


def late_answers() -> Iterator[tuple[str, Any]]:
    """Ticks of uneven length, on the way to a goal that stands and to one nearer than the way to stop."""
    pose = Pose(0.0, 100.0, 100.0, 50.0)
    regulated = FIGURES | {"rotation": replace(FIGURES["rotation"], profile_in_device=False)}
    for goal_deg, pattern in product((35.0, -12.0, 0.4), ((0.02, 0.2), (0.001, 0.08, 0.02), (0.2,), (0.02, 0.021))):
        state, rows = GateState(), []
        for tick in range(60):
            inputs = GateInputs(GATE, regulated, Mode.MANUAL, pose, pattern[tick % len(pattern)], True)
            state, passed = pass_gate(state, Goals(goal_deg), inputs)
            rows.append(passed["rotation"].limited)
        yield f"to {goal_deg} with ticks of {pattern}", plain(rows)
    limits = FIGURES["rotation"]
    shares = (0.02, 0.1, 0.3, 0.5, 0.8, 0.99, 1.0, 1.05, 1.4, 3.0)
    for share, speed, dt_s in product(shares, (0.3, 0.9, 1.5, -6.0), (0.02, 0.1, 0.2)):
        way_deg = math.copysign(share * speed**2 / (2.0 * limits.acceleration), speed)
        state = GateState({"rotation": Setpoint(0.0, speed, 0.0)})
        state, _ = pass_gate(state, Goals(way_deg), GateInputs(GATE, FIGURES, Mode.MANUAL, pose, dt_s, True))
        # ending at the goal and passing it are told apart by the speed that is left
        yield f"{share} of the way to stop from {speed}, {dt_s}", plain(state.setpoints["rotation"]._asdict())
    for goal_deg, dt_s in product((70.0, -70.0, 60.0), (0.01, 0.02, 0.2)):
        near, speed = math.copysign(59.9, goal_deg), math.copysign(limits.speed, goal_deg)
        state = GateState({"rotation": Setpoint(near, speed, near)})
        there = Pose(near, 100.0, 100.0, 50.0)
        state, _ = pass_gate(state, Goals(goal_deg), GateInputs(GATE, FIGURES, Mode.MANUAL, there, dt_s, True))
        yield f"fast at the limit, to {goal_deg}, {dt_s}", plain(state.setpoints["rotation"]._asdict())
    for part, dt_s in product((0.99, 1.01, 1.05, 1.2), (0.2, 0.5, 1.0)):
        state = GateState({"rotation": Setpoint(0.0, limits.speed, 0.0)})
        goals = Goals(part * limits.speed * dt_s)
        state, _ = pass_gate(state, goals, GateInputs(GATE, FIGURES, Mode.MANUAL, pose, dt_s, True))
        yield f"{part} of a tick's way in {dt_s}", plain(state.setpoints["rotation"]._asdict())


def bound_answers() -> Iterator[tuple[str, Any]]:
    """A window that ends exactly where the limit is: the limit is named."""
    figures = FIGURES | {"rotation": replace(FIGURES["rotation"], window=60.0)}
    for goal_deg in (-61.0, -60.0, 60.0, 61.0):
        inputs = GateInputs(GATE, figures, Mode.MANUAL, Pose(0.0, 100.0, 100.0, 50.0), 0.02, True)
        yield f"window equals limit, {goal_deg}", pass_gate(GateState(), Goals(goal_deg), inputs)[1]["rotation"].reason


def row(
    key: str, reaction: Reaction, clear: Clear, debounce_s: float = 0.0, axes: frozenset[str] = ALL_AXES
) -> FaultRow:
    return FaultRow(key, "reads", "cause", "remedy", reaction, debounce_s, clear, axes)


def device_fault(name: str, detail: str) -> DeviceFault:
    device, _, condition = name.partition(".")
    return DeviceFault(device, condition, detail, 7.0)


def fault_answers() -> Iterator[tuple[str, Any]]:
    own = frozenset({"own"})
    catalogue = _by_key(
        [
            row("camera.a", Reaction.WARN, Clear.WHEN_GONE, 0.2),
            row("rotation.b", Reaction.DISARM, Clear.ON_REARM),
            row("can.c", Reaction.STOP, Clear.ON_RESET),
            row("actuator.d", Reaction.HOLD, Clear.WHEN_GONE, axes=own),
            row("actuator.e", Reaction.HOLD, Clear.NEVER, axes=frozenset({"tilt"})),
            row("camera.f", Reaction.HOLD, Clear.WHEN_GONE, axes=own),
        ]
    )
    names = ("camera.a", "rotation.b", "can.c", "lift_left.d", "tilt.d", "lift_right.e", "camera.f", "daemon.unknown")
    all_of = [device_fault(name, f"detail of {name}") for name in names]
    state = FaultState()
    script = [
        (100.0, all_of), (100.1, all_of), (100.2, [*all_of[:2]]), (100.3, []), (100.4, all_of[:1]), (100.45, []),
        (100.5, all_of[:1]), (100.65, all_of[:1]), (100.7, all_of[:1]),
        (100.8, all_of[3:5]),
    ]  # fmt: skip
    for now_s, present in script:
        state = update_faults(state, present, now_s, catalogue)
        yield (
            f"faults at {now_s}",
            plain([asdict(state), frozenset(held_axes(state.active)), asdict(worst(state.active) or state)]),
        )
        for event in Clear:
            yield f"faults at {now_s}, {event}", plain(asdict(clear_faults(state, event)))
    for name in names:
        yield f"row of {name}", plain(asdict(row_for(device_fault(name, ""), catalogue)))
    equal = [ActiveFault(n, row(n, Reaction.HOLD, Clear.WHEN_GONE), "", at, True) for n, at in (("b", 2.0), ("a", 2.0))]
    for name in (
        "rotation.no_reply",
        "tilt.overload",
        "actuator.overload",
        "overload",
        "tilt",
        "can",
        "tilt.nothing",
        "",
    ):
        yield f"find {name}", [found.key for found in find_rows(name)]
    yield "worst of equals", plain(asdict(worst(equal) or equal[1]))
    yield "worst of nothing", worst([])


def answers() -> dict[str, Any]:
    found: dict[str, Any] = {}
    for part in (machine_answers, automatic_answers, gate_answers, late_answers, bound_answers, fault_answers):
        for key, value in part():
            assert key not in found, key
            found[key] = value
    return found


def test_every_answer_is_the_known_one() -> None:
    known = json.loads(GOLDEN.read_text(encoding="utf-8"))
    found = json.loads(json.dumps(answers()))
    assert found.keys() == known.keys()
    different = [key for key in known if found[key] != known[key]]
    assert different == [], f"first: {found[different[0]]} instead of {known[different[0]]}"


def test_a_row_given_twice_is_an_error() -> None:
    twice = row("camera.a", Reaction.WARN, Clear.WHEN_GONE)
    with pytest.raises(ValueError, match=r"^the fault catalogue has two rows camera\.a$"):
        _by_key([twice, twice])


def test_the_catalogue_cannot_be_changed() -> None:
    found = _by_key([row("camera.a", Reaction.WARN, Clear.WHEN_GONE)])
    with pytest.raises(TypeError):
        found["camera.b"] = found["camera.a"]  # type: ignore[index]  # that is the point


if __name__ == "__main__":
    GOLDEN.parent.mkdir(exist_ok=True)
    lines = [f"{json.dumps(key)}:{json.dumps(value, separators=(',', ':'))}" for key, value in answers().items()]
    GOLDEN.write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")
