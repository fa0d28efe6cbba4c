"""The tick as data: what it knows goes in as one value, what it decided comes out as one, and nobody asks twice.

``golden/tick.json`` is a recorded stretch of work, as ``Sensed`` was, with what ``Tick`` said then. After a change that
is meant: ``python -m tests.unit.test_core_tick`` writes it anew; read the difference before you commit it.
"""

from __future__ import annotations

import ast
import asyncio
import json
import math
from collections import Counter
from dataclasses import asdict, is_dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

import graderd
from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core import readiness
from graderd.core.axes import AXES, PARTS
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import ALL_AXES, Clear, Reaction, held_axes
from graderd.core.machine import Mode
from graderd.core.soil import SoilObservation, Zone
from graderd.core.tick import Controller, Sensed, Tick
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.reading import Reading
from graderd.hal.vehicle import VehicleTelemetry
from graderd.runtime.control import ControlLoop
from graderd.runtime.state_file import StateFile
from harness.fakes import FakeMachine
from harness.stretch import FASTEST, HOME, SETTINGS, TICK_S, standing, stretch_of_work

GOLDEN = Path(__file__).parent / "golden" / "tick.json"
RECORDED = TypeAdapter(list[Sensed])
KEPT_EVERY_N = 3
"""Of the ticks, in the file: each holds what all before it led to."""


def told(tick: Tick) -> Any:
    """A tick as JSON has it, its numbers rounded so that no platform's last bit matters."""
    return _plain(
        {
            "mode": tick.state.mode,
            "reason": tick.state.reason,
            "pose": tick.pose,
            "attitude": tick.attitude,
            "faults": [(f.name, f.present, f.since_s) for f in tick.faults],
            "unmet": [r.name for r in tick.readiness if not r.met],
            "axes": dict(tick.axes),
            "replies": [reply.model_dump() for reply in tick.replies],
            "stopped_now": tick.stopped_now,
            "soil": None if tick.soil is None else [tick.soil.zone, tick.soil.frame_number],
            "overruns_n": tick.overruns_n,
        }
    )


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def run(recorded: list[Sensed]) -> list[Tick]:
    controller = Controller(SETTINGS)
    return [controller.step(sensed) for sensed in recorded]


def test_a_recorded_list_of_sensed_gives_the_recorded_list_of_ticks() -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    ticks = [told(tick) for tick in run(RECORDED.validate_python(golden["sensed"]))[::KEPT_EVERY_N]]
    assert len(ticks) == len(golden["ticks"]) == 100
    for number, (now, then) in enumerate(zip(ticks, golden["ticks"], strict=True)):
        assert now == then, f"tick {number * KEPT_EVERY_N}"


def test_the_recorded_stretch_has_everything_in_it() -> None:
    ticks = run(stretch_of_work())
    assert {tick.state.mode for tick in ticks} == set(Mode)
    assert {fault.name for tick in ticks for fault in tick.faults} >= {"lift_left.no_feedback", "daemon.tick_overrun"}
    assert max(tick.axes["rotation"].limited or 0.0 for tick in ticks) == pytest.approx(30.0, abs=25.0)
    assert any(decided.arrived for tick in ticks for decided in tick.axes.values())
    assert any("soft limit" in tick.axes["rotation"].because for tick in ticks)


@pytest.mark.parametrize("exclude_none", [False, True])
def test_writing_sensed_down_and_reading_it_loses_nothing(exclude_none: bool) -> None:
    recorded = stretch_of_work()
    again = RECORDED.validate_json(RECORDED.dump_json(recorded, exclude_none=exclude_none))
    assert again == recorded
    assert [told(tick) for tick in run(again)] == [told(tick) for tick in run(recorded)]


def test_replies_come_in_the_order_of_the_commands() -> None:
    commands = (cmd.Arm(client="a"), cmd.Stop(client="b"), cmd.Reset(client="a", stop_n=0))
    tick = Controller(SETTINGS).step(Sensed(1.0, standing(1.0, HOME), commands=commands))
    assert [reply.command for reply in tick.replies] == ["arm", "stop", "reset"]
    assert tick.stopped_now


