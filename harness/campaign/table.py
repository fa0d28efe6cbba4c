"""The faults that the rig can make: camera, servo, CAN bus and actuators. The daemon's own: ``table_daemon``."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from contextlib import suppress
from typing import Any

from graderd.hal.errors import DeviceError
from graderd.simulator.grader.blade import LEVEL_TILT_MM
from harness.campaign.conduct import BRAKE_S, EVERYTHING, SLACK_S, STILL_S, goes_up, names_in
from harness.campaign.model import ROTATION, Action, Case, Outcome, Phase
from harness.campaign.stack import CampaignError, Stack

TILT_REACH_MM = 40.0
"""From level, either way: inside what a new start is permitted at."""
IDLE, TURNING, LIFTING = Phase.IDLE, Phase.TURNING, Phase.LIFTING


def camera(name: str, **params: float) -> Action:
    """A fault of the rig's camera."""

    async def inject(stack: Stack) -> None:
        await stack.ask_rig("camera_fault", name=name, params=params)

    return inject


def servo(name: str, **params: float) -> Action:
    """A fault of the virtual servo or its wire."""

    async def inject(stack: Stack) -> None:
        await stack.ask_rig("servo_fault", name=name, params=params)

    return inject


def actuator(name: str, device: str | None = None, **params: float) -> Action:
    """A fault of one virtual actuator, or of the bus."""

    async def inject(stack: Stack) -> None:
        await stack.ask_rig("actuator_fault", name=name, device=device, params=params)

    return inject


async def override_tilt(stack: Stack) -> None:
    """Somebody turns the tilt's manual override, towards the farther end of its stroke."""
    direction = -1.0 if stack.watch.newest().state["tilt_mm"] > LEVEL_TILT_MM else 1.0
    await stack.ask_rig("actuator_fault", name="manual_override", device="tilt", params={"direction": direction})


async def overload_lift(stack: Stack) -> None:
    """More than the left lift can move, against the way it goes or will be told to go."""
    state = stack.watch.newest().state
    speed = state["lift_left_velocity_mm_per_s"]
    up = speed > 0.0 if abs(speed) > 1.0 else goes_up(state)
    params = {"load_n": 4000.0 if up else -4000.0}
    await stack.ask_rig("actuator_fault", name="overload", device="lift_left", params=params)


async def turn_tilt_back(stack: Stack) -> None:
    """The override may have left the tilt where operation may not begin: it is turned back by the override as well."""

    def beyond() -> float:
        return float(stack.watch.newest().state["tilt_mm"]) - LEVEL_TILT_MM

    if abs(beyond()) > TILT_REACH_MM:
        params = {"direction": -1.0 if beyond() > 0.0 else 1.0}
        await stack.ask_rig("actuator_fault", name="manual_override", device="tilt", params=params)
        await stack.until(lambda: abs(beyond()) < TILT_REACH_MM, 5.0, "the override does not turn the tilt back")
        await stack.heal()
        await stack.watch.until_still(("tilt",), 0.3, 2.0)


def worker(number: signal.Signals) -> Action:
    """A signal to the perception child."""

    async def inject(stack: Stack) -> None:
        os.kill(stack.worker_pid(), number)

    return inject


async def heal(stack: Stack) -> None:
    """The cause goes away."""
    await stack.heal()


async def thaw(stack: Stack) -> None:
    """A stopped child is killed by the daemon; should it live still, let it go on."""
    with suppress(Exception):
        os.kill(stack.worker_pid(), signal.SIGCONT)


async def reboot(stack: Stack) -> None:
    """What the remedy of a hardware alert asks for."""
    await stack.service("rotation.reboot", consent=True)


async def put_back(stack: Stack) -> None:
    """A runaway may end outside the limits: the blade is turned back by hand, and the overloaded servo rebooted."""
    await asyncio.sleep(1.0)
    with suppress(DeviceError):
        await stack.ask_rig("turn_blade", angle_deg=0.0)
    await reboot(stack)


