"""LAMMPS and the multibody machine, coupled step by step, in a process of their own.

    python -P -m graderd.studies.blade_rotation.coupled FOLDER DECK UNTIL_STEP

Scheme: conventional serial staggered, explicit. In each coupling step

1. the engine runs with the blade in steady motion and sums up force and moment on it at every one of its steps;
2. the machine runs over the same time under their mean, so that the impulse it takes is the impulse the soil gave;
3. the blade's next steady motion is that which leads from where the engine has it to where the machine, going on as
   it did in this step, will have it at the end of the next. So the place never jumps, and the two cannot drift apart.

What the interface gains or loses is the force times the difference of the two motions; it is summed up and told.
The engine turns the blade about the vertical and moves it in x, y and z; roll and pitch stay in the machine (they are
told: a fraction of a degree).

The engine is driven by its library, in one ``run ... pre no`` a coupling step: a ``run`` that sets itself up again
would take the moving blade for one at rest in its first step.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from graderd.studies.blade_rotation import lammps as deck
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.multibody import (
    F64,
    READINGS,
    SERVO_LIMIT_NM,
    Holder,
    Machine,
    Multibody,
    Pose,
    Wrench,
)

if TYPE_CHECKING:
    from lammps import lammps

COUPLING_S: Final = 1e-3
"""Coupling step, nearly: a whole number of the engine's steps that the force file's window is a multiple of."""
WINDOW_STEPS: Final = deck.SAMPLE_STEPS * deck.MEAN_SAMPLES
COLUMNS: Final = ("time", *READINGS, "work_j", "gap_j", "apart_m", "apart_rad")
"""Of the machine's file. ``work_j``: the blade's work on the soil so far; ``gap_j``: what the interface made of it;
``apart``: how far the engine's blade is from the machine's."""
_WRENCH: Final = ("fx", "fy", "fz", "mx", "my", "mz")
_AXES: Final = ("dx", "dy", "dz", "theta")
STATES = "machine.states.jsonl"


def coupling_steps(step_s: float, coupling_s: float = COUPLING_S) -> int:
    """The engine's steps in one of the coupling."""
    divisors = [n for n in range(1, WINDOW_STEPS + 1) if WINDOW_STEPS % n == 0]
    return min(divisors, key=lambda n: abs(math.log(n * step_s / coupling_s)))


def run_leg(
    folder: Path,
    deck_name: str,
    until_step: int,
    holder: Callable[[Pose], Holder] | None = None,
    coupling_s: float = COUPLING_S,
) -> None:
    """One leg of a coupled run in ``folder``: goes on from what the deck reads and leaves what an imposed leg leaves,
    and the machine's readings. ``holder``: makes another than the machine for the case's blade."""
    from lammps import lammps

    with contextlib.chdir(folder):  # the deck names its files
        case = Case.model_validate_json((folder / "case.json").read_text(encoding="utf-8"))
        name = deck_name.removesuffix(".in")
        engine = lammps(cmdargs=["-log", f"{name}.log", "-screen", "none", "-nocite"])
        engine.file(deck_name)
        dt = deck.step_s(case)
        steps = coupling_steps(dt, coupling_s)
        engine.command(f"fix coupling all ave/time 1 {steps} {steps} {' '.join(f'v_{each}' for each in _WRENCH)}")
        told = folder / f"machine.{name.removeprefix('push.')}.txt"
        with told.open("w", encoding="ascii") as file, (folder / STATES).open("a", encoding="utf-8") as states:
            file.write(f"# {' '.join(COLUMNS)}\n")
            coupling = _Coupling(engine, dt, steps, holder, case)
            coupling.restore(folder / STATES)
            engine.command("run 0 post no")
            while coupling.step < until_step:
                file.write(" ".join(f"{value:.8g}" for value in coupling.advance()) + "\n")
                if coupling.step % WINDOW_STEPS == 0:
                    states.write(coupling.state() + "\n")
                    states.flush()
                    file.flush()
        engine.commands_string("write_restart leg.tmp\nshell mv leg.tmp leg.restart")
        engine.close()


@dataclass(slots=True)
class _Side:
    """The blade as the engine has it: where it is and how it goes (dx, dy, dz in m, theta in rad; a second)."""

    here: F64
    rate: F64


