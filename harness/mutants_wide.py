"""``python -m harness.mutants_wide``: thirty mistakes seeded in runtime, drivers and interface, and who notices them.

Each is a change that somebody could make and that would matter: a hold, a latch, a time limit, an order, a right. How
they are tried, and what the exit status says: ``harness/seeded.py``. docs/developers/mutation.md has the table with its
last results.
"""

from __future__ import annotations

import sys
from typing import Final

from harness.seeded import Mutant, command_line

CONTROL: Final = "tests/unit/test_runtime_control.py::"
STOP_INPUT: Final = "tests/unit/test_stop_input.py::"
PORT: Final = "tests/unit/test_runtime_port.py::"
ELECTRAK: Final = "tests/fault/test_electrak_faults.py::"
PARTS: Final = "tests/unit/test_electrak_parts.py::"
TCP: Final = "tests/unit/test_api_tcp.py::"
SOCKETS: Final = "tests/unit/test_api_sockets.py::"
HTTP: Final = "tests/unit/test_api_http.py::"

RUNTIME: Final = (
    Mutant(
        "stop-keeps-queue",
        "graderd/runtime/control.py",
        "        while self._queue:\n            queued =",
        "        while self._queue and not command.reason:\n            queued =",
        (CONTROL + "test_what_was_asked_before_a_stop_is_void",),
        "what was asked before a stop is carried out after it",
    ),
    Mutant(
        "hold-gives-up",
        "graderd/runtime/devices.py",
        "                failed.append(name)\n        return",
        "                failed.append(name)\n                break\n        return",
        (CONTROL + "test_one_driver_that_fails_to_hold_does_not_keep_the_others_from_it",),
        "one broken driver leaves the other axes moving at a stop",
    ),
    Mutant(
        "stray-power",
        "graderd/runtime/devices.py",
        "stray = not power and any(",
        "stray = power and any(",
        (CONTROL + "test_a_device_that_is_active_while_it_should_not_be_is_disarmed",),
        "a device that is active in a disarmed machine keeps its power",
    ),
    Mutant(
        "refused-goal-goes-on",
        "graderd/runtime/control.py",
        "            self._refused[axis] = str(error)\n            self._devices.all()[axis].hold()\n",
        "            self._refused[axis] = str(error)\n",
        (CONTROL + "test_a_refused_goal_ends_the_former_one_in_the_same_tick",),
        "an axis whose driver refuses a goal goes on to the former one for a tick",
    ),
    Mutant(
        "stop-decides-first",
        "graderd/runtime/control.py",
        "        self._hold_all()\n        reply = self._step((command,))[0]\n",
        "        reply = self._step((command,))[0]\n",
        (CONTROL + "test_a_stop_is_on_every_wire_before_anything_else_is_asked",),
        "a mistake in what decides stands between the stop button and the wires",
    ),
    Mutant(
        "lost-stop-input",
        "graderd/runtime/stop_input.py",
        '                self._say(loop, "lost", str(error))\n',
        "",
        (STOP_INPUT + "test_a_lost_loop_is_told_and_found_again",),
        "a pulled stop button stops nothing",
    ),
    Mutant(
        "old-frame-decides",
        "graderd/runtime/perception_supervisor.py",
        "return self._newest.as_of(now_s, self._start.perception.decision.max_frame_age_s)",
        "return self._newest",
        ("tests/fault/test_perception_supervisor.py::test_a_frame_that_has_grown_old_decides_nothing",),
        "the blade turns to what a frame of half a second ago showed",
    ),
    Mutant(
        "service-while-armed",
        "graderd/runtime/port.py",
        "is not Mode.DISARMED or",
        "is Mode.AUTO or",
        (PORT + "test_what_moves_or_unpowers_needs_consent_and_a_disarmed_machine",),
        "the servo is rebooted under a load in manual",
    ),
    Mutant(
        "guard-takes-the-file",
        "graderd/runtime/app/guard.py",
        "if last is not None and (config is None or is_of(last, config_path)):",
        "if last is not None and config is None:",
        ("tests/unit/test_guard_config.py::test_the_wires_in_use_count_not_the_ones_written_since",),
        "after a crash the guard stops the wires of a file changed meanwhile, not those that move",
    ),
    Mutant(
        "maneuver-after-stop",
        "graderd/runtime/maneuver.py",
        "        if state.mode is not Mode.MANUAL:\n            raise DeviceLostError",
        "        if state.mode is Mode.DISARMED:\n            raise DeviceLostError",
        ("tests/unit/test_runtime_maneuver.py::test_stop_ends_it_under_way",),
        "a maneuver goes on asking for motion after a stop, and reports a result",
    ),
)

