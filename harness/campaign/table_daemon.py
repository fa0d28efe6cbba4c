"""Faults of the daemon, its processes, its files and its clients."""

from __future__ import annotations

import asyncio
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from harness.campaign.conduct import BRAKE_S, EVERYTHING, SLACK_S, STILL_S, detect, react
from harness.campaign.model import Action, Case, Outcome, Phase
from harness.campaign.stack import CONFIG, CampaignError, Stack
from harness.campaign.table import heal

IDLE, TURNING, LIFTING = Phase.IDLE, Phase.TURNING, Phase.LIFTING
WATCHDOG_S = 0.2
FLOOD_MIN_N = 1000
"""Requests a second that count as a flood."""


async def nothing(_: Stack) -> None:
    """The cause is over by itself."""


def hook(**wanted: float) -> Action:
    """Let the daemon do it to itself."""

    async def inject(stack: Stack) -> None:
        stack.hook(**wanted)

    return inject


def freeze(for_s: float) -> Action:
    """The process gets no time for so long: a computer that swaps or is suspended."""

    async def inject(stack: Stack) -> None:
        stack.daemon.send_signal(signal.SIGSTOP)
        await asyncio.sleep(for_s)
        stack.daemon.send_signal(signal.SIGCONT)

    return inject


async def starve_worker(stack: Stack) -> None:
    """The kernel gives the perception child no more memory than it has, and what it has free is taken."""
    pid = stack.worker_pid()
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[0])
    resource.prlimit(pid, resource.RLIMIT_AS, (pages * resource.getpagesize(), resource.RLIM_INFINITY))
    os.kill(pid, signal.SIGUSR1)


