"""``python -m harness.claims``: what docs/integrators/safety.md claims, taken out one by one, and which tests notice.

Each takes one function's effect out of a copy of the tree, and runs the tests that the page names for it. The name
begins with the page's function. How it is done, and what the exit status says: ``harness/seeded.py``. The page's last
results stand in docs/developers/mutation.md.
"""

from __future__ import annotations

import sys
from typing import Final

from harness.seeded import Mutant, command_line

CONTROL: Final = "tests/unit/test_runtime_control.py::"
GATE: Final = "tests/unit/test_core_gate.py::"
MODEL: Final = "tests/unit/test_core_machine_model.py::"
STOP: Final = "tests/unit/test_api_stop.py::"
SOCKETS: Final = "tests/unit/test_api_sockets.py::"
MANEUVER: Final = "tests/unit/test_runtime_maneuver.py::"
PLAUSIBLE: Final = "tests/unit/test_core_plausibility.py::"
DAEMON: Final = "tests/unit/test_daemon.py::"
LIFTS: Final = "tests/unit/test_lifts_together.py::"
FOLLOWING: Final = "tests/unit/test_dynamixel_following.py::"
J1939_STOP: Final = "tests/fault/test_j1939_stop.py::"

CLAIMS: Final = (
    Mutant(
        "F1-holds-first",
        "graderd/runtime/control.py",
        "        self._hold_all()\n        reply = self._step((command,))[0]\n",
        "        reply = self._step((command,))[0]\n",
        (CONTROL + "test_a_stop_is_on_every_wire_before_anything_else_is_asked",),
        "a stop is told to the drivers only after everything is decided",
    ),
    Mutant(
        "F1-every-driver",
        "graderd/runtime/devices.py",
        "                failed.append(name)\n        return",
        "                failed.append(name)\n                break\n        return",
        (CONTROL + "test_one_driver_that_fails_to_hold_does_not_keep_the_others_from_it",),
        "one broken driver keeps the stop from the others",
    ),
    Mutant(
        "F1-latches",
        "graderd/core/machine.py",
        "    return State(mode=Mode.STOPPED, reason=",
        "    return State(mode=Mode.DISARMED, reason=",
        (MODEL + "test_stop_always_wins",),
        "a stop does not latch",
    ),
    Mutant(
        "F1-any-body",
        "graderd/api/stop.py",
        '    except UnicodeDecodeError:\n        return body.decode("latin-1")',
        "    except UnicodeDecodeError:\n        raise",
        (STOP + "test_no_body_is_a_reason_to_refuse_a_stop",),
        "a stop is refused for its body",
    ),
    Mutant(
        "F1-request-line",
        "graderd/api/stop.py",
        '    return [part for part in path.lower().split("/") if part] == ["v1", "stop"]',
        "    return path == STOP_PATH",
        (STOP + "test_the_request_line_is_the_stop",),
        "a stop is refused for a slash",
    ),
    Mutant(
        "F1-among-commands",
        "graderd/api/limiter.py",
        "                    if commands and is_stop_command(body, complete=not more):\n",
        "                    if False:\n",
        (STOP + "test_a_stop_among_the_commands_is_as_good",),
        "a stop among the commands is refused for what is with it",
    ),
    Mutant(
        "F1-on-the-jog-socket",
        "graderd/api/sockets.py",
        "        if is_stop_command(text):\n            self._moved",
        "        if False:\n            self._moved",
        (STOP + "test_a_stop_on_the_jog_socket_is_as_good",),
        "a stop on the jog socket is refused for what is with it",
    ),
    Mutant(
        "F1-body-not-waited-for",
        "graderd/api/stop.py",
        "            async with asyncio.timeout(GRACE_S):",
        "            async with asyncio.timeout(5.0):",
        (STOP + "test_a_stop_does_not_wait_for_a_body_that_stalls",),
        "a stop waits for a body that stalls",
    ),
    Mutant(
        "F1-state-not-waited-for",
        "graderd/runtime/state_file.py",
        'threading.Thread(target=self._write_all, args=(self._path,), name="state-file", daemon=True).start()',
        "self._write_all(self._path)",
        ("tests/unit/test_runtime_parts.py::test_a_state_directory_that_stalls_is_not_waited_for_and_told",),
        "a stop waits for a disk",
    ),
    Mutant(
        "F1-stop-input",
        "graderd/runtime/stop_input.py",
        "                loop.call_soon_threadsafe(self._on_stop, detail)\n",
        "                pass\n",
        ("tests/unit/test_stop_input.py::test_a_press_is_told_at_once_and_once_and_stands_until_released",),
        "an open stop loop is told with the next poll of faults alone",
    ),
    Mutant(
        "F2-mode",
        "graderd/core/gate.py",
        "from graderd.core.machine import ARMED, Mode\n",
        "from graderd.core.machine import Mode\n\nARMED = tuple(Mode)\n",
        (GATE + "test_disarmed_or_stopped_only_staying_is_allowed",),
        "the gate lets goals pass in every mode",
    ),
    Mutant(
        "F2-finite",
        "graderd/core/gate.py",
        "    if not math.isfinite(requested):\n",
        "    if False:\n",
        (GATE + "test_only_finite_numbers",),
        "a goal that is no number passes the gate",
    ),
    Mutant(
        "F2-fresh",
        "graderd/core/gate.py",
        '    if measured is None:\n        return "no fresh measurement of this axis"\n',
        "    if measured is None:\n        measured = 0.0\n",
        (GATE + "test_no_motion_without_a_measurement",),
        "an axis is let move that is not measured",
    ),
    Mutant(
        "F3-lapse",
        "graderd/core/machine.py",
        "    if state.lease is None or now_s <= state.lease.expires_s:\n        return state\n",
        "    if state.lease is None or now_s:\n        return state\n",
        (MODEL + "test_a_lapsed_lease_ends_motion",),
        "a jog goes on for a client that renews no more",
    ),
    Mutant(
        "F3-given-back",
        "graderd/api/sockets.py",
        "        finally:\n            await session.release()\n",
        "        finally:\n            pass\n",
        (SOCKETS + "test_the_lease_is_given_back_when_the_client_goes",),
        "a jog goes on for a lease after its client has gone",
    ),
    Mutant(
        "F3-own-name",
        "graderd/api/http_routes.py",
        "            self._names[number] = f\"{printable(given) or 'client'}{at}#{number}\"\n",
        "            self._names[number] = printable(given)\n",
        (SOCKETS + "test_nobody_keeps_somebody_elses_lease",),
        "who takes another's name keeps another's jog going",
    ),
    Mutant(
        "F3-maneuver-heard",
        "graderd/api/sockets.py",
        "                async with asyncio.timeout(self._silence_s):\n",
        "                async with asyncio.timeout(None):\n",
        (SOCKETS + "test_a_maneuver_ends_with_its_client",),
        "a maneuver goes on for a client that was halted",
    ),
    Mutant(
        "F3-one-maneuver",
        "graderd/runtime/port.py",
        "        if self._under_way:\n",
        "        if False:\n",
        (MANEUVER + "test_one_at_a_time",),
        "two maneuvers at once",
    ),
    Mutant(
        "F3-consent",
        "graderd/runtime/port.py",
        '        if arguments.get("consent") is not True:\n',
        '        if not arguments.get("consent"):\n',
        (MANEUVER + "test_consent_is_true",),
        "the blade moves for what only counts as true",
    ),
    Mutant(
        "F4-limits",
        "graderd/core/gate.py",
        "    low, high = figures.low, figures.high\n    why",
        "    low, high = -1e9, 1e9\n    why",
        (GATE + "test_absolute_limits_swept_densely",),
        "goals beyond the limits pass the gate",
    ),
    Mutant(
        "F4-window",
        "graderd/core/gate.py",
        "    if armed_at + figures.window < high:\n",
        "    if False:\n",
        (GATE + "test_window_around_the_armed_pose",),
        "goals beyond the window pass the gate",
    ),
    Mutant(
        "F4-lead",
        "graderd/core/gate.py",
        "    if abs(setpoint.position - measured) <= lead:\n",
        "    if setpoint:\n",
        (GATE + "test_a_device_with_its_own_profile_gets_the_goal_itself_inside_and_near",),
        "a goal runs far ahead of its axis",
    ),
    Mutant(
        "F4-driver",
        "drivers/dynamixel/ph54.py",
        "        if not self.calibration.within_limits(goal_deg):\n",
        "        if False:\n",
        (
            "tests/contract/test_dynamixel_rotator.py::TestPh54OverFourTransports::test_illegal_goals_are_refused_and_change_nothing",
        ),
        "the driver takes goals beyond its limits",
    ),
    Mutant(
        "F5-watchdog",
        "drivers/dynamixel/arming.py",
        "    return max(1, min(127, math.floor(settings.watchdog_s / WATCHDOG_STEP_S + 1e-9) - 1))",
        "    return 127",
        ("tests/fault/test_end_to_end.py::test_the_servo_stops_by_its_own_watchdog_when_the_daemon_is_killed",),
        "the servo goes on for seconds when nobody speaks to it",
    ),
    Mutant(
        "F6-goal",
        "drivers/dynamixel/servo_task.py",
        "now_s - self._goal_s > self._settings.goal_timeout_s",
        "now_s - self._goal_s > 100.0 * self._settings.goal_timeout_s",
        (
            "tests/contract/test_dynamixel_rotator.py::TestPh54OverFourTransports::test_a_goal_not_renewed_becomes_a_hold",
        ),
        "the blade goes on to the goal of a control loop that is dead",
    ),
    Mutant(
        "F7-look-ahead",
        "drivers/electrak/planner.py",
        "LOOK_AHEAD_S: Final = 0.3\n",
        "LOOK_AHEAD_S: Final = 3.0\n",
        ("tests/fault/test_electrak_faults.py::test_a_dead_controller_leaves_a_bounded_move",),
        "an actuator goes on far after its controller died",
    ),
    Mutant(
        "F8-judged",
        "graderd/core/plausibility.py",
        "        return tuple(found)\n\n\nclass _AxisWatch",
        "        return ()\n\n\nclass _AxisWatch",
        (
            PLAUSIBLE + "test_creep_is_named_after_half_a_degree_however_slow",
            PLAUSIBLE + "test_running_away_from_the_goal_is_named_in_time",
            PLAUSIBLE + "test_a_snap_is_overspeed",
            PLAUSIBLE + "test_stuck_is_named_after_its_time",
        ),
        "nobody judges whether a motion is plausible",
    ),
    Mutant(
        "F8-uncommanded-stops",
        "graderd/core/tick.py",
        "        implausible = self._plausibility.judge(_samples(sensed), sensed.now_s)\n",
        "        implausible = ()\n",
        (CONTROL + "test_a_blade_that_turns_uncommanded_stops_the_machine",),
        "what is implausible has no consequence",
    ),
    Mutant(
        "F9-lost-servo",
        "drivers/dynamixel/servo_task.py",
        "            if silent_s > self._settings.reply_timeout_s and unanswered_n >= _UNANSWERED_N:\n",
        "            if False:\n",
        ("tests/fault/test_dynamixel_faults.py::test_no_reply_fails_the_rotator_stops_the_blade_and_heals",),
        "a servo that does not answer is not lost",
    ),
    Mutant(
        "F10-dwell",
        "graderd/core/rule.py",
        "    if now_s - decision.decided_s < rule.dwell_s or not decision.votes:\n",
        "    if not decision.votes:\n",
        ("tests/unit/test_core_rule.py::test_dwell_separates_decisions",),
        "decisions follow each other without a pause",
    ),
    Mutant(
        "F10-votes",
        "graderd/core/rule.py",
        "if len(of) >= rule.votes_needed_n}",
        "if len(of) >= 1}",
        ("tests/fault/test_wrong_pictures.py::test_wrong_zones_in_a_tenth_of_the_pictures",),
        "one wrong picture decides",
    ),
    Mutant(
        "F11-afterwards-may-fail",
        "graderd/runtime/app/daemon.py",
        '            except Exception:\n                log.exception("after a tick: failed")\n',
        "            except ZeroDivisionError:\n                pass\n",
        (DAEMON + "test_what_is_told_after_a_tick_may_fail",),
        "a status that cannot be built ends control",
    ),
    Mutant(
        "F12-guard",
        "graderd/runtime/app/guard.py",
        "        return backend.safe_off({name: settings for name, (_, settings) in found.items()}, config.can)",
        '        return f"nothing for {len(found)}"',
        ("tests/fault/test_guard.py::test_the_guard_alone_ends_motion_on_both_wires",),
        "the guard says nothing to the actuators",
    ),
    Mutant(
        "F13-reset-disarms",
        "graderd/core/machine.py",
        '            return yes(_disarmed(state, "reset"), "reset; arm',
        '            return yes(_manual(state, "reset"), "reset; arm',
        (MODEL + "test_stopped_is_left_only_by_reset_and_never_into_an_armed_mode",),
        "a reset arms the machine",
    ),
    Mutant(
        "F13-stop-survives",
        "graderd/runtime/control.py",
        "    if last_stop is None or last_stop.reset:\n",
        "    if last_stop:\n",
        (CONTROL + "test_after_a_stop_and_a_restart_reset_comes_first",),
        "a restart does away with a stop",
    ),
    Mutant(
        "F13-fresh-votes",
        "graderd/core/machine.py",
        '            if "rotation" in held\n',
        "            if False\n",
        (
            "tests/unit/test_core_tick.py::test_no_fault_that_goes_lets_motion_go_on_without_a_fresh_decision_or_a_command",
        ),
        "after a hold the blade goes on with the old decision",
    ),
    Mutant(
        "F13-retreat",
        "graderd/core/machine.py",
        "    if fault is not None and fault.row.reaction is Reaction.RETREAT and state.mode is Mode.AUTO:\n",
        "    if False:\n",
        (
            "tests/unit/test_core_tick.py::test_no_fault_that_goes_lets_motion_go_on_without_a_fresh_decision_or_a_command",
        ),
        "automatic operation goes on while a person is sent to the blade",
    ),
    Mutant(
        "F14-lost-side",
        "graderd/core/lift_pair.py",
        "        if any(now_s - reading.time_s > self._settings.silent_s for reading in (left, right)):\n",
        "        if False:\n",
        (LIFTS + "test_a_lost_side_stops_the_other_within_10_mm",),
        "a lift goes on while the other is not heard",
    ),
    Mutant(
        "F14-together",
        "graderd/core/lift_pair.py",
        "        commands = self._share(deviations_mm) if self._waiting is None else self._catch_up(self._waiting)\n",
        "        commands = tuple(SideCommand(side.target_mm, 1.0) for side in self._sides)\n",
        (LIFTS + "test_healthy_sides_stay_within_3_mm_and_within_115_percent_of_the_slow_sides_time",),
        "each side goes as fast as it can",
    ),
    Mutant(
        "F15-last-address",
        "drivers/j1939/link.py",
        "        return user.stop_frame(self._last_address, now_s)\n",
        "        return None\n",
        (J1939_STOP + "test_a_contention_in_mid_lift_stops_at_once_and_a_stop_during_the_new_claim_finds_it_stopped",),
        "a stop is mute while the address is contended",
    ),
    Mutant(
        "F16-standing",
        "graderd/core/gate.py",
        "    shrunk = figures.lead - figures.speed * max(0.0, setpoint.standing_s - STANDING_S)\n",
        "    shrunk = figures.lead\n",
        (GATE + "test_the_lead_shrinks_while_the_axis_stands_and_only_then",),
        "a goal waits its whole lead ahead of a jam",
    ),
    Mutant(
        "F16-set-point",
        "drivers/dynamixel/motion.py",
        "    lag = motion.setpoint_deg - motion.position_deg\n    away",
        "    return None\n    lag = motion.setpoint_deg - motion.position_deg\n    away",
        (FOLLOWING + "test_a_jam_that_comes_free_at_any_time_lets_the_blade_leap_no_further_than_a_few_degrees",),
        "the servo's set point runs on against a jam",
    ),
    Mutant(
        "F16-held",
        "graderd/core/gate.py",
        "        if former.held:\n",
        "        if False:\n",
        (GATE + "test_what_is_pushed_while_it_is_held_starts_from_where_it_is_now",),
        "an axis that was pushed while held goes back where it was",
    ),
    Mutant(
        "F16-late-tick",
        "graderd/core/gate.py",
        "    dt_s = min(inputs.dt_s, LONGEST_STEP_S)\n",
        "    dt_s = inputs.dt_s\n",
        (GATE + "test_a_late_tick_is_not_made_up_for",),
        "a late tick is made up for by a leap",
    ),
)


if __name__ == "__main__":
    sys.exit(command_line("python -m harness.claims", __doc__, CLAIMS))
