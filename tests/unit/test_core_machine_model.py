"""The real ``step`` function checked exhaustively: every state reachable under an abstracted alphabet, breadth first.

Times are kept relative to now in steps of 0.1 s and cut off beyond the longest time that matters, which makes the
state space finite; the texts of reasons are left out, because nothing depends on them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import product

import pytest

from graderd.core import commands as cmd
from graderd.core.axes import Goals, Pose
from graderd.core.faults.monitor import ALL_AXES, ActiveFault, Clear, FaultRow, Reaction
from graderd.core.machine import ARMED, Inputs, Lease, MachineSettings, Mode, State, Step, Unmet, step
from graderd.core.rule import Decision, RuleSettings
from graderd.core.soil import SoilObservation, Zone

pytestmark = pytest.mark.xdist_group("core machine model")  # the reachable states are found once

TICK_S = 0.1
SETTINGS = MachineSettings(arm_timeout_s=0.25, lease_s=0.15)
RULE = RuleSettings(
    votes_needed_n=2, votes_window_n=2, dwell_s=0.25, vote_max_age_s=0.25, switch_share=0.5, pass_s=0.35
)
HORIZON_S = 0.4
NOW_S = 100.0

ROW = FaultRow("camera.test", "broken", "cause", "mend", Reaction.WARN, 0.0, Clear.WHEN_GONE, ALL_AXES)
FAULTS: tuple[ActiveFault | None, ...] = (
    None,
    *(ActiveFault("camera.test", replace(ROW, reaction=r), "", NOW_S, True) for r in Reaction),
)
COMMANDS: tuple[tuple[cmd.Command, ...], ...] = (
    (),
    (cmd.Arm(client="a"),),
    (cmd.Disarm(),),
    (cmd.Stop(),),
    (cmd.Reset(stop_n=0),),
    (cmd.Auto(client="a"),),
    (cmd.Manual(client="a"),),
    (cmd.Jog(axis="rotate", value=5.0, client="a"),),
    (cmd.Preset(name="two_stages", client="b"),),
    (cmd.Renew(client="a"),),
    (cmd.Release(client="a"),),
    (cmd.Reset(stop_n=0), cmd.Arm(client="a")),
    (cmd.Arm(client="a"), cmd.Stop()),
)
ZONES = (None, Zone.LEFT, Zone.RIGHT, Zone.UNKNOWN)


@dataclass(frozen=True)
class Letter:
    """One letter of the alphabet: everything the machine is told in one tick."""

    commands: tuple[cmd.Command, ...]
    active: bool
    fault: ActiveFault | None
    zone: Zone | None
    settled: bool
    ready: bool

    def inputs(self) -> Inputs:
        seen = SoilObservation(NOW_S, self.zone, 1.0, "", 0.6, 0.0, 0.6) if self.zone else None
        return Inputs(
            now_s=NOW_S,
            resolve=resolve,
            commands=self.commands,
            observation=seen,
            pose=Pose(0.0, 100.0, 100.0, 50.0),
            settled=self.settled,
            devices_active=self.active,
            unmet=() if self.ready else (Unmet("x", "y", "z"),),
            faults=(self.fault,) if self.fault else (),
        )


def resolve(command: cmd.Jog | cmd.Preset, pose: Pose) -> tuple[Goals, ...] | str:
    if isinstance(command, cmd.Preset):
        return (Goals(lift_left_mm=1.0, lift_right_mm=1.0), Goals(rotation_deg=0.0))
    return (Goals(rotation_deg=command.value),)


def alphabet() -> list[Letter]:
    """All combinations that can differ in effect; zones matter without commands, readiness with arm."""
    letters = [
        Letter(commands, active, fault, None, settled, ready)
        for commands, active, fault, settled, ready in product(
            COMMANDS, (False, True), FAULTS, (True, False), (True, False)
        )
        if ready or any(isinstance(c, cmd.Arm) for c in commands)
    ]
    return letters + [
        Letter((), True, fault, zone, settled, True)
        for zone, fault, settled in product(ZONES[1:], FAULTS, (True, False))
    ]


def canonical(state: State, passed_s: float) -> State:
    """The state ``passed_s`` later, with times relative to now, cut off at the horizon, and without texts."""

    def relative(time_s: float) -> float:
        return NOW_S + max(-HORIZON_S, round(time_s - NOW_S - passed_s, 3))

    votes = tuple(
        replace(v, capture_s=relative(v.capture_s)) for v in state.decision.votes if relative(v.capture_s) > NOW_S - 0.3
    )
    return replace(
        state,
        reason="",
        stop_n=0,
        stops=(),
        holding=(),
        arming_since_s=None if state.arming_since_s is None else relative(state.arming_since_s),
        lease=None if state.lease is None else Lease(state.lease.client, relative(state.lease.expires_s)),
        decision=replace(
            state.decision,
            decided_s=relative(state.decision.decided_s),
            since_m=round(state.decision.since_m, 6),
            counted_s=relative(state.decision.counted_s),
            votes=votes,
        ),
    )


@dataclass
class Model:
    """The reachable states and the steps between them."""

    edges: dict[State, set[State]]
    steps: list[tuple[State, Letter, Step]]


@pytest.fixture(scope="module")
def model() -> Model:
    start = canonical(State(), 0.0)
    letters = [(letter, letter.inputs()) for letter in alphabet()]
    edges: dict[State, set[State]] = {}
    steps: list[tuple[State, Letter, Step]] = []
    queue = deque([start])
    while queue:
        state = queue.popleft()
        if state in edges:
            continue
        edges[state] = set()
        for letter, inputs in letters:
            result = step(state, inputs, SETTINGS, RULE)
            steps.append((state, letter, result))
            successor = canonical(result.state, TICK_S)
            edges[state].add(successor)
            queue.append(successor)
        assert len(edges) < 50_000, "the abstraction is not finite any more"
    return Model(edges, steps)


def test_it_is_a_real_search(model: Model) -> None:
    assert len(model.edges) > 50
    assert {state.mode for state in model.edges} == set(Mode)
    assert any(state.lease for state in model.edges)
    assert any(state.later for state in model.edges)
    assert {state.decision.zone for state in model.edges} >= {None, Zone.LEFT, Zone.RIGHT}
    assert {state.decision.kept for state in model.edges} == {True, False}


def test_never_motion_when_stopped_or_disarmed(model: Model) -> None:
    for _, _, result in model.steps:
        if result.state.mode not in ARMED:
            assert result.intents.goals.empty
        assert result.intents.stop is (result.state.mode is Mode.STOPPED)
        if result.state.mode is Mode.STOPPED:
            assert not result.intents.power


def test_stopped_is_left_only_by_reset_and_never_into_an_armed_mode(model: Model) -> None:
    for state, letter, result in model.steps:
        if state.mode is Mode.STOPPED and result.state.mode is not Mode.STOPPED:
            assert any(isinstance(c, cmd.Reset) for c in letter.commands)
            assert result.state.mode is Mode.DISARMED
        if result.state.mode in ARMED and state.mode not in ARMED:
            # Armed comes from nothing but an arm asked for in an earlier tick, whose devices then became active.
            assert state.arming_since_s is not None
            assert letter.active


def test_no_target_on_arming(model: Model) -> None:
    for state, letter, result in model.steps:
        if result.state.mode in ARMED and state.mode not in ARMED:
            moved = any(isinstance(c, cmd.Jog | cmd.Preset) for c in letter.commands)
            assert result.intents.goals.empty or moved
            assert result.state.decision == Decision()


def test_every_fault_leads_to_its_reaction_in_the_same_tick(model: Model) -> None:
    for state, letter, result in model.steps:
        if letter.fault is None:
            continue
        reaction = letter.fault.row.reaction
        if reaction >= Reaction.HOLD:
            assert result.intents.goals.empty
        if reaction is Reaction.RETREAT and state.mode is Mode.AUTO:
            assert result.state.mode is not Mode.AUTO or any(isinstance(c, cmd.Auto) for c in letter.commands)
        if reaction >= Reaction.DISARM:
            assert result.state.mode not in ARMED
            assert result.state.arming_since_s is None
        if reaction is Reaction.STOP:
            assert result.state.mode is Mode.STOPPED


def test_stop_always_wins(model: Model) -> None:
    for _, letter, result in model.steps:
        if any(isinstance(c, cmd.Stop) for c in letter.commands):
            assert result.state.mode is Mode.STOPPED


def test_no_state_without_an_exit(model: Model) -> None:
    """From every reachable state the machine can be disarmed, stopped, and brought to manual and auto."""
    for wanted in (Mode.DISARMED, Mode.STOPPED, Mode.MANUAL, Mode.AUTO):
        reaches = {state for state in model.edges if state.mode is wanted}
        grown = True
        while grown:
            more = {s for s, after in model.edges.items() if s not in reaches and after & reaches}
            grown = bool(more)
            reaches |= more
        assert reaches == set(model.edges)


def test_a_lapsed_lease_ends_motion(model: Model) -> None:
    for state, letter, result in model.steps:
        if state.lease is not None and state.lease.expires_s < NOW_S and not letter.commands:
            assert result.intents.goals.empty
            assert result.state.lease is None
