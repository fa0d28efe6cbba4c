"""The state machine on all states x all events, as stories, and as a stateful property."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from graderd.core import commands as cmd
from graderd.core.axes import Goals, Pose
from graderd.core.faults.monitor import ALL_AXES, ActiveFault, Clear, FaultRow, Reaction
from graderd.core.machine import ARMED, Inputs, MachineSettings, Mode, State, Step, Unmet, step
from graderd.core.rule import Decision, RuleSettings, Travel
from graderd.core.soil import SoilObservation, Zone

SETTINGS, RULE = MachineSettings(), RuleSettings()
POSE = Pose(1.0, 100.0, 100.0, 50.0)
NOW_S = 1000.0


def resolve(command: cmd.Jog | cmd.Preset, pose: Pose) -> tuple[Goals, ...] | str:
    """Stands for graderd.core.motion: rotates to the value, refuses beyond 60, presets have two stages."""
    if isinstance(command, cmd.Preset):
        return (Goals(lift_left_mm=150.0, lift_right_mm=150.0), Goals(rotation_deg=0.0))
    return (Goals(rotation_deg=command.value),) if abs(command.value) <= 60 else "beyond the limits"


def inputs(*commands: cmd.Command, now_s: float = NOW_S, **changes: Any) -> Inputs:
    base = Inputs(now_s=now_s, resolve=resolve, commands=commands, pose=POSE)
    return base._replace(**changes)


def fault(reaction: Reaction, axes: Set[str] = ALL_AXES, name: str = "camera.test") -> ActiveFault:
    row = FaultRow(name, "it is broken", "cause", "mend it", reaction, 0.0, Clear.WHEN_GONE, frozenset(axes))
    return ActiveFault(name, row, "detail", NOW_S - 0.6, True)


def do(state: State, *commands: cmd.Command, **changes: Any) -> Step:
    return step(state, inputs(*commands, **changes), SETTINGS, RULE)


DISARMED = State()
ARMING = State(arming_since_s=NOW_S - 0.1)
MANUAL = State(mode=Mode.MANUAL)
AUTO = State(mode=Mode.AUTO)
STOPPED = State(mode=Mode.STOPPED, reason="test")
JOGGING = do(MANUAL, cmd.Jog(axis="rotate", value=10.0, client="a"), devices_active=True).state
STATES = {
    "disarmed": DISARMED, "arming": ARMING, "manual": MANUAL, "jogging": JOGGING, "auto": AUTO, "stopped": STOPPED
}  # fmt: skip

J = cmd.Jog(axis="rotate", value=10.0, client="a")
EVENTS: dict[str, Inputs] = {
    "nothing": inputs(devices_active=True),
    "arm": inputs(cmd.Arm(client="a"), devices_active=False),
    "arm, not ready": inputs(cmd.Arm(client="a"), unmet=(Unmet("tilt", "silent", "look"),)),
    "disarm": inputs(cmd.Disarm(client="a"), devices_active=True),
    "stop": inputs(cmd.Stop(client="b"), devices_active=True),
    "reset": inputs(cmd.Reset(client="a", stop_n=0), devices_active=True),
    "auto": inputs(cmd.Auto(client="a"), devices_active=True),
    "auto, not ready": inputs(
        cmd.Auto(client="a"), devices_active=True, unmet_for_auto=(Unmet("method", "new", "show"),)
    ),
    "manual": inputs(cmd.Manual(client="a"), devices_active=True),
    "jog": inputs(J, devices_active=True),
    "jog too far": inputs(cmd.Jog(axis="rotate", value=61.0, client="a"), devices_active=True),
    "preset": inputs(cmd.Preset(name="x", client="a"), devices_active=True),
    "renew": inputs(cmd.Renew(client="a"), devices_active=True),
    "release": inputs(cmd.Release(client="a"), devices_active=True),
    "other client": inputs(cmd.Jog(axis="rotate", value=5.0, client="b"), devices_active=True),
    "devices lost": inputs(devices_active=False),
    "arm error": inputs(devices_active=False, arm_error="no"),
    "warn": inputs(devices_active=True, faults=(fault(Reaction.WARN),)),
    "hold": inputs(devices_active=True, faults=(fault(Reaction.HOLD),)),
    "retreat": inputs(devices_active=True, faults=(fault(Reaction.RETREAT),)),
    "fault disarm": inputs(devices_active=True, faults=(fault(Reaction.DISARM),)),
    "fault stop": inputs(devices_active=True, faults=(fault(Reaction.STOP),)),
    "later": inputs(devices_active=True, now_s=NOW_S + 10.0),
}
D, R, M, J_, A, S = "disarmed", "arming", "manual", "jogging", "auto", "stopped"
# event -> the state after it, in the order disarmed, arming, manual, jogging, auto, stopped
TABLE: dict[str, tuple[str, str, str, str, str, str]] = {
    "nothing": (D, M, M, J_, A, S),
    "arm": (R, R, R, R, R, S),
    "arm, not ready": (D, R, D, D, D, S),
    "disarm": (D, D, D, D, D, S),
    "stop": (S, S, S, S, S, S),
    "reset": (D, M, M, J_, A, D),
    "auto": (D, M, A, A, A, S),
    "auto, not ready": (D, M, M, J_, A, S),
    "manual": (D, M, M, M, M, S),
    "jog": (D, M, J_, J_, A, S),
    "jog too far": (D, M, M, J_, A, S),
    "preset": (D, M, J_, J_, A, S),
    "renew": (D, M, M, J_, A, S),
    "release": (D, M, M, M, A, S),
    "other client": (D, M, J_, J_, A, S),
    "devices lost": (D, R, D, D, D, S),
    "arm error": (D, D, D, D, D, S),
    "warn": (D, M, M, J_, A, S),
    "hold": (D, M, M, M, A, S),
    "retreat": (D, M, M, M, M, S),
    "fault disarm": (D, D, D, D, D, S),
    "fault stop": (S, S, S, S, S, S),
    "later": (D, M, M, M, A, S),
}


def kind(state: State) -> str:
    if state.arming_since_s is not None:
        return "arming"
    return "jogging" if state.mode is Mode.MANUAL and state.lease is not None else str(state.mode)


def test_the_table_is_complete() -> None:
    assert set(TABLE) == set(EVENTS)
    assert list(STATES) == [kind(state) for state in STATES.values()]


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("index", range(6), ids=list(STATES))
def test_all_states_by_all_events(index: int, event: str) -> None:
    state = list(STATES.values())[index]
    result = step(state, EVENTS[event], SETTINGS, RULE)
    assert kind(result.state) == TABLE[event][index]
    assert len(result.replies) == len(EVENTS[event].commands)
    check_safe(result)


def check_safe(result: Step) -> None:
    """What holds after every step, whatever happened."""
    state, intents = result.state, result.intents
    if state.mode not in ARMED:
        assert intents.goals.empty
    assert intents.stop is (state.mode is Mode.STOPPED)
    assert intents.power is (state.mode in ARMED or state.arming_since_s is not None)
    if state.arming_since_s is not None:
        assert state.mode is Mode.DISARMED
    if state.lease is not None:
        assert state.mode is Mode.MANUAL
    if state.mode is Mode.AUTO:
        assert intents.goals in (Goals(), Goals(rotation_deg=state.decision.angle_deg))
    assert state.reason


def test_stop_wins_over_commands_of_the_same_tick() -> None:
    result = do(MANUAL, cmd.Auto(client="a"), J, cmd.Stop(), cmd.Arm(), devices_active=True)
    assert result.state.mode is Mode.STOPPED
    assert result.replies[0].command == "stop"
    assert [r.accepted for r in result.replies[1:]] == [False, False, False]


def test_a_second_stops_reason_is_kept_beside_the_firsts_and_each_is_counted() -> None:
    first = do(AUTO, cmd.Stop(reason="dog on the site"), devices_active=True).state
    second = do(first, cmd.Stop(reason="again"))
    assert second.replies[0].accepted
    assert second.state.reason == "dog on the site; also: again"
    third = do(second.state, cmd.Stop(reason="dog on the site")).state
    assert third.reason == "dog on the site"
    assert (first.stop_n, second.state.stop_n, third.stop_n) == (1, 2, 3)
    failed = do(first, faults=(fault(Reaction.STOP),)).state
    assert failed.reason == "dog on the site; also: camera.test: it is broken"
    assert do(failed, faults=(fault(Reaction.STOP),)).state == failed


def test_a_fault_that_stops_is_a_stop_of_its_own_also_beside_and_after_another() -> None:
    first, second = (replace(f, name=f"rotation.{n}") for n, f in zip("ab", [fault(Reaction.STOP)] * 2, strict=True))
    state = do(AUTO, faults=(first,), devices_active=True).state
    seen_n = state.stop_n
    for both in ((first, second), (replace(first, present=False), second)):
        state = do(state, faults=both).state
        assert (state.stop_n, state.reason.count("rotation.b")) == (seen_n + 1, 1)
    gone = tuple(replace(f, present=False) for f in (first, second))
    late = do(state, cmd.Reset(stop_n=seen_n), faults=gone)
    assert not late.replies[0].accepted
    assert "rotation.b" in late.replies[0].message
    again = do(late.state, faults=(first, gone[1])).state
    assert again.stop_n == seen_n + 2
    for _ in range(3):  # neither one that stands, nor another stop beside it, counts it anew
        again = do(again, faults=(first, gone[1])).state
    beside = do(again, cmd.Stop(reason="child"), faults=(first, gone[1])).state
    assert do(beside, faults=(first, gone[1])).state == beside
    assert beside.stop_n == seen_n + 3
    assert do(beside, cmd.Reset(stop_n=beside.stop_n), faults=gone).state.mode is Mode.DISARMED


def test_automatic_operation_that_would_end_in_the_next_tick_is_refused_with_its_reason() -> None:
    """Told that it is automatic, a person would turn away from a machine that is not."""
    manual = do(AUTO, cmd.Manual(), devices_active=True).state
    asked = do(manual, cmd.Auto(), faults=(fault(Reaction.RETREAT),), devices_active=True)
    assert not asked.replies[0].accepted
    assert asked.replies[0].message.startswith("camera.test: ")
    assert asked.replies[0].remedy
    assert asked.state.mode is Mode.MANUAL
    for passing in (Reaction.WARN, Reaction.HOLD):  # a hold goes by itself, and is told
        assert do(manual, cmd.Auto(), faults=(fault(passing),), devices_active=True).state.mode is Mode.AUTO


def test_a_reset_clears_the_stop_it_names_and_none_that_came_after() -> None:
    first = do(AUTO, cmd.Stop(reason="dog on the site"), devices_active=True).state
    second = do(first, cmd.Stop(reason="child on the site")).state
    late = do(second, cmd.Reset(stop_n=first.stop_n))
    assert late.state == second
    assert not late.replies[0].accepted
    assert "child on the site" in late.replies[0].message
    assert do(second, cmd.Reset(stop_n=second.stop_n)).state.mode is Mode.DISARMED


def test_stopped_is_left_only_by_reset_then_arm() -> None:
    for command in (cmd.Arm(), cmd.Auto(), cmd.Manual(), J, cmd.Disarm(), cmd.Renew(client="a")):
        assert do(STOPPED, command, devices_active=True).state.mode is Mode.STOPPED
    reset = do(STOPPED, cmd.Reset(stop_n=0)).state
    assert kind(reset) == "disarmed"
    arming = do(reset, cmd.Arm()).state
    assert kind(arming) == "arming"
    assert kind(do(arming, devices_active=True).state) == "manual"


def test_a_reset_of_the_same_tick_does_not_undo_a_stop() -> None:
    for commands in ((cmd.Stop(), cmd.Reset(stop_n=0)), (cmd.Reset(stop_n=0), cmd.Stop())):
        for state in (AUTO, STOPPED):
            result = do(state, *commands, devices_active=True)
            assert result.state.mode is Mode.STOPPED
            assert [reply.accepted for reply in result.replies] == [True, False]


def test_a_latched_fault_of_severity_disarm_keeps_arming_away() -> None:
    latched = replace(fault(Reaction.DISARM), present=False)
    reply = do(DISARMED, cmd.Arm(), faults=(latched,)).replies[0]
    assert not reply.accepted
    assert (reply.message, reply.remedy) == ("camera.test: it is broken", "mend it")


def test_reset_is_refused_while_the_fault_is_present() -> None:
    result = do(STOPPED, cmd.Reset(stop_n=0), faults=(fault(Reaction.STOP),))
    assert result.state.mode is Mode.STOPPED
    assert not result.replies[0].accepted
    assert result.replies[0].remedy == "mend it"


def test_a_latched_fault_that_is_gone_lets_reset_pass() -> None:
    gone = replace(fault(Reaction.STOP), present=False)
    result = do(STOPPED, cmd.Reset(stop_n=0), faults=(gone,))
    assert result.replies[0].accepted


def test_arming_refuses_with_every_unmet_requirement() -> None:
    unmet = (Unmet("tilt", "no feedback", "check the cable"), Unmet("rotation", "closed", "plug it in"))
    reply = do(DISARMED, cmd.Arm(), unmet=unmet).replies[0]
    assert not reply.accepted
    assert "tilt: no feedback" in reply.message
    assert "rotation: closed" in reply.message
    assert reply.remedy == "check the cable; plug it in"


def test_arming_gives_up_in_time() -> None:
    late = ARMING.arming_since_s
    assert late is not None
    still = do(ARMING, now_s=late + SETTINGS.arm_timeout_s)
    assert kind(still.state) == "arming"
    over = do(ARMING, now_s=late + SETTINGS.arm_timeout_s + 0.001)
    assert kind(over.state) == "disarmed"
    assert "longer than" in over.state.reason


def test_no_target_on_arming() -> None:
    armed = do(ARMING, devices_active=True)
    assert armed.intents.goals.empty
    assert armed.state.decision == Decision()
    auto = do(armed.state, cmd.Auto(), devices_active=True)
    assert auto.intents.goals.empty


def test_a_jog_moves_until_its_lease_lapses() -> None:
    moving = do(MANUAL, J, devices_active=True)
    assert moving.intents.goals == Goals(rotation_deg=10.0)
    end_s = NOW_S + SETTINGS.lease_s
    assert do(moving.state, devices_active=True, now_s=end_s).intents.goals == Goals(rotation_deg=10.0)
    lapsed = do(moving.state, devices_active=True, now_s=end_s + 0.001)
    assert lapsed.intents.goals.empty
    assert "lapsed" in lapsed.state.reason
    renewed = do(moving.state, cmd.Renew(client="a"), devices_active=True, now_s=end_s)
    assert do(renewed.state, devices_active=True, now_s=end_s + 0.2).intents.goals == Goals(rotation_deg=10.0)


def test_one_client_commands_at_a_time_but_anyone_may_stop() -> None:
    moving = do(MANUAL, J, devices_active=True).state
    for command in (cmd.Jog(axis="rotate", value=1, client="b"), cmd.Auto(client="b"), cmd.Manual(client="b")):
        reply = do(moving, command, devices_active=True).replies[0]
        assert not reply.accepted
        assert "a is moving" in reply.message
    assert not do(moving, cmd.Renew(client="b"), devices_active=True).replies[0].accepted
    assert not do(moving, cmd.Release(client="b"), devices_active=True).replies[0].accepted
    assert do(moving, cmd.Disarm(client="b"), devices_active=True).state.mode is Mode.DISARMED
    assert do(moving, cmd.Stop(client="b"), devices_active=True).state.mode is Mode.STOPPED


def test_a_preset_goes_stage_by_stage() -> None:
    first = do(MANUAL, cmd.Preset(name="transport", client="a"), devices_active=True, settled=False)
    assert first.intents.goals == Goals(lift_left_mm=150.0, lift_right_mm=150.0)
    waiting = do(first.state, cmd.Renew(client="a"), devices_active=True, settled=False)
    assert waiting.intents.goals == first.intents.goals
    second = do(waiting.state, cmd.Renew(client="a"), devices_active=True, settled=True)
    assert second.intents.goals == Goals(rotation_deg=0.0)
    assert second.state.later == ()


def test_a_preset_does_not_skip_its_first_stage_because_the_blade_stood_still() -> None:
    taken = do(MANUAL, cmd.Preset(name="transport", client="a"), devices_active=True, settled=True)
    assert taken.intents.goals == Goals(lift_left_mm=150.0, lift_right_mm=150.0)
    assert taken.state.later == (Goals(rotation_deg=0.0),)
    again = do(taken.state, cmd.Preset(name="transport", client="a"), devices_active=True, settled=True)
    assert again.intents.goals == Goals(rotation_deg=0.0)


def test_a_blind_camera_holds_automatic_operation_and_not_the_operator() -> None:
    blind = fault(Reaction.HOLD, frozenset({"rotation"}))
    blind = replace(blind, row=replace(blind.row, automatic_only=True))
    assert do(JOGGING, devices_active=True, faults=(blind,)).intents.goals == Goals(rotation_deg=10.0)
    assert do(JOGGING, devices_active=True, faults=(blind,)).state.holding == ()
    turning = replace(AUTO, decision=Decision(Zone.LEFT, 30.0, NOW_S), goals=Goals(rotation_deg=30.0))
    held = do(turning, devices_active=True, faults=(blind,))
    assert held.intents.goals.empty
    assert held.state.holding


def test_faults_hold_only_the_axes_they_name() -> None:
    goals = {"rotation": Goals(1.0), "lift": Goals(None, 2.0, 3.0), "tilt": Goals(tilt_mm=4.0)}
    for moved, wanted in goals.items():
        for named in goals:
            result = do(replace(JOGGING, goals=wanted), devices_active=True, faults=(fault(Reaction.HOLD, {named}),))
            assert result.intents.goals == (Goals() if moved == named else wanted)
        moving = replace(JOGGING, goals=wanted)
        assert do(moving, devices_active=True, faults=(fault(Reaction.HOLD),)).intents.goals.empty
        assert do(moving, devices_active=True, faults=(fault(Reaction.WARN),)).intents.goals == wanted


def test_what_was_held_does_not_go_on_by_itself() -> None:
    jogging = do(MANUAL, J, devices_active=True).state
    for held in ({"faults": (fault(Reaction.HOLD),)}, {"held": {"rotation": "no fresh measurement of this axis"}}):
        ended = do(jogging, devices_active=True, **held)
        assert ended.intents.goals.empty
        assert ended.state.reason.startswith("rotation was held: ")
        assert not do(ended.state, cmd.Renew(client="a"), devices_active=True).replies[0].accepted
        turning = replace(AUTO, decision=Decision(Zone.LEFT, 30.0, NOW_S - 5.0), goals=Goals(rotation_deg=30.0))
        after = do(turning, devices_active=True, **held).state
        assert (after.decision.angle_deg, after.decision.votes) == (None, ())
        assert do(after, devices_active=True).intents.goals.empty


def test_a_camera_that_fails_for_a_moment_gives_no_second_decision_in_the_pass() -> None:
    """It swung the blade from left to right across what it carried."""
    blind = fault(Reaction.HOLD, frozenset({"rotation"}))
    state, now_s = AUTO, NOW_S

    def see(zone: Zone, faults: tuple[ActiveFault, ...] = ()) -> None:
        nonlocal state, now_s
        for _ in range(50):
            now_s += 0.066
            shares = (0.9, 0.1, 0.0) if zone is Zone.LEFT else (0.0, 0.1, 0.9)
            seen = None if faults else SoilObservation(now_s, zone, 0.9, "", *shares)
            travel = Travel(0.5, 0.5 * (now_s - NOW_S), now_s)
            state = do(state, devices_active=True, observation=seen, now_s=now_s, faults=faults, travel=travel).state

    see(Zone.LEFT)
    assert state.goals == Goals(rotation_deg=30.0)
    see(Zone.LEFT, (blind,))
    assert state.goals.empty
    see(Zone.RIGHT)
    assert state.goals.empty
    assert state.holding == ("held in mid-pass: left not seen again",)
    assert state.decision.reason(now_s).endswith("held, until that is seen again")
    since_m = state.decision.since_m
    see(Zone.LEFT)
    assert state.goals == Goals(rotation_deg=30.0)
    assert state.decision.since_m > since_m > 4.0


def test_a_hold_before_the_pass_leaves_all_open() -> None:
    standing = Travel(0.0, 0.0, NOW_S)
    turning = replace(AUTO, decision=Decision(Zone.LEFT, 30.0, NOW_S - 5.0, told=standing, silent=False))
    after = do(turning, devices_active=True, held={"rotation": "it is far"}, travel=standing).state
    # But when it was taken: a camera that comes and goes does not let the blade swing more often.
    assert after.decision == Decision(decided_s=turning.decision.decided_s)


def test_a_preset_that_stands_short_of_a_stage_ends() -> None:
    first = do(MANUAL, cmd.Preset(name="transport", client="a"), devices_active=True, arrived=False).state
    ended = do(first, cmd.Renew(client="a"), devices_active=True, settled=True, arrived=False)
    assert ended.intents.goals.empty
    assert "short of its goal" in ended.state.reason


def test_a_late_renewal_renews_nothing() -> None:
    moving = do(MANUAL, J, devices_active=True).state
    late = do(moving, cmd.Renew(client="a"), devices_active=True, now_s=NOW_S + SETTINGS.lease_s + 0.001)
    assert not late.replies[0].accepted
    assert late.intents.goals.empty


def test_a_lease_counts_from_when_its_client_was_heard() -> None:
    """Not from when its turn came: one that sent renewals ahead, and went, was moved for as many seconds as those
    waited."""
    asked = do(MANUAL, J, devices_active=True, waited_s=(0.2,)).state
    assert asked.lease is not None
    assert asked.lease.expires_s == pytest.approx(NOW_S - 0.2 + SETTINGS.lease_s)
    again = do(asked, cmd.Renew(client="a"), devices_active=True, now_s=NOW_S + 0.05, waited_s=(0.01,)).state
    assert again.lease is not None
    assert again.lease.expires_s == pytest.approx(NOW_S + 0.04 + SETTINGS.lease_s)
    older = do(again, cmd.Renew(client="a"), devices_active=True, now_s=NOW_S + 0.06, waited_s=(0.25,)).state
    assert older.lease == again.lease
    # A stop is obeyed first; what each of the others waited stays its own.
    both = do(MANUAL, J, cmd.Manual(client="a"), cmd.Stop(), devices_active=True, waited_s=(0.2, 9.0, 0.0))
    assert both.state.mode is Mode.STOPPED


def test_a_move_that_waited_for_longer_than_its_lease_is_not_begun() -> None:
    late = do(MANUAL, J, devices_active=True, waited_s=(SETTINGS.lease_s + 0.01,))
    assert not late.replies[0].accepted
    assert late.intents.goals.empty
    assert late.state.lease is None


def test_holding_says_why_and_since_when() -> None:
    result = do(AUTO, devices_active=True, faults=(fault(Reaction.HOLD, name="camera.stale"),))
    assert result.state.holding == ("camera.stale since 0.6 s: it is broken",)


def test_auto_follows_the_rule_and_unknown_holds_the_angle() -> None:
    state = AUTO
    for index in range(8):
        now_s = NOW_S + index * 0.066
        seen = SoilObservation(now_s, Zone.LEFT, 0.9, "", 0.8, 0.1, 0.1)
        state = do(state, devices_active=True, observation=seen, now_s=now_s).state
    assert state.goals == Goals(rotation_deg=30.0)
    unsure = SoilObservation(NOW_S + 1.0, Zone.UNKNOWN, 0.0, "")
    state = do(state, devices_active=True, observation=unsure, now_s=NOW_S + 1.0).state
    assert state.goals == Goals(rotation_deg=30.0)


def test_leaving_auto_forgets_the_decision() -> None:
    state = replace(AUTO, decision=Decision(Zone.LEFT, 30.0, NOW_S), goals=Goals(rotation_deg=30.0))
    manual = do(state, cmd.Manual(), devices_active=True)
    assert manual.intents.goals.empty
    assert manual.state.decision == Decision()


COMMANDS: list[cmd.Command] = [
    cmd.Arm(client="a"), cmd.Disarm(), cmd.Stop(), cmd.Reset(stop_n=0), cmd.Auto(client="a"), cmd.Manual(client="a"), J,
    cmd.Preset(name="p", client="b"), cmd.Renew(client="a"), cmd.Renew(client="b"), cmd.Release(client="a"),
]  # fmt: skip
FAULTS = [fault(reaction, axes) for reaction in Reaction for axes in (ALL_AXES, frozenset({"rotation"}))]


class AnyUse(RuleBasedStateMachine):
    """Whatever comes in whatever order: the invariants of :func:`check_safe` hold, and stop latches."""

    def __init__(self) -> None:
        super().__init__()
        self.state = State()
        self.now_s = NOW_S
        self.result: Step | None = None

    @rule(
        commands=st.lists(st.sampled_from(COMMANDS), max_size=3),
        active=st.booleans(),
        settled=st.booleans(),
        faults=st.lists(st.sampled_from(FAULTS), max_size=2),
        unmet=st.booleans(),
        error=st.booleans(),
        zone=st.sampled_from([None, *Zone]),
        dt_s=st.sampled_from([0.02, 0.1, 0.31, 2.5, 6.0]),
    )
    def tick(
        self,
        commands: list[cmd.Command],
        active: bool,
        settled: bool,
        faults: list[ActiveFault],
        unmet: bool,
        error: bool,
        zone: Zone | None,
        dt_s: float,
    ) -> None:
        self.now_s += dt_s
        before = self.state
        seen = SoilObservation(self.now_s, zone, 1.0, "", 1.0, 1.0, 1.0) if zone else None
        self.result = step(
            before,
            inputs(
                *commands,
                now_s=self.now_s,
                devices_active=active,
                settled=settled,
                faults=tuple(faults),
                unmet=(Unmet("x", "y", "z"),) if unmet else (),
                arm_error="no" if error else "",
                observation=seen,
            ),
            SETTINGS,
            RULE,
        )
        self.state = self.result.state
        reset = any(isinstance(c, cmd.Reset) for c in commands)
        if before.mode is Mode.STOPPED and self.state.mode is not Mode.STOPPED:
            assert reset
        if before.mode is Mode.STOPPED:
            assert self.state.mode not in ARMED
        if any(isinstance(c, cmd.Stop) for c in commands):
            assert self.state.mode is Mode.STOPPED
        if any(f.row.reaction is Reaction.STOP for f in faults):
            assert self.state.mode is Mode.STOPPED
        if any(f.row.reaction >= Reaction.DISARM for f in faults):
            assert self.state.mode not in ARMED
        if self.state.mode in ARMED and before.mode not in ARMED:
            assert self.result.intents.goals.empty

    @invariant()
    def safe(self) -> None:
        if self.result is not None:
            check_safe(self.result)


AnyUse.TestCase.settings = settings(max_examples=150, stateful_step_count=30, deadline=None)
TestAnyUse = AnyUse.TestCase
