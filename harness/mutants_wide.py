"""``python -m harness.mutants_wide``: thirty mistakes seeded in runtime, drivers and interface, and who notices them.

Each is a change that somebody could make and that would matter: a hold, a latch, a time limit, an order, a right. It is
made in a copy of the tree, where the tests nearest to it run. One that they pass is a survivor: a test is missing. What
they fail on stands beside it. First all those tests run without any change: what fails by itself notices nothing.

Exit status: 0 all noticed, 1 a survivor, 2 the list does not fit the tree (a text that is not there, or more than once;
a test that fails without a change). docs/developers/mutation.md has the table with its last results.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
TIMEOUT_S: Final = 600.0
"""The slowest of the tests takes some seconds; a change may make one wait for ever, which is noticed too."""
ONE_FAILED: Final = 1
"""pytest's exit status where tests ran and at least one failed."""
TOO_LONG: Final = 124
"""As timeout(1) says it."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One mistake: ``old`` stands exactly once in ``file``; ``why`` says what it would do to the machine."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    why: str


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
        "        while self._queue:\n",
        "        while self._queue and not command.reason:\n",
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
        "is not Mode.DISARMED:",
        "is Mode.AUTO:",
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
        "graderd/api/tcp_guard.py",
        "path.stat().st_mode & 0o077",
        "path.stat().st_mode & 0o007",
        (TCP + "test_a_token_that_the_group_may_read_is_none",),
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


@dataclass(frozen=True, slots=True)
class Result:
    """``verdict``: killed, survived, or why there is none; ``by``: the first test that failed."""

    mutant: Mutant
    verdict: str
    by: str = ""
    seconds: float = 0.0


def misfit(mutant: Mutant, root: Path = ROOT) -> str:
    """Why the mutant cannot be made in this tree; empty where it can."""
    path = root / mutant.file
    if not path.is_file():
        return "its file is not there"
    found_n = path.read_text(encoding="utf-8").count(mutant.old)
    if found_n != 1:
        return f"its text stands {found_n} times in the file, not once"
    missing = [test for test in mutant.tests if not _has_test(root, test)]
    return f"there is no {missing[0]}" if missing else ""


def _has_test(root: Path, node: str) -> bool:
    file, _, name = node.partition("::")
    if not (root / file).is_file():
        return False
    function = name.rpartition("::")[2].partition("[")[0]
    return not function or f"def {function}(" in (root / file).read_text(encoding="utf-8")


def copy_tree(target: Path, root: Path = ROOT) -> None:
    """What git knows or would take, with links as links; a mutant never touches the tree that people work in."""
    command = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, capture_output=True, check=True).stdout.decode().split("\0")
    for name in filter(None, listed):
        source, to = root / name, target / name
        if not os.path.lexists(source):
            continue  # taken away, and git not told yet
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, to, follow_symlinks=False)


def run_tests(tree: Path, tests: Sequence[str], *, first_only: bool) -> tuple[int, list[str], str]:
    """pytest's exit status (:data:`TOO_LONG` where it was ended), the tests that failed, and the end of its text."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *tests]
    if first_only:
        command.insert(4, "-x")
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return TOO_LONG, [], f"not done within {TIMEOUT_S:g} s"
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return done.returncode, failed, (done.stdout + done.stderr)[-2000:]