@pytest.mark.parametrize("no_auto", ["", "colour was never measured here"])
def test_what_may_not_drive_is_refused_automatic_operation_alone(no_auto: str) -> None:
    controller = Controller(replace(SETTINGS, no_auto=no_auto))
    controller.step(Sensed(1.0, standing(1.0, HOME, Lifecycle.STANDBY), commands=(cmd.Arm(),)))
    controller.step(Sensed(1.02, standing(1.02, HOME), powered=True))
    tick = controller.step(Sensed(1.04, standing(1.04, HOME), commands=(cmd.Auto(),), powered=True))
    assert tick.replies[0].accepted is not bool(no_auto)
    assert tick.state.mode is (Mode.MANUAL if no_auto else Mode.AUTO)
    asked = next(one for one in tick.readiness if one.name == readiness.AUTOMATIC)
    assert (asked.met, asked.mandatory) == (not no_auto, False)
    if no_auto:
        assert no_auto in tick.replies[0].message
        assert "calibrate color" in tick.replies[0].remedy


def test_a_held_axis_has_not_arrived() -> None:
    controller, at = Controller(SETTINGS), HOME
    step = partial(Sensed, powered=True)
    controller.step(Sensed(1.0, standing(1.0, at, Lifecycle.STANDBY), commands=(cmd.Arm(),)))
    controller.step(step(1.02, standing(1.02, at)))
    controller.step(step(1.04, standing(1.04, at), commands=(cmd.Jog(axis="rotate", value=2.0),)))
    tick = controller.step(step(1.06, standing(1.06, at | {"rotation": 2.0}, goals={"rotation": 2.0})))
    assert tick.axes["rotation"].arrived
    low = DeviceFault("rotation", "voltage_low", "18 V", 1.0)
    for number in range(200):
        now_s = 1.08 + TICK_S * number
        tick = controller.step(step(now_s, standing(now_s, at), faults=(low,), commands=(cmd.Renew(),)))
    assert not tick.axes["rotation"].arrived


def test_a_latch_is_let_go_only_by_what_the_machine_accepts() -> None:
    """A jammed servo that came free, a reset with nothing to reset: the hold stays until the machine is armed anew."""
    latching = next(
        row for row in CATALOGUE.values() if row.clear is Clear.ON_REARM and row.reaction is Reaction.RETREAT
    )
    device, _, condition = latching.key.replace("actuator", "lift_left").partition(".")
    controller, step = Controller(SETTINGS), partial(Sensed, powered=True)
    jammed = (DeviceFault(device, condition, "", 1.0),)
    controller.step(Sensed(1.0, standing(1.0, HOME, Lifecycle.STANDBY), commands=(cmd.Arm(),)))
    for number in range(100):
        controller.step(step(1.1 + TICK_S * number, standing(1.1 + TICK_S * number, HOME), faults=jammed))
    commands: tuple[cmd.AnyCommand, ...] = (cmd.Reset(stop_n=0), cmd.Arm(), cmd.Manual(), cmd.Auto())
    for number, command in enumerate(commands):
        now_s = 4.0 + TICK_S * number
        tick = controller.step(step(now_s, standing(now_s, HOME), commands=(command,)))
        assert [fault.name for fault in tick.faults] == [f"{device}.{condition}"], command
    off = partial(standing, at=HOME, lifecycle=Lifecycle.STANDBY)
    controller.step(step(5.0, standing(5.0, HOME), commands=(cmd.Disarm(),)))
    unmeasured = {name: replace(axis, lifecycle=Lifecycle.FAILED) for name, axis in off(5.1).items()}
    refused = controller.step(Sensed(5.1, unmeasured, commands=(cmd.Arm(),)))
    assert not refused.replies[0].accepted
    assert refused.faults
    shot = (DeviceFault("rotation", "overspeed", "", 5.15),)  # in the very tick that would arm
    stopped = controller.step(Sensed(5.15, off(5.15), faults=shot, commands=(cmd.Arm(),)))
    assert not stopped.replies[0].accepted
    assert len(stopped.faults) == 2
    named = cmd.Reset(stop_n=stopped.state.stop_n)
    assert not controller.step(Sensed(5.2, off(5.2), commands=(named,))).faults


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.MANUAL])
@pytest.mark.parametrize("key", sorted(key for key, row in CATALOGUE.items() if row.reaction >= Reaction.HOLD))
def test_no_fault_that_goes_lets_motion_go_on_without_a_fresh_decision_or_a_command(key: str, mode: Mode) -> None:
    part, _, condition = key.partition(".")
    row, device = CATALOGUE[key], "lift_left" if part == "actuator" else part
    turning = "rotation" if mode is Mode.AUTO or "rotation" in row.axes else "tilt"
    if mode is Mode.MANUAL and row.axes <= {"lift", "own"} and row.axes:
        turning = "lift_left"
    controller, at, goals, sent = Controller(SETTINGS), dict(HOME), dict[str, float](), list[float]()
    struck_n: int | None = None
    commands: dict[int, tuple[cmd.AnyCommand, ...]] = {3: (cmd.Arm(client="a"),)}
    powered, held = False, frozenset[str]()
    for number in range(400):
        now_s = 100.0 + TICK_S * number
        if struck_n is None and turning in goals and abs(at[turning] - HOME[turning]) > 1.0:
            struck_n = number
        present = struck_n is not None and number - struck_n <= (row.debounce_s + 0.1) / TICK_S
        if struck_n is not None and number - struck_n > (row.debounce_s + 0.1) / TICK_S + 40:
            break
        if mode is Mode.AUTO:
            commands[8] = (cmd.Auto(client="a"),)
        elif number == 8:
            axis = {"rotation": "rotate", "lift_left": "height", "tilt": "pitch"}[turning]
            commands[8] = (cmd.Jog(axis=axis, value=5.0, relative=True, client="a"),)
        elif number > 8:
            commands[number] = (cmd.Renew(client="a"),)
        seen = SoilObservation(now_s - 0.03, Zone.LEFT, 0.9, "", 0.8, 0.15, 0.05, frame_number=number)
        tick = controller.step(
            Sensed(
                now_s,
                standing(now_s, at, Lifecycle.ACTIVE if powered else Lifecycle.STANDBY, goals),
                faults=(DeviceFault(device, condition, "", now_s),) if present else (),
                commands=commands.get(number, ()),
                observation=seen if number % 2 and struck_n is None else None,
                powered=powered,
            )
        )
        powered = tick.intents.power
        if not held and tick.faults:
            ends = row.reaction >= Reaction.DISARM or (row.reaction is Reaction.RETREAT and mode is Mode.AUTO)
            held = frozenset(held_axes(tick.faults)) if mode is Mode.AUTO or not row.automatic_only else held
            held = ALL_AXES if ends else held
        sent += [d.send for axis, d in tick.axes.items() if PARTS[axis] in held and d.send is not None]
        goals = {
            axis: decided.send if decided.send is not None else goals[axis]
            for axis, decided in tick.axes.items()
            if decided.send is not None or (axis in goals and not decided.hold)
        }
        for axis, goal in goals.items():
            at[axis] += max(-FASTEST[axis] * TICK_S, min(goal - at[axis], FASTEST[axis] * TICK_S))
    assert struck_n is not None, "it never moved"
    assert sent == []
    if row.reaction >= Reaction.RETREAT:
        assert tick.state.mode is not Mode.AUTO
        if mode is Mode.AUTO:
            assert row.reads in tick.state.reason


