"""LAMMPS and the multibody machine, coupled at every step of the engine, in a process of their own.

    python -P -m graderd.studies.blade_rotation.coupled FOLDER DECK UNTIL_STEP

Scheme: conventional serial staggered, explicit, without sub-cycling. At each step of the engine, when it has the forces
for the grains and the blade where they are,

1. force and moment on the blade are summed up over the grains that touch it;
2. the machine goes on for one step under them, so that it takes the impulse that the soil takes;
3. where that leaves the blade is where the engine has it at its next step, at the velocity that leads there.

So both have the blade in the same place at all times. What is left of the interface is that the machine takes a step's
first force where the soil feels the mean of first and last; that work is summed up and told. The engine turns the blade
about the vertical and moves it in x, y and z; roll and pitch stay in the machine (they are told: about a degree).

The engine calls the machine (``fix external``) in the midst of one long ``run``. Taking turns with one ``run`` a step
would be slower, and a ``run`` that sets itself up again takes the moving blade for one at rest in its first step.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO

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
    import pyarrow as pa
    from lammps import lammps

WINDOW_STEPS: Final = deck.SAMPLE_STEPS * deck.MEAN_SAMPLES
COLUMNS: Final = ("time", *READINGS, "work_j", "gap_j")
"""Of the machine's file. ``work_j``: the blade's work on the soil so far; ``gap_j``: what the interface made of it."""
TOLD_STEPS: Final = 10
"""Steps between two rows of it."""
STATES: Final = "machine.states.jsonl"
_AXES: Final = ("dx", "dy", "dz", "theta")


def run_leg(
    folder: Path,
    deck_name: str,
    until_step: int,
    holder: Callable[[Pose], Holder] | None = None,
    every_n: int = 1,
) -> None:
    """One leg of a coupled run in ``folder``: goes on from what the deck reads and leaves what an imposed leg leaves,
    and the machine's readings. ``holder``: makes another than the machine for the case's blade; ``every_n``: the
    machine takes its turn at so many steps of the engine, a divisor of 10, under their mean force."""
    from lammps import lammps

    with contextlib.chdir(folder):  # the deck names its files
        case = Case.model_validate_json(Path("case.json").read_text(encoding="utf-8"))
        name = deck_name.removesuffix(".in")
        engine = lammps(cmdargs=["-log", f"{name}.log", "-screen", "none", "-nocite"])
        engine.file(deck_name)
        told = Path(f"machine.{name.removeprefix('push.')}.txt")
        with told.open("w", encoding="ascii") as rows, Path(STATES).open("a", encoding="utf-8") as states:
            rows.write(f"# {' '.join(COLUMNS)}\n")
            coupling = _Coupling(engine, case, holder, every_n, rows, states)
            engine.command("fix machine all external pf/callback 1 1")
            engine.set_fix_external_callback("machine", coupling.called)
            engine.commands_string(deck.last_lines(until_step))
        engine.close()
        if coupling.failure:
            raise coupling.failure


class _Coupling:
    """Both programs and what passes between them."""

    def __init__(
        self,
        engine: lammps,
        case: Case,
        holder: Callable[[Pose], Holder] | None,
        every_n: int,
        rows: TextIO,
        states: TextIO,
    ) -> None:
        self.failure: Exception | None = None
        self._engine, self._rows, self._states = engine, rows, states
        self._dt = deck.step_s(case)
        self._walls = ("edge",) if case.blade.radius_m is None else ("edge", "face")
        number = {n: float(engine.extract_variable(n)) for n in ("t0", *(f"{axis}{n}" for axis in _AXES for n in "01"))}
        self._goal = deck.Motion(
            number["t0"],
            (number["dx0"], number["dy0"], number["dz0"]),
            number["theta0"],
            (number["dx1"], number["dy1"], number["dz1"]),
            number["theta1"],
        )
        self._step = int(engine.extract_global("ntimestep")) - 1
        start = self._goal.at((self._step + 1) * self._dt)
        pose = Pose(start.place_m, start.yaw_rad, start.velocity_m_per_s, start.yaw_rad_per_s)
        self._holder = holder(pose) if holder else Multibody(Machine.of(case.blade), pose)
        self._every_n, self._mean, self._acted = every_n, np.zeros(6), np.zeros(4)
        self._since_s, self._place, self._rate = start.t0_s, _place(pose), np.zeros(4)
        self._work_j = self._taken_j = 0.0
        self._restore()

    def called(self, _: object, step: int, *__: object) -> None:
        """By the engine, which has just worked out the forces of a step. Nothing is raised through it."""
        if self.failure or step <= self._step:
            return
        try:
            self._advance(step)
        except Exception as error:
            self.failure = error

    def _advance(self, step: int) -> None:
        self._step, now_s = step, step * self._dt
        wrench = self._wrench(self._place + self._rate * (now_s - self._since_s))
        acts = wrench[[0, 1, 2, 5]]
        self._work_j -= float((self._acted + acts) @ self._rate) * self._dt / 2.0
        self._acted = acts
        self._mean += wrench / self._every_n
        if step % self._every_n:
            return
        if step % WINDOW_STEPS == 0:
            self._keep()
        if step % TOLD_STEPS == 0:
            told = (now_s, *self._holder.readings().tolist(), self._work_j, self._taken_j + self._work_j)
            self._rows.write(" ".join(f"{value:.8g}" for value in told) + "\n")
        lasts_s = self._every_n * self._dt
        self._since_s, self._place = now_s, _place(self._holder.pose)
        (fx, fy, fz, mx, my, mz), self._mean = self._mean.tolist(), np.zeros(6)
        goal_rad = self._goal.at(now_s + lasts_s).yaw_rad
        moved = _place(self._holder.advance(Wrench((fx, fy, fz), (mx, my, mz)), goal_rad, lasts_s)) - self._place
        self._rate = moved / lasts_s
        self._taken_j += float(np.array((fx, fy, fz, mz)) @ moved)
        self._engine.set_internal_variable("t0", now_s)
        for axis, place, rate in zip(_AXES, self._place.tolist(), self._rate.tolist(), strict=True):
            self._engine.set_internal_variable(f"{axis}0", place)
            self._engine.set_internal_variable(f"{axis}1", rate)

    def _wrench(self, place: F64) -> F64:
        """Force and moment on the blade, whose axis has its foot there."""
        from lammps import LMP_STYLE_ATOM, LMP_TYPE_ARRAY

        total = np.zeros(6)
        for wall in self._walls:
            contacts = self._engine.numpy.extract_fix(wall, LMP_STYLE_ATOM, LMP_TYPE_ARRAY)
            if contacts is None or not len(contacts):
                continue
            touching = contacts[contacts[:, 0] > 0.0]
            on_blade = -touching[:, 1:4]
            total[:3] += on_blade.sum(axis=0)
            total[3:] += np.cross(touching[:, 4:7] - place[:3], on_blade).sum(axis=0)
        return total

    def _keep(self) -> None:
        """The machine as it is when a restart file of this step has the soil."""
        energy = [self._work_j, self._taken_j]
        line = {"step": self._step, "holder": self._holder.state(), "energy_j": energy}
        self._states.write(json.dumps(line) + "\n")
        self._states.flush()
        self._rows.flush()

    def _restore(self) -> None:
        for line in Path(STATES).read_text(encoding="utf-8").split("\n")[:-1]:
            state = json.loads(line)
            if state["step"] == self._step + 1:
                self._holder.restore(state["holder"])
                self._work_j, self._taken_j = state["energy_j"]
                self._place = _place(self._holder.pose)


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


def motion(rows: F64, time_s: float) -> deck.Motion:
    """Where the blade was at a time, by :func:`readings`."""
    names = ("x", "y", "z", "yaw")
    x, y, z, yaw = (float(np.interp(time_s, rows[:, 0], rows[:, COLUMNS.index(name)])) for name in names)
    return deck.Motion(time_s, (x, y, z), yaw, (0.0, 0.0, 0.0))


def table(rows: F64) -> pa.Table:
    """:func:`readings` as it is kept beside a result."""
    import pyarrow as pa

    return pa.table({name: rows[:, number].astype(np.float32) for number, name in enumerate(COLUMNS)})


def measures(rows: F64, contact_s: float) -> dict[str, float]:
    """What the machine felt from ``contact_s`` on, by :func:`readings`; its limits stand in :mod:`.multibody`.

    ``servo_*``: torque on the rotation axis by the soil (``load``) and by the servo, which is at its limit for
    ``servo_at_limit_share`` of the time; ``yaw_off_max_deg``, ``yaw_end_deg``: how far the blade was turned off its
    angle, and where it ended. ``lift_max_n``, ``tilt_max_n``, ``side_draft_max_n``: greatest forces, by amount.
    ``interface_share``: the energy that the coupling made or lost, as a share of the blade's work.
    """
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
    }


def main(arguments: list[str]) -> None:
    """See the module's text."""
    folder, deck_name, until_step = arguments
    run_leg(Path(folder), deck_name, int(until_step))


if __name__ == "__main__":
    main(sys.argv[1:])