DRIVERS: Final = (
    Mutant(
        "target-never-expires",
        "drivers/electrak/actuator.py",
        "now_s - self._target_at_s > self.settings.target_timeout_s",
        "now_s - self._target_at_s > 100.0 * self.settings.target_timeout_s",
        ("tests/contract/test_electrak_actuator.py::test_a_target_that_is_not_renewed_is_counted_once",),
        "a lift goes on to the target of a control loop that is dead",
    ),
    Mutant(
        "long-look-ahead",
        "drivers/electrak/planner.py",
        "LOOK_AHEAD_S: Final = 0.3\n",
        "LOOK_AHEAD_S: Final = 0.6\n",
        (PARTS + "test_no_message_aims_further_than_the_look_ahead",),
        "when the daemon dies an actuator goes on twice as far",
    ),
    Mutant(
        "hold-waits",
        "drivers/electrak/actuator.py",
        "        self._planner.hold()\n        if self._sent_enabled:\n            self._link.send_control(self)\n",
        "        self._planner.hold()\n",
        (ELECTRAK + "test_hold_leaves_at_once_and_targets_never_jump_on_arming",),
        "a stop reaches the actuators up to 100 ms late",
    ),
    Mutant(
        "overload-at-rest",
        "drivers/electrak/thermal.py",
        "if not moving_allowed or self._left_n == 0:",
        "if self._left_n == 0:",
        (PARTS + "test_an_overload_while_nothing_was_commanded_latches_at_once",),
        "an overload that nobody commanded is retried instead of latched",
    ),
    Mutant(
        "short-veto-time",
        "drivers/j1939/claim.py",
        "VETO_S: Final = 0.25\n",
        "VETO_S: Final = 0.025\n",
        ("tests/unit/test_j1939_claim.py::test_it_asks_who_is_there_then_claims_and_waits_250_ms",),
        "graderd sends from an address that another node may hold",
    ),
    Mutant(
        "stop-switch-once",
        "drivers/j1939/stop_message.py",
        "if changed or now_s - self._told_s[source] >= REPEAT_S:",
        "if changed:",
        ("tests/fault/test_j1939_bus.py::test_a_switch_that_goes_on_saying_stop_stops_again",),
        "a machine armed anew under a pressed ISO 11783 stop switch stays armed",
    ),
    Mutant(
        "foreign-reply",
        "drivers/dynamixel/bus.py",
        "        elif packet.packet_id != self._wanted_id:\n",
        "        elif packet.packet_id > 252:\n",
        ("tests/wire/test_dynamixel_bus.py::test_another_servos_reply_is_not_ours",),
        "another servo's position is taken for the blade's",
    ),
    Mutant(
        "goal-never-expires",
        "drivers/dynamixel/servo_task.py",
        "now_s - self._goal_s > self._settings.goal_timeout_s",
        "now_s - self._goal_s > 100.0 * self._settings.goal_timeout_s",
        ("tests/contract/test_dynamixel_rotator.py::TestPh54OverFourTransports::test_a_goal_not_renewed_is_counted",),
        "the blade goes on to the goal of a control loop that is dead",
    ),
    Mutant(
        "late-watchdog",
        "drivers/dynamixel/arming.py",
        "math.floor(settings.watchdog_s / WATCHDOG_STEP_S + 1e-9) - 1))",
        "math.floor(settings.watchdog_s / WATCHDOG_STEP_S + 1e-9)))",
        ("tests/unit/test_dynamixel_calibration.py::test_the_watchdog_leaves_time_to_brake",),
        "a killed daemon's blade stands later than the configured time",
    ),
    Mutant(
        "arms-in-motion",
        "drivers/dynamixel/arming.py",
        "    if abs(speed) > _STILL_DEG_PER_S:\n",
        "    if speed > 20.0 * _STILL_DEG_PER_S:\n",
        ("tests/fault/test_dynamixel_presence.py::test_arming_is_refused_outside_the_limits_and_in_motion",),
        "a blade that somebody is turning by hand gets its torque",
    ),
    Mutant(
        "endless-back-off",
        "drivers/dynamixel/servo_task.py",
        "pause_s = min(_RECONNECT_MOST_S, 2 * pause_s)",
        "pause_s = 2 * pause_s",
        ("tests/fault/test_dynamixel_presence.py::test_the_pause_between_two_looks_for_a_lost_servo_is_bounded",),
        "a servo that was away for a minute is found again a minute late",
    ),
    Mutant(
        "safe-off-once",
        "drivers/electrak/safe_off.py",
        "REPEATS_N: Final = 4\n",
        "REPEATS_N: Final = 1\n",
        (
            "tests/unit/test_electrak_parts.py::test_the_last_words_are_said_again_to_whom_a_full_queue_kept_from_hearing",
        ),
        "after a crash one full queue leaves an actuator on its way",
    ),
)