async def feed_worker(stack: Stack) -> None:
    """There is memory again; a child that lived on what it had goes on."""
    with suppress(CampaignError, ProcessLookupError):
        resource.prlimit(stack.worker_pid(), resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


async def fill_disk(stack: Stack) -> None:
    """The system call that asks for free space says none."""
    stack.hook(disk_full=1)


async def empty_disk(stack: Stack) -> None:
    """There is room again."""
    stack.hook(disk_full=0)


async def lose_records(stack: Stack) -> None:
    """The recordings' folder is not there any more, and cannot be made."""
    records = stack.directory / "records"
    records.rename(stack.directory / "records.away")
    records.write_text("in the way", encoding="utf-8")


async def find_records(stack: Stack) -> None:
    """The folder is back."""
    records, away = stack.directory / "records", stack.directory / "records.away"
    if away.exists():
        records.unlink(missing_ok=True)
        away.rename(records)


def lie(text: str) -> Action:
    """What the perception child says instead of the truth."""

    async def inject(stack: Stack) -> None:
        partial = stack.directory / "lie.new"
        partial.write_text(text, encoding="utf-8")
        partial.rename(stack.directory / "lie.json")

    return inject


async def tell_truth(stack: Stack) -> None:
    """The child is honest again."""
    (stack.directory / "lie.json").unlink(missing_ok=True)


def loop(state: str) -> Action:
    """The stop input's loop."""

    async def inject(stack: Stack) -> None:
        await stack.ask_rig("stop_loop", state=state)

    return inject


async def cut_all(stack: Stack) -> None:
    """Both wires and the camera at once."""
    await stack.ask_rig("servo_fault", name="unplug", params={})
    await stack.ask_rig("actuator_fault", name="unplug", params={})
    await stack.ask_rig("camera_fault", name="unplug", params={})


# ---- conducts of their own -------------------------------------------------------------------------------------------


async def killed(stack: Stack, _: Case, __: Phase, outcome: Outcome) -> None:
    """SIGKILL, and the guard that systemd runs afterwards: the devices stop by themselves, then both wires are safe."""
    watch, from_s = stack.watch, time.monotonic()
    stack.daemon.send_signal(signal.SIGKILL)
    await stack.daemon.wait()
    outcome.detected, outcome.detection_s = True, time.monotonic() - from_s
    outcome.message = "systemd sees the process end and runs the guard"
    still = await watch.until_still(EVERYTHING, STILL_S, 3.0)
    outcome.standstill_s = watch.standstill_s(EVERYTHING, from_s)
    status = await stack.guard()
    await asyncio.sleep(0.2)
    state = watch.newest().state
    unsafe = [name for name in ("lift_left_enabled", "lift_right_enabled", "tilt_enabled") if state[name]]
    unsafe += ["servo_torque_enabled"] if state["servo_torque_enabled"] else []
    outcome.final_state = "both wires safe" if not unsafe and status == 0 else f"guard status {status}, {unsafe}"
    outcome.expected_state = "both wires safe"
    outcome.safe = still and outcome.final_state == outcome.expected_state
    if outcome.standstill_s > WATCHDOG_S + BRAKE_S + SLACK_S:
        outcome.problems.append(f"standstill after {outcome.standstill_s:.2f} s")
    await _started_again(stack, outcome)


async def _started_again(stack: Stack, outcome: Outcome, mode: str = "disarmed") -> None:
    """Nothing starts by itself; ``mode`` stopped: it ended by a stop, which outlives the restart."""
    await stack.start_daemon()
    outcome.recovered_as_catalogued = stack.status["mode"] == mode
    outcome.recovery = "restart, reset, arm" if mode == "stopped" else "restart, arm"


async def _terminated(stack: Stack, outcome: Outcome) -> None:
    """SIGTERM in the phase, as every stop of the service: motion ends, the process ends in order."""
    watch, from_s = stack.watch, time.monotonic()
    await stack.rest()
    stack.daemon.terminate()
    async with asyncio.timeout(6.0):
        status = await stack.daemon.wait()
    if not await watch.until_still(EVERYTHING, STILL_S, 3.0):
        outcome.problems.append("no standstill after SIGTERM")
    outcome.standstill_s = watch.standstill_s(EVERYTHING, from_s)
    outcome.safe = status == 0 and outcome.standstill_s <= BRAKE_S + SLACK_S
    if not outcome.safe:
        outcome.problems.append(f"SIGTERM: status {status}, standstill after {outcome.standstill_s:.2f} s")


async def corrupt_config(stack: Stack, _: Case, __: Phase, outcome: Outcome) -> None:
    """The configuration file is damaged when the service is started anew: it must refuse and say where."""
    await _terminated(stack, outcome)
    stack.new_log_errors()
    stack.config_path.write_text('[rotation]\nmax_deg = "sixty"\n[gate\n', encoding="utf-8")
    outcome.expected_state = "refused to start, status 2"
    from_s = time.monotonic()
    try:
        await stack.launch_daemon()
        async with asyncio.timeout(20.0):
            status = await stack.daemon.wait()
    finally:
        stack.config_path.write_text(CONFIG.format(directory=stack.directory), encoding="utf-8")
    said = stack.new_log_errors()
    outcome.final_state = f"refused to start, status {status}"
    outcome.detection_s = time.monotonic() - from_s
    outcome.message = said[0].replace(str(stack.directory), "") if said else ""
    outcome.detected = status == 2 and any(stack.config_path.name in line for line in said)
    await _started_again(stack, outcome, "stopped")  # SIGTERM at work is a stop


async def corrupt_state(stack: Stack, case: Case, _: Phase, outcome: Outcome) -> None:
    """The file with the last stop's reason is damaged: told, kept, and the machine stopped: it may have been."""
    await _terminated(stack, outcome)
    path = stack.directory / "state" / "last_stop.json"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b'{"reason": "\xff\x00')
    await stack.start_daemon()
    await detect(stack, case, outcome, time.monotonic())
    outcome.final_state, outcome.expected_state = stack.status["mode"], "stopped"
    await stack.command("reset")
    await stack.until_status(
        lambda s: not any(f["name"] in case.faults for f in s["faults"]), 3.0, "still told after the reset"
    )
    outcome.recovered_as_catalogued, outcome.recovery = True, "reset"