def test_a_camera_that_comes_and_goes_lets_a_standing_blade_swing_no_more_often() -> None:
    controller, at, goals, decided = Controller(SETTINGS), dict(HOME), dict[str, float](), list[tuple[float, Zone]]()
    commands: dict[int, tuple[cmd.AnyCommand, ...]] = {0: (cmd.Arm(),), 2: (cmd.Auto(),)}
    for number in range(400):
        now_s = 100.0 + TICK_S * number
        zone = Zone.CENTER if number // 40 % 2 else Zone.LEFT
        shares = (0.05, 0.9) if number // 40 % 2 else (0.9, 0.05)
        tick = controller.step(
            Sensed(
                now_s,
                standing(now_s, at, Lifecycle.ACTIVE if number else Lifecycle.STANDBY, goals),
                faults=(DeviceFault("camera", "stale", "", now_s),) if number % 40 == 0 else (),
                commands=commands.get(number, ()),
                observation=SoilObservation(now_s, zone, 0.9, "", *shares, 0.05, frame_number=number),
                powered=number > 0,
                vehicle=VehicleTelemetry(Reading(0.0, now_s), Reading(7.0, now_s)),
            )
        )
        turning = tick.axes["rotation"]
        goals = {"rotation": turning.send} if turning.send is not None else {} if turning.hold else goals
        at["rotation"] += max(-0.5, min(goals.get("rotation", at["rotation"]) - at["rotation"], 0.5))
        if (found := tick.state.decision.zone) is not None and (not decided or found is not decided[-1][1]):
            decided.append((now_s, found))
    assert len(decided) > 1
    assert all(b - a >= SETTINGS.rule.dwell_s for (a, _), (b, _) in pairwise(decided))