API: Final = (
    Mutant(
        "any-origin",
        "graderd/api/tcp_guard.py",
        "if origin is not None and _text(origin).lower() not in self._origins:",
        "if origin is not None and not _text(origin):",
        (TCP + "test_who_may_come_in",),
        "a page of another site may command the machine through the operator's browser",
    ),
    Mutant(
        "token-for-the-group",
        "graderd/tokens.py",
        "st_mode & 0o077",
        "st_mode & 0o007",
        ("tests/unit/test_tokens.py::test_a_file_that_others_may_use_is_refused",),
        "everybody in the file's group has the token",
    ),
    Mutant(
        "token-in-any-address",
        "graderd/api/tcp_guard.py",
        'if headers.get(b"upgrade", b"").lower() == b"websocket":',
        'if headers.get(b"upgrade", b"") != b"none":',
        (TCP + "test_a_token_in_the_query_of_a_plain_request_is_none",),
        "links with the token in them work, and lie in histories and logs",
    ),
    Mutant(
        "removes-a-file",
        "graderd/api/server.py",
        "    if not stat.S_ISSOCK(kind):\n",
        "    if stat.S_ISDIR(kind):\n",
        (HTTP + "test_what_is_no_socket_of_ours_is_left_alone",),
        "a wrong api.socket deletes somebody's file, as root",
    ),
    Mutant(
        "preset-keeps-lease",
        "graderd/api/sockets.py",
        "if isinstance(command, Jog | Preset):",
        "if isinstance(command, Jog):",
        (SOCKETS + "test_the_lease_of_a_preset_is_given_back_when_the_client_goes",),
        "a preset goes on, for the rest of its lease, after its client has gone",
    ),
    Mutant(
        "steal-a-lease",
        "graderd/api/sockets.py",
        '.model_copy(update={"client": self._client})',
        "",
        (SOCKETS + "test_nobody_keeps_somebody_elses_lease",),
        "one client renews another's jog, whose operator has let go",
    ),
    Mutant(
        "waits-for-ever",
        "graderd/api/http_routes.py",
        "asyncio.timeout(limits.command_timeout_s)",
        "asyncio.timeout(100.0 * limits.command_timeout_s)",
        (HTTP + "test_a_tick_that_does_not_answer_is_reported",),
        "nobody is told that the control tick hangs and the emergency stop is due",
    ),
    Mutant(
        "newest-makes-room",
        "graderd/api/server.py",
        "oldest, _ = open_connections.popitem(last=False)",
        "oldest, _ = open_connections.popitem(last=True)",
        (HTTP + "test_the_oldest_connection_makes_room_for_a_new_one",),
        "idle connections keep out whoever wants to stop the machine",
    ),
)

MUTANTS: Final = (*RUNTIME, *DRIVERS, *API)


if __name__ == "__main__":
    sys.exit(command_line("python -m harness.mutants_wide", __doc__, MUTANTS))
