"""A stretch of work as the tick knew it: every mode, a fault, a late tick, on a machine that follows."""

from __future__ import annotations

from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core import commands as cmd
from graderd.core.axes import ACTUATORS
from graderd.core.soil import SoilObservation, Zone
from graderd.core.tick import AxisSensed, Controller, Sensed
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry

TICK_S = 0.02
SETTINGS = tick_settings(Config())


def standing(
    now_s: float,
    at: dict[str, float],
    lifecycle: Lifecycle = Lifecycle.ACTIVE,
    goals: dict[str, float] | None = None,
) -> dict[str, AxisSensed]:
    """Every axis measured this moment; ``goals``: where their devices are driving them to."""
    goals = goals or {}
    turned = RotatorTelemetry(angle_deg=Reading(at["rotation"], now_s), goal_deg=goals.get("rotation"))
    return {
        "rotation": AxisSensed(lifecycle, turned),
        **{
            axis: AxisSensed(
                lifecycle, ActuatorTelemetry(position_mm=Reading(at[axis], now_s), goal_mm=goals.get(axis))
            )
            for axis in ACTUATORS
        },
    }


FASTEST = {"rotation": 25.0, "lift_left": 20.0, "lift_right": 20.0, "tilt": 15.0}
HOME = {"rotation": 0.0, "lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}


def stretch_of_work() -> list[Sensed]:
    """Arm, jog, preset, automatic with soil on the left, fault, late tick, stop, reset: on a machine that follows."""
    controller, found, at, powered = Controller(SETTINGS), [], dict(HOME), False
    goals: dict[str, float] = {}
    commands: dict[int, tuple[cmd.AnyCommand, ...]] = {
        5: (cmd.Arm(client="a"),),
        10: (cmd.Jog(axis="rotate", value=6.0, client="a"),),
        12: (cmd.Renew(client="a"),),
        20: (cmd.Renew(client="a"), cmd.Jog(axis="height", value=10.0, client="b")),
        60: (cmd.Preset(name="transport", client="a"),),
        70: (cmd.Renew(client="a"),),
        90: (cmd.Auto(client="a"),),
        260: (cmd.Stop(reason="enough", client="b"), cmd.Reset(client="a", stop_n=0)),
        270: (cmd.Reset(client="a", stop_n=1),),
    }
    for number in range(300):
        now_s = 100.0 + TICK_S * number
        seen = SoilObservation(now_s - 0.03, Zone.LEFT, 0.9, "", 0.8, 0.15, 0.05, frame_number=number)
        sensed = Sensed(
            now_s,
            standing(now_s, at, Lifecycle.ACTIVE if powered else Lifecycle.STANDBY, goals),
            faults=(DeviceFault("lift_left", "no_feedback", "0.4 s", now_s),) if 200 <= number < 210 else (),
            commands=commands.get(number, ()),
            observation=seen if number > 95 and number % 2 else None,
            powered=powered,
            refused={"rotation": "soft limit"} if number == 150 else {},
            late_s=0.15 if number == 180 else 0.0,
        )
        tick = controller.step(sensed)
        powered = tick.intents.power
        goals = {
            axis: decided.send if decided.send is not None else goals[axis]
            for axis, decided in tick.axes.items()
            if decided.send is not None or (axis in goals and not decided.hold)
        }
        for axis, goal in goals.items():
            at[axis] += max(-FASTEST[axis] * TICK_S, min(goal - at[axis], FASTEST[axis] * TICK_S))
        found.append(sensed)
    return found
