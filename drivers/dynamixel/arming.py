"""Powering the blade without a jump: everything written and read back before torque goes on."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass

from graderd.drivers.dynamixel.bus import ServoRefusedError
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.device import WATCHDOG_STEP_S, WATCHDOG_TRIPPED, Ph54Device
from graderd.hal.errors import DeviceError, DeviceRefusedError
from graderd.hal.settings import Ph54Settings

HOLD_ACCELERATION_FACTOR = 10.0
"""A hold brakes so much harder than a move, as far as the servo's Acceleration Limit lets it: at 30 °/s and 60 °/s² the
blade rests after 0.75°."""
_JUMP_DEG = 0.5
_STILL_DEG_PER_S = 2.0
_MEASURES_MOST_N = 4
_SLOWEST_COUNTS = 1
"""Profile velocity at torque-on: a servo that counts otherwise than it seemed has not moved when that is seen."""


@dataclass(frozen=True, slots=True)
class Armed:
    """What arming has left on the servo, in counts, and the acceleration that it takes for a hold."""

    goal_counts: int
    hold_acceleration_counts: int


def watchdog_counts(settings: Ph54Settings) -> int:
    """Bus Watchdog register for the settings' time: one step less than fits in, so that the blade stands by then."""
    return max(1, min(127, math.floor(settings.watchdog_s / WATCHDOG_STEP_S + 1e-9) - 1))


def profile_counts(settings: Ph54Settings, calibration: Calibration) -> dict[str, int]:
    """Profile registers of a move."""
    return {
        "profile_acceleration": calibration.acceleration_counts(settings.profile_acceleration_deg_per_s2),
        "profile_velocity": calibration.velocity_counts(settings.profile_velocity_deg_per_s),
    }


def hold_acceleration_counts(settings: Ph54Settings, calibration: Calibration) -> int:
    """Profile acceleration of a hold, before the servo's own limit."""
    return calibration.acceleration_counts(settings.profile_acceleration_deg_per_s2 * HOLD_ACCELERATION_FACTOR)


def eeprom_counts(calibration: Calibration) -> dict[str, int]:
    """What arming writes into the servo's EEPROM where it is not there already."""
    low, high = calibration.servo_limits()
    current = {"current_limit": round(calibration.current_limit_a * 1000.0)}
    return current if calibration.needs_turns else current | {"min_position_limit": low, "max_position_limit": high}


async def power_up(device: Ph54Device, settings: Ph54Settings, calibration: Calibration) -> Armed:
    """Write and read back limits, profile and watchdog, set goal := measured, torque on.

    Everything that a stop will write is written here first, and read back: a servo that refuses it is not armed.
    Position limits and current limit are EEPROM: written only where they differ (cells wear, and torque must be off
    for it). A tripped watchdog is cleared with torque off, so that no stale goal comes alive.

    Raises:
        DeviceRefusedError: the blade moves or lies outside the soft limits, or something did not read back.
        DeviceTimeoutError, DeviceLostError: the servo stopped answering. Torque was switched off again, or could not be
            reached any more (then the watchdog, if armed, stops it).
    """
    try:
        return await _power_up(device, settings, calibration)
    except BaseException:
        with contextlib.suppress(DeviceError):
            await device.write("torque_enable", 0, urgent=True)
        raise


