"""The lifts through the whole tick, in virtual time: ``python -m benchmarks.lift_pair [--moves N] [--losses N]``.

One machine's moves after another's, on as many processes as the computer has processors.

Moves of 5 to 250 mm, with equal sides and with one side 10 to 40 % slower, without mishap, with a side that sticks for
up to 0.4 s, and with two lost feedbacks in a row; then sides lost at full speed. See ``harness/lift_sim.py``.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from concurrent.futures import ProcessPoolExecutor

from harness.electrak_sim import run_simulated
from harness.lift_sim import Loss, Move, Trial, lose_a_side, run_trial, trials

HITCHES = {"": 3.0, "sticks": 6.0, "deaf": 6.0}
"""What befalls a side, and how far apart the sides may come."""
LOSSES = ("power_cut", "silence", "stuck", "manual_override")
LOST_MM = 10.0
IN_TIME = 1.15


def describe(moves: list[Move]) -> str:
    """One line of measured numbers."""
    ratios = sorted(move.took_s / move.own_s for move in moves)
    return (
        f"apart at most {max(move.apart_mm for move in moves):.2f} mm, stopped {sum(bool(m.stopped) for m in moves)}, "
        f"faults told in {sum(bool(move.faults) for move in moves)}; times the slow side's own: "
        f"median {statistics.median(ratios):.2f}, 99 in 100 {ratios[int(0.99 * (len(ratios) - 1))]:.2f}, most "
        f"{ratios[-1]:.2f}, over {IN_TIME:g}: {sum(r > IN_TIME for r in ratios)}"
    )


def main() -> int:
    """Print the table; 1 where a bound was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", type=int, default=1000, help="of each kind")
    parser.add_argument("--losses", type=int, default=100, help="of each kind")
    parser.add_argument("--only", choices=("healthy", "sticks", "deaf", "lost"), help="this part alone")
    parser.add_argument("--seed", type=int, default=0, help="other machines, loads and moves")
    arguments = parser.parse_args()
    broken = False
    with ProcessPoolExecutor() as processes:
        for hitch, most_mm in HITCHES.items():
            if arguments.only not in (None, hitch or "healthy"):
                continue
            asked = trials(arguments.moves, hitch=hitch, seed=arguments.seed)
            moves = [move for made in processes.map(make_moves, asked) for move in made]
            sys.stdout.write(f"{len(moves)} moves, {hitch or 'no mishap'}: {describe(moves)}\n")
            sys.stdout.flush()
            broken |= any(move.apart_mm > most_mm or move.stopped for move in moves)
            broken |= not hitch and any(move.took_s > IN_TIME * move.own_s for move in moves)
        if arguments.only in (None, "lost"):
            broken |= lose_sides(processes, arguments.losses)
    return int(broken)


def make_moves(trial: Trial) -> list[Move]:
    """One machine's, in a process of the pool."""
    return run_simulated(lambda loop: run_trial(loop, trial))


def lose_one(loss: str, seed: int) -> Loss:
    """One loss, likewise."""
    return run_simulated(lambda loop: lose_a_side(loop, loss, seed))


def lose_sides(processes: ProcessPoolExecutor, losses_n: int) -> bool:
    """Print what becomes of lost sides; whether a bound was broken."""
    broken = False
    for loss in LOSSES:
        lost = list(processes.map(lose_one, [loss] * losses_n, range(losses_n)))
        sys.stdout.write(
            f"{len(lost)} x {loss}: the other side told to hold after {max(x.held_s for x in lost):.3f} s at most, "
            f"apart {max(x.apart_mm for x in lost):.2f} mm, named after {max(x.named_mm for x in lost):.1f} mm\n"
        )
        sys.stdout.flush()
        broken |= loss != "manual_override" and any(x.apart_mm > LOST_MM for x in lost)
    return broken


if __name__ == "__main__":
    sys.exit(main())