async def _moved_by_hand(stack: Stack, phase: Phase) -> None:
    """In every phase a client moves something, or holds its place."""
    if phase is TURNING:
        await stack.command("manual")
        await stack.watch.until_still(("rotation",), 0.2, 3.0)
    if phase is not LIFTING:
        here_deg = stack.watch.newest().state["blade_deg"]
        goal_deg = here_deg if phase is IDLE else (-30.0 if here_deg > 0 else 30.0)
        await stack.move("jog", axis="rotate", value=goal_deg)
        await asyncio.sleep(0.8)


async def client_gone(stack: Stack, _: Case, phase: Phase, outcome: Outcome) -> None:
    """The client that moves the blade ends, and its connection with it: so does what it asked for."""
    await _moved_by_hand(stack, phase)
    from_s = time.monotonic()
    await stack.rest()
    status = await stack.until_status(lambda s: not s["lease"], 1.0, "the lease of a client that is gone is still held")
    outcome.detected, outcome.detection_s = True, max(0.0, status["time_s"] - from_s)
    outcome.message = status["reason"]
    still = await stack.watch.until_still(EVERYTHING, STILL_S, 3.0)
    outcome.standstill_s, outcome.standstill_from = stack.watch.standstill_s(EVERYTHING, from_s), "injection"
    outcome.final_state, outcome.expected_state = stack.status["mode"], "manual"
    outcome.safe = still and outcome.standstill_s <= BRAKE_S + SLACK_S
    outcome.recovered_as_catalogued, outcome.recovery = outcome.final_state == "manual", "by itself"


async def lapse(stack: Stack, case: Case, phase: Phase, outcome: Outcome) -> None:
    """The client that moves the blade stands still with its connection open; nobody renews its lease."""
    await _moved_by_hand(stack, phase)
    from_s = time.monotonic()
    stack.fall_silent()
    await detect(stack, case, outcome, from_s)
    await stack.watch.until_still(EVERYTHING, STILL_S, 3.0)
    await react(stack, case, outcome, from_s, "manual")
    outcome.standstill_s, outcome.standstill_from = stack.watch.standstill_s(EVERYTHING, from_s), "injection"
    if outcome.standstill_s > 0.3 + BRAKE_S + SLACK_S:
        outcome.problems.append(f"standstill {outcome.standstill_s:.2f} s after the client's last word")
    await stack.until_status(
        lambda s: not any(f["name"] in case.faults for f in s["faults"]), 6.0, "the lapse is told for ever"
    )
    outcome.recovered_as_catalogued, outcome.recovery = True, "by itself"


async def _under_attack(stack: Stack, phase: Phase, outcome: Outcome, attack: Callable[[], Awaitable[str]]) -> None:
    """While a client misbehaves: mode and motion go on as before, and stop gets through at once."""
    before = "auto" if phase is TURNING else "manual"
    attacking = asyncio.ensure_future(attack())
    await asyncio.sleep(0.8)
    status = await stack.read_status()
    if status is not None and status["mode"] != before:
        outcome.problems.append(f"the mode became {status['mode']}: {status['reason']}")
    await stack.rest()
    asked_s = time.monotonic()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "stop"),
        env=os.environ | {"GRADERD_SOCKET": str(stack.directory / "graderd.sock")},
        stdout=asyncio.subprocess.DEVNULL,
    )
    stopped = await process.wait() == 0
    answered_s = time.monotonic()
    still = await stack.watch.until_still(EVERYTHING, STILL_S, 3.0)
    outcome.message = await attacking
    await stack.until_status(lambda s: s["mode"] == "stopped", 2.0, "the stop did not take")
    outcome.final_state = outcome.expected_state = "stopped"
    # The command line itself takes a good part of a second to start; the answer bounds when the stop was taken.
    outcome.standstill_s = max(0.0, stack.watch.standstill_s(EVERYTHING, answered_s))
    outcome.standstill_from = f"answer to 'graderd stop' ({answered_s - asked_s:.1f} s after its start)"
    outcome.safe = stopped and still and outcome.standstill_s <= BRAKE_S + SLACK_S
    await stack.command("reset")
    outcome.recovered_as_catalogued, outcome.recovery = True, "reset, arm"