class _Coupling:
    """Both programs and what passes between them."""

    def __init__(
        self, engine: lammps, step_s: float, steps: int, holder: Callable[[Pose], Holder] | None, case: Case
    ) -> None:
        self._engine, self._dt, self._steps = engine, step_s, steps
        self.step = int(engine.extract_global("ntimestep"))
        number = {
            name: float(engine.extract_variable(name)) for name in ("t0", *(f"{a}{n}" for a in _AXES for n in "01"))
        }
        start = np.array([number[f"{axis}0"] for axis in _AXES])
        rate = np.array([number[f"{axis}1"] for axis in _AXES])
        self._told_from_s, self._told_rad, self._told_rad_per_s = number["t0"], number["theta0"], number["theta1"]
        self._blade = _Side(start + rate * (self._now_s - number["t0"]), rate)
        self._pose = _pose(self._blade)
        self._holder = holder(self._pose) if holder else Multibody(Machine.of(case.blade), self._pose)
        self._work_j = self._gap_j = 0.0

    @property
    def _now_s(self) -> float:
        return self.step * self._dt

    def advance(self) -> list[float]:
        """One coupling step; the row of :data:`COLUMNS`."""
        from lammps import LMP_STYLE_GLOBAL, LMP_TYPE_VECTOR

        self._steer()
        self._engine.command(f"run {self._steps} pre no post no")
        self.step += self._steps
        lasted_s = self._steps * self._dt
        acts = np.array(
            [self._engine.extract_fix("coupling", LMP_STYLE_GLOBAL, LMP_TYPE_VECTOR, n) for n in range(len(_WRENCH))]
        )
        wrench = Wrench((acts[0], acts[1], acts[2]), (acts[3], acts[4], acts[5]))
        before, goal = self._pose, self._told_rad + self._told_rad_per_s * (self._now_s - self._told_from_s)
        self._pose = self._holder.advance(wrench, goal, lasted_s)
        there, moved = _place(self._pose), self._blade.rate * lasted_s
        self._blade.here = self._blade.here + moved
        on_blade = acts[[0, 1, 2, 5]]
        self._work_j -= float(on_blade @ moved)
        self._gap_j += float(on_blade @ (there - _place(before) - moved))
        # What it did in this step, not its velocity at the end, which its quickest vibrations rule.
        self._blade.rate = (there + (there - _place(before)) - self._blade.here) / lasted_s
        apart = self._blade.here - there
        ends = (self._work_j, self._gap_j, float(np.linalg.norm(apart[:3])), abs(float(apart[3])))
        return [self._now_s, *self._holder.readings().tolist(), *ends]

    def _steer(self) -> None:
        self._engine.set_internal_variable("t0", self._now_s)
        for axis, place, rate in zip(_AXES, self._blade.here.tolist(), self._blade.rate.tolist(), strict=True):
            self._engine.set_internal_variable(f"{axis}0", place)
            self._engine.set_internal_variable(f"{axis}1", rate)

    def state(self) -> str:
        """All that goes on from one step to the next, as a line."""
        blade = [self._blade.here.tolist(), self._blade.rate.tolist()]
        energy = [self._work_j, self._gap_j]
        return json.dumps({"step": self.step, "blade": blade, "energy": energy, "holder": self._holder.state()})

    def restore(self, path: Path) -> None:
        """Go on from the line that was written at this step, if one was."""
        if not path.exists():
            return
        for line in path.read_text(encoding="utf-8").split("\n")[:-1]:
            state = json.loads(line)
            if state["step"] == self.step:
                self._blade = _Side(np.array(state["blade"][0]), np.array(state["blade"][1]))
                self._work_j, self._gap_j = state["energy"]
                self._holder.restore(state["holder"])
                self._pose = self._holder.pose
        self._steer()


def _pose(side: _Side) -> Pose:
    (x, y, z, yaw), (vx, vy, vz, turning) = side.here.tolist(), side.rate.tolist()
    return Pose((x, y, z), yaw, (vx, vy, vz), turning)


def _place(pose: Pose) -> F64:
    return np.array((*pose.place_m, pose.yaw_rad))


def readings(folder: Path) -> F64:
    """Rows of :data:`COLUMNS` in the order of time, of all legs and attempts."""
    found: dict[float, list[float]] = {}
    for path in sorted(folder.glob("machine.*.txt"), key=lambda path: [int(n) for n in path.name.split(".")[1:-1]]):
        for line in path.read_text(encoding="ascii").split("\n")[:-1]:
            if not line.startswith("#") and len(words := line.split()) == len(COLUMNS):
                found[round(float(words[0]), 7)] = [float(word) for word in words]
    return np.array([found[time] for time in sorted(found)]).reshape(-1, len(COLUMNS))


def measures(folder: Path, contact_s: float) -> dict[str, float]:
    """What the machine felt from ``contact_s`` on, whose limits :mod:`.multibody` has.

    ``servo_*``: torque on the rotation axis by the soil (``load``) and by the servo, which is at its limit for
    ``servo_at_limit_share`` of the time; ``yaw_off_max_deg``, ``yaw_end_deg``: how far the blade was turned off its
    angle, and where it ended. ``lift_max_n``, ``tilt_max_n``, ``side_draft_max_n``: greatest forces, by amount.
    ``interface_share``: the energy that the coupling made or lost, as a share of the blade's work.
    """
    rows = readings(folder)
    column = {name: rows[rows[:, 0] >= contact_s, number] for number, name in enumerate(COLUMNS)}
    off_deg = np.degrees(np.abs(column["yaw"] - column["yaw_wanted"]))
    lifts_n = np.abs(np.column_stack((column["lift_left_n"], column["lift_right_n"])))
    return {
        "servo_load_mean_nm": float(column["load_nm"].mean()),
        "servo_load_max_nm": float(np.abs(column["load_nm"]).max()),
        "servo_at_limit_share": float((np.abs(column["servo_nm"]) >= 0.999 * SERVO_LIMIT_NM).mean()),
        "yaw_off_max_deg": float(off_deg.max()),
        "yaw_end_deg": float(np.degrees(column["yaw"][-1])),
        "lift_max_n": float(lifts_n.max()),
        "tilt_max_n": float(np.abs(column["tilt_n"]).max()),
        "machine_draft_n": float(column["draft_n"].mean()),
        "machine_side_draft_n": float(column["side_draft_n"].mean()),
        "machine_side_draft_max_n": float(np.abs(column["side_draft_n"]).max()),
        "roll_max_deg": float(np.degrees(np.abs(column["roll"]).max())),
        "pitch_max_deg": float(np.degrees(np.abs(column["pitch"]).max())),
        "interface_share": float(abs(column["gap_j"][-1]) / max(abs(column["work_j"][-1]), 1e-9)),
        "apart_max_m": float(column["apart_m"].max()),
    }


def main(arguments: list[str]) -> None:
    """See the module's text."""
    folder, deck_name, until_step = arguments
    run_leg(Path(folder), deck_name, int(until_step))


if __name__ == "__main__":
    main(sys.argv[1:])
