"""The lifts through the whole tick, in virtual time: ``python -m benchmarks.lift_pair [--moves N] [--losses N]``.

Moves of 5 to 250 mm, with equal sides and with one side 10 to 40 % slower, without mishap, with a side that sticks for
up to 0.4 s, and with two lost feedbacks in a row; then sides lost at full speed. See ``tests/lift_sim.py``.
"""

from __future__ import annotations

import argparse
import statistics
import sys

from tests.electrak_sim import run_simulated
from tests.lift_sim import Loss, Move, lose_a_side, run_trial, trials

HITCHES = {"": 3.0, "sticks": 6.0, "deaf": 6.0}
"""What befalls a side, and how far apart the sides may come."""
LOSSES = ("power_cut", "silence", "stuck", "manual_override")
LOST_MM = 10.0
IN_TIME = 1.15


def describe(moves: list[Move]) -> str:
    """One line of measured numbers."""
    ratios = sorted(move.took_s / move.own_s for move in moves)
    known = sorted(move.took_s / move.own_s for move in moves if move.known)
    return (
        f"apart at most {max(move.apart_mm for move in moves):.2f} mm, stopped {sum(bool(m.stopped) for m in moves)}, "
        f"faults told in {sum(bool(move.faults) for move in moves)}; times the slow side's own: "
        f"median {statistics.median(ratios):.2f}, 99 in 100 {ratios[int(0.99 * (len(ratios) - 1))]:.2f}, most "
        f"{ratios[-1]:.2f} ({max(known, default=0.0):.2f} once the speeds are known), "
        f"over {IN_TIME:g}: {sum(r > IN_TIME for r in ratios)}"
    )


def main() -> int:
    """Print the table; 1 where a bound was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", type=int, default=1000, help="of each kind")
    parser.add_argument("--losses", type=int, default=100, help="of each kind")
    arguments = parser.parse_args()
    broken = False
    for hitch, most_mm in HITCHES.items():
        moves: list[Move] = []
        for trial in trials(arguments.moves, hitch=hitch):
            moves += run_simulated(lambda loop, trial=trial: run_trial(loop, trial))  # type: ignore[misc]
        sys.stdout.write(f"{len(moves)} moves, {hitch or 'no mishap'}: {describe(moves)}\n")
        sys.stdout.flush()
        broken |= any(move.apart_mm > most_mm or move.stopped for move in moves)
        broken |= not hitch and any(move.known and move.took_s > IN_TIME * move.own_s for move in moves)
    for loss in LOSSES:
        lost: list[Loss] = [
            run_simulated(lambda loop, loss=loss, seed=seed: lose_a_side(loop, loss, seed))  # type: ignore[misc]
            for seed in range(arguments.losses)
        ]
        sys.stdout.write(
            f"{len(lost)} x {loss}: the other side told to hold after {max(x.held_s for x in lost):.3f} s at most, "
            f"apart {max(x.apart_mm for x in lost):.2f} mm, named after {max(x.named_mm for x in lost):.1f} mm\n"
        )
        broken |= loss != "manual_override" and any(x.apart_mm > LOST_MM for x in lost)
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
