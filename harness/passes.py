"""Whole passes over soil in the rig's world: what a pass is, what became of it, and one driven in virtual time.

The same code as daemon and rig run, in one process: world, pictures, perception and control tick, without wires and
drivers, and without a deadline to miss on a busy machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core import commands as cmd
from graderd.core.axes import ACTUATORS
from graderd.core.machine import Mode
from graderd.core.soil import OPPOSITE, SoilObservation, Zone
from graderd.core.tick import AxisSensed, Controller, Sensed, Tick, TickSettings
from graderd.hal.camera import Frame
from graderd.hal.device import Lifecycle
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.vehicle import VehicleTelemetry
from graderd.perception.classifier import make_classifier
from graderd.runtime.app.sim import RIG_FRAME_AGE_S
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import Materials
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import World, scene_heights
from graderd.simulator.servo.motion import Profile, Trajectory
from harness.perception_scenes import ON_GROUND

DRIVE_M = 3.0
SETTLED_DEG = 0.7
UNDECIDED_S = 4.0
"""No decision for so long: the machine drives all the same."""
FIXED_DEG = 15.0


@dataclass(frozen=True, slots=True)
class Case:
    """One pass to drive."""

    zone: str
    start_deg: float
    speed_m_per_s: float
    seed: int
    at_once: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of it. ``decisions``: zones in their order; ``changes_n``: after the first, while it drove;
    ``width_mm``: that holds 90 % of the soil left behind. ``note``: what fault disturbed
    it. ``undecided``: what was said of the soil when it drove without a decision."""

    case: Case
    decisions: tuple[str, ...]
    changes_n: int
    width_mm: float
    angle_deg: float
    note: str = ""
    undecided: str = ""

    @property
    def right(self) -> bool:
        """Whether the first decision was the soil's."""
        return self.decisions[:1] == (self.case.zone,)

    @property
    def wrong_side(self) -> bool:
        """Whether any decision turned the blade to the other side of the soil."""
        return OPPOSITE.get(Zone(self.case.zone)) in self.decisions


class Decisions:
    """Listens to the decision of a pass."""

    def __init__(self) -> None:
        self.zones: list[str] = []
        self.changes_n = 0

    def hear(self, zone: Zone | None, driving: bool) -> None:
        """The decision of now."""
        if zone is None or self.zones[-1:] == [str(zone)]:
            return
        self.changes_n += bool(self.zones) and driving
        self.zones.append(str(zone))


def width_left_behind_mm(heights_m: np.ndarray, cell_m: float, start_x_m: float, end_x_m: float) -> float:
    """Width across the bed that holds the middle 90 % of the soil between where the blade was and where it is."""
    rows = slice(int(start_x_m / cell_m), int(end_x_m / cell_m))
    across = np.concatenate(([0.0], np.cumsum(heights_m[rows].sum(axis=0))))
    if across[-1] <= 0.0:
        return 0.0
    borders = np.arange(across.size) * cell_m * 1e3
    low, high = np.interp((0.05, 0.95), across / across[-1], borders)
    return float(high - low)


BEHIND_M = 0.45
"""So far behind the blade's axis the soil is left: the ends of a blade at 45 degrees reach back 0.35 m."""


