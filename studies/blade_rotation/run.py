"""A case becomes a result: pour, settle, push in one leg or several, measure, keep.

What is done is never done again: neither a case whose result the store has, nor a settled pile that another case with
the same soil left there, nor the part of a run before its last restart file.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from graderd.studies.blade_rotation import engine, files, outcome, pile
from graderd.studies.blade_rotation import lammps as deck
from graderd.studies.blade_rotation.again import Leg, decided_again
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.lammps import Motion
from graderd.studies.blade_rotation.outcome import Frame
from graderd.studies.blade_rotation.pile import F64
from graderd.studies.blade_rotation.store import Result, Store, written

FRAME_M = 0.1
"""Travel between two frames, nearly: a whole number of the force file's windows."""
CLEAR_M = 0.05
"""The blade starts at least so far from the soil."""
FIRST_SHARE = 0.01
"""Contact is where this share of the grains has been met: one that has rolled away is no soil."""
COUPLED = "graderd.studies.blade_rotation.coupled"
"""Runs a leg with engine and multibody machine in one process."""
END_MARK = b"LammpS RestartT"
"""Begins and ends a restart file of LAMMPS (its read_restart looks for the same)."""
RESTART_PARTICLE_STEPS = 3e7
"""Between two restart files, or a frame if that is longer: half a minute or so on a core of its own."""

Told = Callable[[float], None]
"""Is told which share of the case is done."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How the pass is run: steps of a frame, the step of first contact, the last one."""

    frame_steps: int
    contact_step: int
    last_step: int
    start: Motion


def run_case(
    case: Case,
    store: Store,
    told: Told = lambda _: None,
    ranks_n: int = 1,
    restart_particle_steps: float = RESTART_PARTICLE_STEPS,
) -> Result:
    """The result of a case, computed if the store has none yet.

    Raises:
        StudyError: the engine failed.
    """
    case = case.canonical
    if found := store.get(case):
        return found
    began, folder = time.monotonic(), store.run_folder(case)
    with store.alone(folder):
        if found := store.get(case):
            return found
        work = _Work(case, store, folder, told, ranks_n, restart_particle_steps)
        result = work.result(began)
        for path in folder.iterdir():
            if path.suffix in {".restart", ".dump", ".out", ".tmp"} or path.name == "legs.json":
                path.unlink()
        return result


def plan(case: Case, settled: F64) -> Plan:
    """Where the blade starts, and when it meets the soil and ends, for a settled pile."""
    yaw = math.radians(case.angle_ccw_deg)
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, radius = settled[:, 1], settled[:, 2] - case.blade_y_m, settled[:, 4]
    # The axis's x where the face touches a grain, and where along the face it does.
    touching = x + (y * sin - radius) / cos
    along = y / cos - (radius * sin) / cos
    met = touching[np.abs(along) <= case.blade.length_m / 2.0]
    if not met.size:
        raise StudyError("case", "the blade does not meet the soil", "A smaller offset_share, or a wider pile")
    contact_x = float(np.quantile(met, FIRST_SHARE))
    dt = deck.step_s(case)
    window = deck.SAMPLE_STEPS * deck.MEAN_SAMPLES
    frame_steps = window * max(1, round(FRAME_M / case.speed_m_per_s / dt / window))
    frame_m = frame_steps * dt * case.speed_m_per_s
    run_up = contact_x - float(met.min()) + CLEAR_M
    frames_n = math.ceil((run_up + case.travel_m) / frame_m)
    start_x = contact_x + case.travel_m - frames_n * frame_m
    contact_step = round((contact_x - start_x) / case.speed_m_per_s / dt)
    start = Motion(0.0, (start_x, case.blade_y_m, case.gap_m), yaw, (case.speed_m_per_s, 0.0, 0.0))
    return Plan(frame_steps, contact_step, frames_n * frame_steps, start)