async def by_depth_alone(stack: Stack, case: Case, phase: Phase, outcome: Outcome) -> None:
    """Depth brings its own light: without a colour picture the soil is seen as before, and the work goes on."""
    before = outcome.expected_state = "auto" if phase is TURNING else "manual"
    from_s = time.monotonic()
    await case.inject(stack)
    await asyncio.sleep(0.5)  # until the last picture with colour is no longer the newest
    with suppress(CampaignError):
        await stack.until_status(lambda s: s["soil"]["zone"] != "unknown", 6.0, "the soil is unknown")
        outcome.detected, outcome.detection_s = True, time.monotonic() - from_s
    soil = stack.status["soil"]
    outcome.message = f"nothing to tell: by depth the soil is {soil['zone']}, {soil['confidence']:.0%} sure"
    if phase is TURNING:
        goal_deg = stack.status["decision"]["angle_deg"]
        if goal_deg is None:
            raise CampaignError(f"the decision is gone: {stack.status['mode']}, {stack.status['reason']}")
        there = f"the blade does not come to {goal_deg}°"
        await stack.until(lambda: abs(stack.watch.newest().state["blade_deg"] - goal_deg) < 1.0, 6.0, there)
    status = await stack.read_status() or {}
    outcome.problems += [f"told {name}" for name in names_in(status) if name.startswith("camera.")]
    outcome.final_state = str(status.get("mode", "no answer"))
    if outcome.final_state != before:
        outcome.problems.append(f"the mode became {outcome.final_state}: {status.get('reason')}")
    await stack.rest()
    released_s = time.monotonic()
    await stack.command("manual")
    outcome.safe = await stack.watch.until_still(EVERYTHING, STILL_S, 3.0)
    outcome.standstill_s, outcome.standstill_from = stack.watch.standstill_s(EVERYTHING, released_s), "manual command"
    outcome.safe = outcome.safe and outcome.standstill_s <= BRAKE_S + SLACK_S
    outcome.recovered_as_catalogued, outcome.recovery = True, "nothing to recover from"


def on_bare_ground(inject: Action) -> Action:
    """Without soil: a blade that spins through a heap costs the rig more time than its wires have."""

    async def both(stack: Stack) -> None:
        await stack.ask_rig("scene", zone="none")
        await inject(stack)

    return both


def _camera(name: str, text: str, fault: str, inject: Action, **more: Any) -> Case:
    return Case(f"camera_{name}", text, (f"camera.{fault}",) if fault else (), inject, heal, **more)


def _servo(name: str, text: str, faults: str, inject: Action, **more: Any) -> Case:
    named = tuple(f"rotation.{fault}" for fault in faults.split())
    return Case(f"servo_{name}", text, named, inject, heal, **more)


def _actuator(name: str, text: str, device: str, conditions: str, fault: str, **more: Any) -> Case:
    named = tuple(f"{device}.{condition}" for condition in conditions.split())
    inject = more.pop("inject", None) or actuator(fault, device)
    return Case(f"actuator_{name}", f"{device} {text}", named, inject, heal, **more)


def _can(name: str, text: str, fault: str, inject: Action, **more: Any) -> Case:
    return Case(f"can_{name}", text, (f"can.{fault}",), inject, heal, **more)


CAMERA = (
    _camera("unplug", "the camera is gone", "missing", camera("unplug"), detect_s=1.0, short=(TURNING,)),
    _camera("stall", "no further frame, the connection stays", "stale", camera("stall"), detect_s=0.8),
    _camera("freeze", "the same picture under new numbers", "frozen", camera("freeze"), detect_s=1.5),
    _camera("black", "no light in the colour picture", "", camera("black"), conduct=by_depth_alone, short=(TURNING,)),
    _camera("blown_out", "the colour picture overexposed", "", camera("blown_out"), conduct=by_depth_alone),
    _camera(
        "blocked", "something covers both lenses", "blocked", camera("blocked"), detect_s=0.8, short=(TURNING, LIFTING)
    ),
    _camera("blurred", "out of focus", "blurred", camera("blurred"), detect_s=2.0),
    _camera("torn", "depth from an earlier frame than colour", "torn", camera("torn"), detect_s=1.2),
    _camera("knocked", "the mount was hit", "knocked", camera("knocked"), detect_s=3.0),
    _camera("half_size", "pictures at half the size", "wrong_resolution", camera("wrong_resolution"), detect_s=0.8),
    _camera("no_depth", "the depth stream stops", "depth_missing", camera("no_depth"), detect_s=1.3),
    _camera("worker_killed", "the perception child is killed", "worker_restarted", worker(signal.SIGKILL)),
    Case(
        "camera_worker_hung",
        "the perception child stands still (SIGSTOP)",
        ("camera.stale", "camera.worker_hung"),
        worker(signal.SIGSTOP),
        thaw,
        detect_s=0.8,
    ),
)