class LoopPass:
    """One pass in one process and virtual time: the world's step of 10 ms, the tick at 50 Hz, 10 pictures a second.

    (A rig makes up to 15, on a machine with other work 8 to 12.)
    """

    STEP_S, TICK_N, FRAME_N = 0.01, 2, 10
    SEEN_AFTER_S = 0.12
    """From the picture to the tick: rendering, judging and two pipes, as measured with the processes."""

    def __init__(self, case: Case, settings: TickSettings, config: Config, materials: Materials) -> None:
        self.case = case
        self.world = World()
        self.servo = Trajectory()
        self.servo.restart(case.start_deg)
        turns = settings.figures["rotation"]
        self._profile = Profile(turns.speed, turns.acceleration)
        self.now_s = 1000.0
        self._controller = Controller(settings)
        self._classifier = make_classifier(config.perception, config.camera.calibration, config.blade)
        self._renderer = Renderer((640, 400), (424, 240), seed=case.seed, materials=materials)
        self._coming: list[tuple[float, SoilObservation]] = []
        self._number = 0
        self._powered = self._driven = False
        self.world.blade = BladePose(case.start_deg)
        heights = scene_heights(SceneZone(case.zone), self.world.vehicle.x_m, self.world.blade, case.seed)
        self.world.lay(heights)

    @property
    def angle_deg(self) -> float:
        """Where the blade is."""
        return self.servo.position_deg

    def ticks(self) -> Iterator[Tick]:
        """Armed and in automatic operation, for as long as somebody looks."""
        commands: dict[int, tuple[cmd.AnyCommand, ...]] = {1: (cmd.Arm(),), 5: (cmd.Auto(),)}
        number = 0
        while True:
            for _ in range(self.TICK_N):
                self._step()
            number += 1
            tick = self._controller.step(self._sensed(commands.get(number, ())))
            assert all(reply.accepted for reply in tick.replies), tick.replies
            self._powered = tick.intents.power
            decided = tick.axes["rotation"]
            self._driven = decided.send is not None or (self._driven and not decided.hold)
            if decided.send is not None:
                self.servo.goal_deg = decided.send
            yield tick

    def _step(self) -> None:
        self.now_s += self.STEP_S
        self._number += 1
        self.servo.step(self.STEP_S, self._profile, 180.0)  # with its own speed and acceleration
        self.world.step(self.STEP_S, BladePose(self.angle_deg))
        if self._number % self.FRAME_N == 0:
            self._look()

    def _look(self) -> None:
        world = self.world
        seen = SceneState(world.field.heights_m.astype(np.float32), world.field.cell_m, world.vehicle.x_m, world.blade)
        color, depth = self._renderer.render(seen, Appearance())
        lenses = self._renderer.color_intrinsics, self._renderer.depth_intrinsics
        frame = Frame(color, depth, *lenses, self.now_s, self._number, self._number)
        observation = self._classifier.classify(frame, self.angle_deg, 0.01, ON_GROUND)
        self._coming.append((self.now_s + self.SEEN_AFTER_S, observation))

    def _sensed(self, commands: tuple[cmd.AnyCommand, ...]) -> Sensed:
        now_s, lifecycle = self.now_s, Lifecycle.ACTIVE if self._powered else Lifecycle.STANDBY
        home = {"lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}
        ready = [seen for due_s, seen in self._coming if due_s <= now_s]
        self._coming = [(due_s, seen) for due_s, seen in self._coming if due_s > now_s]
        vehicle = self.world.vehicle
        return Sensed(
            now_s=now_s,
            axes={
                "rotation": AxisSensed(
                    lifecycle,
                    RotatorTelemetry(
                        angle_deg=Reading(self.angle_deg, now_s),
                        velocity_deg_per_s=Reading(self.servo.velocity_deg_per_s, now_s),
                        goal_deg=self.servo.goal_deg if self._driven else None,
                    ),
                ),
                **{
                    axis: AxisSensed(lifecycle, ActuatorTelemetry(position_mm=Reading(home[axis], now_s)))
                    for axis in ACTUATORS
                },
            },
            commands=commands,
            observation=ready[-1] if ready else None,
            powered=self._powered,
            vehicle=VehicleTelemetry(Reading(vehicle.speed_m_per_s, now_s), Reading(vehicle.travelled_m, now_s)),
        )


def loop_pass(case: Case, config: Config, materials: Materials) -> Outcome:
    """Drive one pass in virtual time."""
    one = LoopPass(case, tick_settings(config), config, materials)
    heard = Decisions()
    started_s, drove = one.now_s, False
    vehicle = one.world.vehicle
    start_x_m = vehicle.x_m
    note = ""
    for tick in one.ticks():
        decision = tick.state.decision
        heard.hear(decision.zone, drove)
        if drove and tick.state.mode is not Mode.AUTO:
            note = note or f"{tick.state.mode}: {tick.state.reason}"
        if not drove and tick.state.mode is Mode.AUTO:
            turned = decision.angle_deg is not None and abs(one.angle_deg - decision.angle_deg) < SETTLED_DEG
            if case.at_once or turned or one.now_s - started_s > UNDECIDED_S:
                vehicle.drive(case.speed_m_per_s, DRIVE_M)
                drove = True
        elif drove and not vehicle.driving:
            break
    field = one.world.field
    width = width_left_behind_mm(field.heights_m, field.cell_m, start_x_m, vehicle.x_m - BEHIND_M)
    return Outcome(case, tuple(heard.zones), heard.changes_n, width, one.angle_deg, note)


def fixed_width_mm(seed: int, speed_m_per_s: float) -> float:
    """What a blade leaves that stands at 15 degrees from start to end, before soil in the center."""
    world = World()
    world.blade = BladePose(FIXED_DEG)
    world.lay(scene_heights(SceneZone.CENTER, world.vehicle.x_m, world.blade, seed))
    for _ in range(100):
        world.step(0.01, world.blade)
    start_x_m = world.vehicle.x_m
    world.vehicle.drive(speed_m_per_s, DRIVE_M)
    while world.vehicle.driving:
        world.step(0.01, world.blade)
    field = world.field
    return width_left_behind_mm(field.heights_m, field.cell_m, start_x_m, world.vehicle.x_m - BEHIND_M)


def loop_config() -> Config:
    """The settings that a daemon takes with a rig, without its wires."""
    config = Config()
    decision = config.perception.decision.model_copy(update={"max_frame_age_s": RIG_FRAME_AGE_S})
    return config.model_copy(update={"perception": config.perception.model_copy(update={"decision": decision})})