class _Work:
    """One case on its way."""

    def __init__(
        self, case: Case, store: Store, folder: Path, told: Told, ranks_n: int, restart_particle_steps: float
    ) -> None:
        self._case, self._store, self._folder, self._told, self._ranks_n = case, store, folder, told, ranks_n
        self._dt = deck.step_s(case)
        self._restart_steps = max(1, round(restart_particle_steps / case.grains_n))
        self._engine_s = 0.0
        self._particle_steps_n = 0
        # Of the whole, guessed before the pile has settled: the run-up is a tenth of the travel or so.
        self._steps_in_all = deck.settle_steps(case) + 1.1 * case.travel_m / case.speed_m_per_s / self._dt

    def result(self, began_s: float) -> Result:
        """Do what is left of it."""
        case = self._case
        grains = self._settled()
        plan_ = plan(case, grains)
        self._steps_in_all = deck.settle_steps(case) + plan_.last_step
        legs = self._push(plan_)
        frames = self._frames(plan_, legs)
        forces, parts = files.forces(self._folder), files.along(self._folder)
        along = np.array([parts[step] for step in sorted(parts)])
        dangerous = sum(engine.dangerous_builds(path.read_text()) for path in self._folder.glob("push.*.log"))
        density = deck.soil_of(case).density_kg_per_m3
        measures = outcome.measures(case, frames, forces, along, plan_.contact_step * self._dt)
        checks = outcome.checks(frames, forces, density, dangerous)
        tables = outcome.tables(case, frames, forces, along)
        if case.motion == "coupled":
            from graderd.studies.blade_rotation import coupled  # needs MuJoCo

            machine = coupled.readings(self._folder)
            measures |= coupled.measures(machine, plan_.contact_step * self._dt)
            tables["machine"] = coupled.table(machine)
        result = Result(
            key=case.key(),
            case=case,
            engine=engine.engine_version(),
            measures=measures,
            checks=checks,
            particle_steps_n=self._particle_steps_n,
            engine_s=self._engine_s,
            wall_s=time.monotonic() - began_s,
            notes={"angles_deg": [round(math.degrees(leg.motion.yaw_rad), 1) for leg in legs]},
        )
        self._store.keep(result, tables)
        return result

    def _settled(self) -> F64:
        """The grains of the settled pile, whose restart file is in its folder afterwards."""
        folder, case = self._store.pile_folder(self._case), self._case
        with self._store.alone(folder):
            if not (folder / "settled.restart").exists():
                start = _newest(folder, 0)
                if not start:
                    (folder / "pile.data").write_text(deck.data_file(case, pile.poured(case)), encoding="ascii")
                (folder / "settle.in").write_text(deck.settle_deck(case, self._restart_steps, start), encoding="ascii")
                self._engine("settle", folder, deck.settle_steps(case), 0, _step_of(start))
                for path in (*folder.glob("at.*.restart"), folder / "pile.data"):
                    path.unlink(missing_ok=True)
        return files.settled(folder / "settled.dump")

    def _push(self, plan_: Plan) -> list[Leg]:
        """Run the legs that have not been run; all of them."""
        case, folder = self._case, self._folder
        kept = folder / "legs.json"
        middle = (plan_.contact_step + plan_.last_step) // 2
        middle -= middle % plan_.frame_steps
        until = middle if case.decision == "again" else plan_.last_step
        legs = [_leg(each) for each in json.loads(kept.read_text())] if kept.exists() else [Leg(plan_.start, until)]
        number = 0
        while number < len(legs):
            if not (folder / f"leg.{number}.restart").exists():
                self._leg(number, legs, plan_)
            if legs[-1].until_step < plan_.last_step and number == len(legs) - 1:
                frames = self._frames(plan_, legs)
                legs += decided_again(case, frames[-1], legs[-1], plan_.frame_steps, plan_.last_step, self._dt)
                written(kept, json.dumps([asdict(leg) for leg in legs]))
            number += 1
        return legs

    def _leg(self, number: int, legs: list[Leg], plan_: Plan) -> None:
        case, folder, leg = self._case, self._folder, legs[number]
        began = legs[number - 1].until_step if number else 0
        before = f"leg.{number - 1}.restart" if number else f"../../piles/{case.pile_key()}/settled.restart"
        start = _newest(folder, began)
        attempt = len(list(folder.glob(f"push.{number}.*.in")))
        name = f"{number}.{attempt}"
        # Restart files fall on frames: the means that a frame ends with begin anew there.
        every = max(1, round(self._restart_steps / plan_.frame_steps)) * plan_.frame_steps
        style = "internal" if case.motion == "coupled" else "equal"
        text = deck.push_deck(
            case, start or before, leg.motion.text(style), not (number or start), plan_.frame_steps, every, name
        )
        if case.motion == "imposed":
            text += deck.last_lines(leg.until_step)
        (folder / f"push.{name}.in").write_text(text, encoding="ascii")
        self._engine(f"push.{name}", folder, leg.until_step, deck.settle_steps(case), _step_of(start) or began)
        (folder / "leg.restart").rename(folder / f"leg.{number}.restart")
        for path in folder.glob("at.*.restart"):
            path.unlink()

    def _engine(self, name: str, folder: Path, until_step: int, done_steps: int, from_step: int) -> None:
        def told(step: int) -> None:
            self._told(min(1.0, (done_steps + step) / self._steps_in_all))
            for path in sorted(folder.glob("at.*.restart"), key=lambda path: _step_of(path.name))[:-2]:
                path.unlink()

        log = f"{name}.log"
        if self._case.motion == "coupled" and name.startswith("push"):
            (folder / "case.json").write_text(self._case.model_dump_json(), encoding="utf-8")
            child = [sys.executable, "-P", "-m", COUPLED, str(folder), f"{name}.in", str(until_step)]
            arguments = [*engine.dying("KILL"), *child]
        else:
            arguments = engine.command(self._ranks_n, f"{name}.in", log)
        self._engine_s += engine.run(arguments, folder, log, told)
        self._particle_steps_n += self._case.grains_n * (until_step - from_step)

    def _frames(self, plan_: Plan, legs: list[Leg]) -> list[Frame]:
        found = []
        machine = None
        if self._case.motion == "coupled":
            from graderd.studies.blade_rotation import coupled  # needs MuJoCo

            machine = coupled.readings(self._folder)
        for step, grains in files.frames(self._folder).items():
            leg = next((leg for leg in legs if step <= leg.until_step), legs[-1])
            time_s = step * self._dt
            travel_m = (step - plan_.contact_step) * self._dt * self._case.speed_m_per_s
            blade = leg.motion.at(time_s)
            if machine is not None and step:
                blade = coupled.motion(machine, time_s)
            found.append(Frame(time_s, travel_m, blade, grains))
        return found


def _leg(data: dict[str, object]) -> Leg:
    motion = dict(data["motion"])  # type: ignore[call-overload]
    for name in ("place_m", "velocity_m_per_s"):
        motion[name] = tuple(motion[name])
    return Leg(Motion(**motion), int(str(data["until_step"])))


def _newest(folder: Path, after_step: int) -> str:
    """The restart file to go on from; empty where there is none. One that its writer did not finish has no end mark."""
    whole = [path for path in folder.glob("at.*.restart") if _step_of(path.name) > after_step and _is_whole(path)]
    return max((path.name for path in whole), key=_step_of, default="")


def _step_of(name: str) -> int:
    """The step in a restart file's name; 0 for none."""
    return int(name.split(".")[1]) if name else 0


def _is_whole(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 64))
        return END_MARK in file.read()