async def flood(stack: Stack, _: Case, phase: Phase, outcome: Outcome) -> None:
    """Thousands of requests a second from a process of its own; stop must get through all the same."""

    async def attack() -> str:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "harness.campaign.flood", str(stack.directory / "graderd.sock"), "4.0"),
            stdout=asyncio.subprocess.PIPE,
        )
        said, _ = await process.communicate()
        found = json.loads(said.splitlines()[-1])
        if found["sent_per_s"] < FLOOD_MIN_N:
            outcome.problems.append(f"only {found['sent_per_s']:.0f} requests a second were sent")
        outcome.detected, outcome.detection_s = found["refused_after_s"] is not None, found["refused_after_s"]
        return f"{found['sent_per_s']:.0f} requests a second, refused what was too much"

    await _under_attack(stack, phase, outcome, attack)


GARBAGE = (
    b"\x00\xff\xfe" * 200 + b"\r\n\r\n",
    b"GET / HTTP/9.9\r\n\r\n",
    b"POST /v1/commands HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999\r\n\r\n{",
    b"POST /v1/commands HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
    b"POST /v1/commands HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nZZ\r\n",
    b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n",
    b"GET /v1/status HTTP/1.1\r\n" + b"X: y\r\n" * 5000 + b"\r\n",
    *(
        b"POST /v1/commands HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)
        for body in (
            b"", b"null", b"[]", b"{", b"{}" * 100, b'{"command": "arm", "extra": 1}', b'{"command": "nonsense"}',
            b'{"command": "jog", "axis": "rotate", "value": NaN}',
            b'{"command": "jog", "axis": "rotate", "value": 1e999}',
            b'{"command": "jog", "axis": "rotate"}', b'{"command": "jog", "axis": ["rotate"], "value": "5"}',
            b"[" * 10_000,
            b'{"command": "preset", "name": "%s"}' % (b"n" * 900),
            b"\xff\xfe\x00", b'{"command": "\\ud800"}',
        )
    ),
)  # fmt: skip


async def malformed(stack: Stack, _: Case, phase: Phase, outcome: Outcome) -> None:
    """Every kind of nonsense on the socket, over and over for two seconds; none of it may do anything."""

    async def attack() -> str:
        sent_n, began_s = 0, time.monotonic()
        end_s = began_s + 2.0
        while time.monotonic() < end_s:
            for garbage in GARBAGE:
                with suppress(OSError, TimeoutError):
                    reader, writer = await asyncio.open_unix_connection(str(stack.directory / "graderd.sock"))
                    writer.write(garbage)
                    async with asyncio.timeout(0.5):
                        answer = await reader.read(64)
                    if answer.startswith(b"HTTP/1.1 2"):
                        outcome.problems.append(f"accepted: {garbage[:60]!r}")
                    writer.close()
                    if not outcome.detected:
                        outcome.detected, outcome.detection_s = True, time.monotonic() - began_s
                sent_n += 1
        return f"{sent_n} malformed requests"

    await _under_attack(stack, phase, outcome, attack)


def _daemon(name: str, text: str, faults: str, inject: Action, repair: Action = nothing, **more: Any) -> Case:
    return Case(f"daemon_{name}", text, tuple(faults.split()), inject, repair, **more)


