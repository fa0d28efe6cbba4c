"""The lifts through the whole tick, in virtual time: never far apart, never stopped without cause, and in good time.

``GRADERD_LIFT_MOVES`` is how many moves of each kind are made; ``benchmarks/lift_pair.py`` makes 1,000.
"""

from __future__ import annotations

import asyncio
import os

import pytest

from graderd.core import commands as cmd
from harness.electrak_sim import SimulatedLoop, run_simulated
from harness.lift_sim import FEEDBACK_PERIOD_S, Move, lift_machine, lose_a_side, run_trial, trials

MOVES_N = int(os.environ.get("GRADERD_LIFT_MOVES", "36"))
PER_MACHINE_N = 3
"""Few, so that there are many machines: each falls otherwise to control messages and feedback."""


def moves(hitch: str) -> list[Move]:
    """So many moves with one kind of mishap, machine after machine; each machine's ticks, messages and feedback fall to
    each other in a way of their own, evenly over a period."""
    return [
        move
        for trial in trials(MOVES_N, hitch=hitch, per_machine_n=PER_MACHINE_N)
        for move in run_simulated(lambda loop, trial=trial: run_trial(loop, trial))  # type: ignore[misc]
    ]


@pytest.mark.slow
def test_healthy_sides_stay_within_3_mm_and_within_115_percent_of_the_slow_sides_time() -> None:
    made = moves("")
    assert max(move.apart_mm for move in made) <= 3.0
    assert [move.stopped for move in made if move.stopped] == []
    assert [move.faults for move in made if move.faults] == []
    assert max(move.took_s / move.own_s for move in made) <= 1.15


@pytest.mark.slow
@pytest.mark.parametrize("hitch", ["sticks", "deaf"])
def test_what_passes_by_itself_leaves_the_sides_within_6_mm_and_stops_nothing(hitch: str) -> None:
    made = moves(hitch)
    assert max(move.apart_mm for move in made) <= 6.0
    assert [move.stopped for move in made if move.stopped] == []


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["power_cut", "silence", "stuck"])
def test_a_lost_side_stops_the_other_within_10_mm(loss: str) -> None:
    for seed in range(5):
        lost = run_simulated(lambda loop, seed=seed: lose_a_side(loop, loss, seed))  # type: ignore[misc]
        assert lost.apart_mm <= 10.0
        assert lost.held_s <= 1.5 * FEEDBACK_PERIOD_S
        assert lost.reason


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_side_that_starts_the_wrong_way_is_named_after_its_first_5_mm(seed: int) -> None:
    """Its motor's leads crossed: it starts when it is told to, as fast as it is told to, and the other way."""

    async def main(loop: SimulatedLoop) -> None:
        async with lift_machine(loop, seed, offset_s=seed * 0.0171) as lifts:
            await lifts.jog(60.0)
            assert (await lifts.settle()) == ""
            wrong = lifts.units["lift_left" if seed % 2 else "lift_right"]
            from_mm, wrong.behaviour.speed_factor = wrong.position_mm, -1.0
            await lifts.jog(200.0)
            settling = asyncio.create_task(lifts.settle())
            while lifts.tick.state.lease is not None:
                await asyncio.sleep(0.002)
            assert abs(wrong.position_mm - from_mm) <= 5.0
            assert "uncommanded_motion" in await settling

    run_simulated(main)


@pytest.mark.slow
def test_a_side_that_is_driven_back_at_full_speed_is_named_and_stops_the_other() -> None:
    lost = run_simulated(lambda loop: lose_a_side(loop, "manual_override", 3))
    assert "uncommanded_motion" in lost.reason
    assert lost.named_mm <= 9.0, "two readings at 60 mm/s, the first of which may still show the way it came"


def test_both_sides_start_in_the_same_control_message() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with lift_machine(loop, 4) as lifts:
            lifts.units["lift_right"].position_mm += 0.9  # as where each rested after the move before
            for target_mm in (150.0, 110.0, 180.0):
                await asyncio.sleep(0.7)
                began_s: dict[str, float] = {}
                await lifts.jog(target_mm)
                while len(began_s) < 2:
                    await asyncio.sleep(0.001)
                    for name, unit in lifts.units.items():
                        if unit.motion_enabled:
                            began_s.setdefault(name, loop.now_s())
                assert abs(began_s["lift_left"] - began_s["lift_right"]) < 0.005
                assert not (await lifts.follow(target_mm))[2]

    run_simulated(main)


@pytest.mark.parametrize("slow", [None, "lift_left", "lift_right"])
@pytest.mark.slow
def test_level_and_slope_moves_in_a_row_all_arrive(slow: str | None) -> None:
    """Both, only one, against each other: every one ends at its goal, none is stopped."""

    async def main(loop: SimulatedLoop) -> None:
        async with lift_machine(loop) as lifts:
            if slow:
                lifts.units[slow].behaviour.speed_factor = 0.7
            moves = (
                ("height", 35.0),
                ("slope", 3.0),
                ("slope", -3.0),
                ("lift", 140.0),
                ("slope", 6.0),
                ("height", 0.0),
            )
            for axis, value in moves:
                await lifts.jog(value, axis=axis)
                assert (await lifts.settle()) == ""

    run_simulated(main)


def test_a_pair_that_was_stopped_ends_the_jog_with_its_reason() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with lift_machine(loop) as lifts:
            lifts.units["lift_right"].behaviour.speed_factor = 0.0
            await lifts.jog(150.0)
            reason = await lifts.settle()
            assert "lift_right" in reason
            assert lifts.tick.state.goals.empty
            lifts.units["lift_right"].behaviour.speed_factor = 1.0
            await asyncio.sleep(1.0)
            assert lifts.still(), "it does not go on by itself"
            reply = await lifts.loop.command(cmd.Renew(client="test"))
            assert not reply.accepted

    run_simulated(main)