async def _power_up(device: Ph54Device, settings: Ph54Settings, calibration: Calibration) -> Armed:
    health, alert = await device.read_block(device.health_block)
    if alert or health["hardware_error_status"]:
        raise DeviceRefusedError(
            device.where,
            f"hardware error 0x{health['hardware_error_status']:02X} is present",
            "Find the cause, then `graderd rotation reboot`",
        )
    goals, _ = await device.read_block(device.goal_block)
    limits, _ = await device.read_block(device.limit_block)
    wanted = eeprom_counts(calibration)
    stale = {name: value for name, value in wanted.items() if limits[name] != value}
    tripped = goals["bus_watchdog"] == WATCHDOG_TRIPPED
    measured, raw = await _measure(device, calibration)
    if health["torque_enable"] and (stale or tripped or raw != measured):
        await device.torque(False)
        measured, raw = await _measure(device, calibration)  # what is without torque may give way
    if tripped:
        await device.write("bus_watchdog", 0)
    for name, value in stale.items():
        await device.write(name, value)
    if stale:
        await device.confirm(wanted, device.limit_block)

    profile = profile_counts(settings, calibration)
    top = limits["velocity_limit"], limits["acceleration_limit"]
    if profile["profile_velocity"] > top[0] or profile["profile_acceleration"] > top[1]:
        raise DeviceRefusedError(
            device.where,
            f"profile {profile} is above the servo's own velocity or acceleration limit {top}",
            "Lower rotation.speed_deg_per_s or rotation.acceleration_deg_per_s2, or raise the servo's limits",
        )
    hold = {
        **profile,
        "profile_acceleration": min(hold_acceleration_counts(settings, calibration), limits["acceleration_limit"]),
        "goal_position": measured,
    }
    try:
        await device.write_block(device.profile_block, hold)
    except ServoRefusedError as e:
        raise DeviceRefusedError(
            device.where, f"it refuses what a hold writes ({e.cause})", "'graderd profile verify rotation' shows why"
        ) from e
    await device.confirm(hold, device.goal_block)
    goal = {
        "goal_current": wanted["current_limit"],
        "goal_velocity": limits["velocity_limit"],
        **profile,
        "profile_velocity": _SLOWEST_COUNTS,
        "goal_position": measured,
    }
    await device.write_block(device.arm_block, goal)
    await device.write("bus_watchdog", watchdog_counts(settings))
    await device.confirm({k: v for k, v in goal.items() if k != "goal_current"}, device.goal_block)
    await device.torque(True)
    present = await device.read("present_position")
    if abs(calibration.servo_deg(present - measured)) > _JUMP_DEG * calibration.gear_ratio:
        raise DeviceRefusedError(
            device.where,
            f"its count is {calibration.servo_deg(present - measured) / 360.0:+.2f} turns off the goal it stands at",
            "Reboot the servo; 'graderd profile verify rotation' shows its mode",
        )
    move = {**profile, "goal_position": measured}
    await device.write_block(device.profile_block, move)
    await device.confirm({"bus_watchdog": watchdog_counts(settings), **move}, device.goal_block)
    return Armed(measured, hold["profile_acceleration"])


async def _measure(device: Ph54Device, calibration: Calibration) -> tuple[int, int]:
    """Present position of a blade that stands inside its limits: as it will count with torque on, and as it is now.

    Two readings have to agree: one alone may be wrong.
    """
    agreed = _JUMP_DEG * calibration.gear_ratio
    sample, _ = await device.read_block(device.telemetry_block)
    for _ in range(_MEASURES_MOST_N):
        former, (sample, _) = sample, await device.read_block(device.telemetry_block)
        if abs(calibration.servo_deg(sample["present_position"] - former["present_position"])) <= agreed:
            break
    else:
        raise DeviceRefusedError(device.where, "no two readings of the angle agree", "Arm when the blade stands still")
    counts = raw = sample["present_position"]
    if not calibration.needs_turns:  # in position mode torque-on resets the count to within one turn
        half = calibration.pulses_per_turn // 2
        counts = (counts + half) % calibration.pulses_per_turn - half
    angle_deg = calibration.blade_deg(counts)
    speed = calibration.blade_deg_per_s(sample["present_velocity"])
    if abs(speed) > _STILL_DEG_PER_S:
        raise DeviceRefusedError(device.where, f"the blade turns at {speed:+.1f} °/s", "Arm when it stands still")
    if not calibration.within_limits(angle_deg, _JUMP_DEG):
        raise DeviceRefusedError(
            device.where,
            f"the blade is at {angle_deg:+.1f}°, outside its limits {calibration.min_deg:g}…{calibration.max_deg:g}°",
            "Turn it back by hand, or check rotation.zero_deg and the limits",
        )
    return counts, raw