STALLED = "rotation.watchdog_tripped daemon.loop_blocked"
DAEMON = (
    _daemon("killed", "SIGKILL; systemd runs the guard", "", nothing, conduct=killed, short=(TURNING,)),
    _daemon("frozen", "the process gets no time for 1 s (SIGSTOP)", STALLED, freeze(1.0), detect_s=1.8,
            stand_s=WATCHDOG_S + BRAKE_S, short=(TURNING,)),
    _daemon("blocked", "the event loop is blocked for 1 s", STALLED, hook(block_s=1.0), detect_s=1.8,
            stand_s=WATCHDOG_S + BRAKE_S, short=(TURNING, LIFTING)),
    _daemon("overrun", "the process gets no time for 0.1 s (SIGSTOP)", "daemon.tick_overrun daemon.loop_blocked",
            freeze(0.1), either=True),
    _daemon("memory", "200 MB more are used", "daemon.memory_high", hook(memory_mb=200), hook(memory_mb=0),
            detect_s=6.8),
    _daemon("disk_full", "no space left on device", "daemon.disk_full", fill_disk, empty_disk, detect_s=1.4,
            short=(LIFTING,)),
    _daemon("records_gone", "the recordings' folder is gone", "daemon.recorder_failed", lose_records, find_records,
            detect_s=1.4),
    _daemon("clock_forward", "the wall clock is set 1 h ahead", "daemon.clock_stepped", hook(clock_step_s=3600.0),
            detect_s=1.6, recover_s=14.0),
    _daemon("clock_back", "the wall clock is set 1 h back", "daemon.clock_stepped", hook(clock_step_s=-3600.0),
            detect_s=1.6, recover_s=14.0),
    _daemon("suspended", "the computer sleeps for 1 h", "daemon.suspended", hook(slept_s=3600.0)),
    _daemon("config_corrupt", "the configuration is damaged at the next start", "", nothing, conduct=corrupt_config),
    _daemon("state_corrupt", "the state file is damaged at the next start", "daemon.state_file_corrupt", nothing,
            conduct=corrupt_state, short=(IDLE,)),
    _daemon("client_dead", "the client that moves the blade ends", "", nothing, conduct=client_gone,
            short=(LIFTING,)),
    _daemon("client_frozen", "the client that moves the blade stands still", "daemon.lease_lapsed", nothing,
            conduct=lapse, short=(TURNING, LIFTING)),
    _daemon("flooded", "thousands of API requests a second", "", nothing, conduct=flood, short=(TURNING,)),
    _daemon("malformed", "malformed API requests", "", nothing, conduct=malformed),
    _daemon("stop_pressed", "the stop loop opens", "stop_input.open", loop("open"), loop("closed"), detect_s=0.3,
            short=(LIFTING,)),
    _daemon("stop_unplugged", "the stop input's adapter is pulled", "stop_input.lost", loop("gone"), loop("closed"),
            detect_s=0.3),
    _daemon("stop_silent", "the stop input's adapter hangs", "stop_input.lost stop_input.stale", loop("silent"),
            loop("closed"), detect_s=1.3),
    _daemon("all_wires_cut", "servo, CAN adapter and camera unplugged together",
            "rotation.unplugged can.unplugged", cut_all, heal),
)  # fmt: skip
PERCEPTION = (
    Case("perception_garbage", "the child sends what is no observation", ("daemon.perception_nonsense",),
         lie('{"line": "{\\"kind\\": \\"observed\\", \\"observation\\": {}}"}'), tell_truth, short=(TURNING,)),
    Case("perception_future", "pictures from the future", ("daemon.perception_nonsense",),
         lie('{"fields": {"capture_s": 1e9}}'), tell_truth),
    Case("perception_overconfident", "a confidence of 1e6", ("daemon.perception_nonsense",),
         lie('{"fields": {"confidence": 1e6}}'), tell_truth),
    Case("perception_out_of_memory", "the child gets no more memory",
         ("camera.stale", "camera.worker_restarted", "camera.worker_hung"), starve_worker, feed_worker,
         detect_s=2.5,
         log_errors=("",)),
)  # fmt: skip
"""A child without memory ends with whatever its libraries say on standard error; those lines belong to the fault."""