SERVO = (
    _servo("silence", "no status packet arrives", "no_reply", servo("drop"), short=(TURNING,)),
    _servo("deaf", "no instruction packet arrives", "no_reply", servo("drop_requests")),
    _servo("crc", "a bit of every reply is flipped", "no_reply corrupt_replies", servo("flip")),
    _servo("truncated", "every reply lacks its end", "no_reply corrupt_replies", servo("truncate")),
    _servo("foreign", "replies carry another id", "no_reply", servo("foreign_id")),
    _servo("late", "replies come 0.4 s late", "no_reply corrupt_replies", servo("delay", seconds=0.4)),
    _servo("unplug", "the adapter's plug is pulled and put back", "unplugged", servo("unplug"), short=(LIFTING,)),
    _servo("power_cut", "24 V fail, and return with the repair", "no_reply", servo("power_cut")),
    _servo("brown_out", "a supply dip resets the RAM", "ram_reset torque_off", servo("ram_reset"), short=(TURNING,)),
    _servo("torque_off", "torque switched off by somebody else", "torque_off", servo("torque_off"), short=(LIFTING,)),
    _servo("turns_lost", "the turn count jumps", "turns_lost", servo("turns_lost")),
    _servo("jam", "the shaft is blocked", "not_moving", servo("jam"), needs="rotation", detect_s=1.2, short=(TURNING,)),
    _servo(
        "wrong_way", "the motor runs the wrong way", "wrong_way", on_bare_ground(servo("wrong_way")),
        needs="rotation", detect_s=1.2, before_arm=put_back, own_motion=ROTATION,
    ),
    _servo(
        "runaway", "an outer torque turns the blade", "moving_uncommanded wrong_way overspeed",
        on_bare_ground(servo("push", torque_nm=55.0)),
        detect_s=2.5, before_arm=put_back, own_motion=ROTATION,
    ),
    _servo("weak_supply", "19.5 V at the servo", "voltage_near_limit", servo("voltage", volts=19.5), detect_s=1.0),
    _servo("hot", "75 °C", "temperature_near_limit", servo("temperature", celsius=75.0), detect_s=1.6),
    *(
        _servo(
            f"alert_{name}", f"hardware alert {name}", f"alert_{name}", servo(f"alert_{name}"),
            before_arm=reboot, short=short,
        )
        for name, short in (
            ("voltage", ()), ("hall_sensor", ()), ("overheating", ()), ("encoder", ()), ("electrical_shock", ()),
            ("overload", (TURNING,)),
        )
    ),
)  # fmt: skip

CAN = (
    _can("unplug", "the adapter is pulled and put back", "unplugged", actuator("unplug"), short=(LIFTING,)),
    _can("adapter_refuses", "the adapter answers NACK to every frame", "adapter_refuses", actuator("adapter_refuses"),
         short=(LIFTING,)),
    _can("bus_off", "the controller leaves the bus", "bus_off", actuator("bus_off"), short=(LIFTING,)),
    _can("error_passive", "128 errors counted", "error_passive", actuator("error_passive")),
    _can("overrun", "received frames were lost", "queue_overrun", actuator("overrun")),
    _can("flood", "2000 foreign frames a second", "flood", actuator("flood"), detect_s=1.6, short=(TURNING,)),
    _can("equal_address", "a node with our address and NAME", "address_conflict", actuator("address_conflict")),
    _can("claim_storm", "a node claims our address without end", "claim_storm", actuator("claim_storm", wins=0.0),
         detect_s=1.0),
)  # fmt: skip

ACTUATOR = (
    _actuator("silence", "is not heard", "lift_left", "no_feedback", "silence", short=(IDLE, LIFTING)),
    _actuator("power_cut", "loses power", "lift_right", "no_feedback", "power_cut"),
    _actuator("restart", "restarts", "tilt", "restarted", "restart", detect_s=1.5),
    _actuator("garbage", "sends garbage", "lift_left", "implausible_feedback no_feedback", "garbage", detect_s=1.0),
    _actuator("lying", "repeats its last position", "lift_left", "not_moving sides_apart", "frozen_feedback",
              needs="lift", detect_s=1.6, either=True),
    _actuator("babble", "sends 500 messages a second", "tilt", "feedback_flood", "babble", detect_s=1.0),
    _actuator("wrong_address", "answers at another address", "lift_right", "wrong_address", "wrong_address",
              detect_s=0.8),
    _actuator("stuck", "is stuck", "lift_left", "overload not_moving", "stuck",
              needs="lift", detect_s=1.6, short=(LIFTING,)),
    _actuator("drift", "is moved by its load", "lift_right", "uncommanded_motion backdrive", "drift", detect_s=2.5,
              own_motion=frozenset({"lift_right"}), hidden_by="lift_left"),
    _actuator("override", "is moved by its manual override", "tilt", "uncommanded_motion", "manual_override",
              inject=override_tilt, detect_s=2.0, before_arm=turn_tilt_back, own_motion=frozenset({"tilt"})),
    _actuator("overload", "carries 4000 N", "lift_left", "overload", "overload", inject=overload_lift, needs="lift",
              detect_s=1.5),
    _actuator("fatal", "reports a fatal error", "tilt", "fatal", "fatal", short=(TURNING,)),
    _actuator("low_voltage", "gets 8 V", "lift_left", "voltage", "voltage_low", detect_s=1.0),
    _actuator("high_voltage", "gets 17 V", "tilt", "voltage", "voltage_high", detect_s=1.0),
    _actuator("cold", "is at -45 °C", "lift_right", "temperature", "temperature_low", detect_s=1.0),
    _actuator("hot", "is at 90 °C", "tilt", "temperature", "temperature_high", detect_s=1.0),
    _actuator("backdrive", "reports backdrive", "lift_left", "backdrive", "backdrive"),
    _actuator("parameter", "refuses our messages", "tilt", "parameter", "parameter"),
    _actuator("saturation", "works near its most", "lift_right", "saturation", "saturation", detect_s=1.6),
)  # fmt: skip