def imported_from(tree: Path) -> Path:
    """Where a process in the copy gets the product from: a mutant that nobody imports survives for nothing."""
    command = [sys.executable, "-P", "-c", "import graderd.api.server; print(graderd.api.server.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=True)
    return Path(done.stdout.strip()).resolve()


def try_mutant(tree: Path, mutant: Mutant) -> Result:
    """Make the mutant in the copy, run its tests, and put the copy back."""
    path, started_s = tree / mutant.file, time.monotonic()
    text = path.read_text(encoding="utf-8")
    changed = text.replace(mutant.old, mutant.new)
    compile(changed, mutant.file, "exec")  # one that is no Python is noticed by everything
    path.write_text(changed, encoding="utf-8")
    try:
        status, failed, said = run_tests(tree, mutant.tests, first_only=True)
    finally:
        path.write_text(text, encoding="utf-8")
    seconds = time.monotonic() - started_s
    if status == 0:
        return Result(mutant, "survived", "", seconds)
    if status == TOO_LONG:
        return Result(mutant, "killed", said, seconds)
    if status == ONE_FAILED and failed:
        return Result(mutant, "killed", failed[0].rpartition("::")[2], seconds)
    return Result(mutant, f"pytest ended with {status}: {said[-300:]}", "", seconds)


def run(mutants: Sequence[Mutant], tell: bool) -> list[Result]:
    """All of them, one after the other, in one copy."""
    results = [Result(mutant, f"does not fit: {why}") for mutant in mutants if (why := misfit(mutant))]
    fitting = [mutant for mutant in mutants if not misfit(mutant)]
    with tempfile.TemporaryDirectory(prefix="graderd-mutants-") as folder:
        tree = Path(folder).resolve()
        copy_tree(tree)
        if not imported_from(tree).is_relative_to(tree):
            raise SystemExit(f"the copy in {tree} is not what its tests import: {imported_from(tree)}")
        tests = sorted({test for mutant in fitting for test in mutant.tests})
        _, broken, said = run_tests(tree, tests, first_only=False) if tests else (0, [], "")
        # A deadline missed on a busy machine is no verdict: what failed once is run again, alone.
        again = broken and run_tests(tree, broken, first_only=False)
        still = again[1] if again else []
        if tell and still:
            print(said, file=sys.stderr)
        for mutant in fitting:
            own = [test for test in still if any(test.startswith(nearest) for nearest in mutant.tests)]
            result = Result(mutant, f"fails without a change: {own[0]}") if own else try_mutant(tree, mutant)
            results.append(result)
            if tell:
                print(f"{result.verdict:<10} {mutant.name:<24} {result.seconds:6.1f} s  {result.by}", flush=True)
    return sorted(results, key=lambda result: MUTANTS.index(result.mutant))


def table(results: Sequence[Result]) -> str:
    """The results as the page has them."""
    lines = ["| mutant | file | what it would do | verdict | noticed by |", "|---|---|---|---|---|"]
    lines += [f"| {r.mutant.name} | `{r.mutant.file}` | {r.mutant.why} | {r.verdict} | `{r.by}` |" for r in results]
    return "\n".join(lines)


def main() -> int:
    """See the module's text."""
    parser = argparse.ArgumentParser(prog="python -m harness.mutants_wide", description=__doc__)
    parser.add_argument("names", nargs="*", help="only these mutants")
    parser.add_argument("--fits", action="store_true", help="only say which of them no longer fit the tree")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--table", action="store_true", help="print the page's table at the end")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - {mutant.name for mutant in MUTANTS}
    if unknown:
        parser.error(f"no such mutant: {', '.join(sorted(unknown))}")
    chosen = [mutant for mutant in MUTANTS if not arguments.names or mutant.name in arguments.names]
    if arguments.fits:
        results = [Result(mutant, f"does not fit: {why}") for mutant in chosen if (why := misfit(mutant))]
    else:
        results = run(chosen, tell=not arguments.json)
    unfit = [result for result in results if result.verdict not in ("killed", "survived")]
    survived = [result for result in results if result.verdict == "survived"]
    if arguments.json:
        found = [{"name": r.mutant.name, "verdict": r.verdict, "by": r.by} for r in results]
        print(json.dumps({"mutants": found, "survived": len(survived), "unfit": len(unfit)}))
    else:
        if arguments.table:
            print(table(results))
        for result in unfit:
            print(f"{result.mutant.name}: {result.verdict}", file=sys.stderr)
        print(f"{len(results)} mutants: {len(survived)} survived, {len(unfit)} without a verdict")
    return 2 if unfit else 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