async def test_a_stop_makes_void_what_was_asked_before_it(tmp_path: Path) -> None:
    machine = FakeMachine()
    loop = ControlLoop(Config(), machine.devices, machine.eyes, machine.clock, StateFile(str(tmp_path)))
    first = loop.stop_now(cmd.Stop(reason="dog", client="a"))
    asked = asyncio.create_task(loop.command(cmd.Reset(client="b", stop_n=loop.tick.state.stop_n)), name="reset")
    await asyncio.sleep(0)
    second = loop.stop_now(cmd.Stop(reason="child", client="c"))
    assert first.accepted
    assert second.accepted
    assert not (await asked).accepted
    loop.run_tick()
    assert loop.tick.state.mode is Mode.STOPPED
    assert loop.tick.state.reason == "dog (by a); also: child (by c)"
    await loop._power.close()


async def test_each_device_is_asked_once_a_tick_and_readiness_is_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, asked = FakeMachine(), Counter[str]()
    loop = ControlLoop(Config(), machine.devices, machine.eyes, machine.clock, StateFile(str(tmp_path)))

    def count(name: str, call: Any) -> Any:
        def counted(*arguments: Any) -> Any:
            asked[name] += 1
            return call(*arguments)

        return counted

    for name, device in machine.devices.all().items():
        monkeypatch.setattr(device, "telemetry", count(name, device.telemetry))
    monkeypatch.setattr("graderd.core.tick.requirements", count("requirements", readiness.requirements))
    loop.run_tick()
    assert asked == Counter({**dict.fromkeys(AXES, 1), "requirements": 1})
    await loop._power.close()


@pytest.mark.parametrize(
    ("age_s", "travelled_m", "told"),
    [(0.1, 7.0, True), (0.6, 7.0, False), (0.1, math.nan, False), (0.1, math.inf, False)],
)
def test_an_old_speed_is_none_and_so_is_a_distance_that_is_no_number(
    age_s: float, travelled_m: float, told: bool
) -> None:
    """Then the time counts, not the travel."""
    controller, step = Controller(SETTINGS), partial(Sensed, powered=True)
    controller.step(Sensed(1.0, standing(1.0, HOME, Lifecycle.STANDBY), commands=(cmd.Arm(),)))
    for number in range(1, 50):
        now_s = 1.0 + TICK_S * number
        seen = SoilObservation(now_s, Zone.LEFT, 0.9, "", 0.8, 0.15, 0.05)
        vehicle = VehicleTelemetry(Reading(0.5, now_s - age_s), Reading(travelled_m, now_s - age_s))
        commands = (cmd.Auto(),) if number == 2 else ()
        tick = controller.step(step(now_s, standing(now_s, HOME), commands=commands, observation=seen, vehicle=vehicle))
        if tick.state.decision.zone is not None:
            break
    assert (tick.state.decision.zone, tick.state.decision.silent) == (Zone.LEFT, not told)


def test_nobody_but_the_tick_calls_what_it_decides_with() -> None:
    deciding = {
        "machine": {"step"},
        "gate": {"pass_gate"},
        "faults.monitor": {"update_faults", "clear_faults"},
        "lift_pair": {"LiftCoordinator"},
        "readiness": {"requirements"},
        "rule": {"decide", "interrupted"},
        "motion": {"resolve"},
        "plausibility": {"PlausibilityMonitor"},
    }
    theirs = {name: f"graderd.core.{module}" for module, names in deciding.items() for name in names}
    root = Path(graderd.__file__).parent
    callers: dict[str, set[str]] = {}
    for path in root.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
        taken = {alias.name for node in froms for alias in node.names if theirs.get(alias.name) == node.module}
        whole = {alias.asname or alias.name for node in froms for alias in node.names} | {
            alias.asname or alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names
        }
        taken |= {
            node.attr
            for node in nodes
            if isinstance(node, ast.Attribute)
            and node.attr in theirs
            and ast.unparse(node.value) in whole
            and ast.unparse(node.value).rpartition(".")[2] == theirs[node.attr].rpartition(".")[2]
        }
        if taken:
            callers[path.relative_to(root).as_posix()] = taken
    of_the_machine = {"decide", "interrupted"}
    assert callers == {"core/machine.py": of_the_machine, "core/tick.py": theirs.keys() - of_the_machine}


def main() -> None:
    """Write the golden file anew."""
    recorded = stretch_of_work()
    golden = {
        "sensed": RECORDED.dump_python(recorded, mode="json", exclude_none=True),
        "ticks": [told(t) for t in run(recorded)[::KEPT_EVERY_N]],
    }
    GOLDEN.write_text(json.dumps(golden, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
