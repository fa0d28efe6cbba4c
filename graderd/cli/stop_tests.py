"""The stop, tested three ways on the machine itself, each in the middle of a turn of the blade.

Three, because the safety concept (docs/integrators/safety.md) rests on three ways that share nothing: a *command* over
the interface (F1; how every program and page stops it), the *switch* that a person's hand reaches (the stop input, or
the emergency stop that cuts the power; needs no client and no network), and the *death of the daemon* (F5 to F7; what
is left when the computer has failed: the servo's own watchdog).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from typing import Any, Final

from graderd.cli.asking import agree, agreed
from graderd.cli.console import CliError, print_text
from graderd.cli.setup_daemon import SetupDaemon
from graderd.client import Client, LeaseLostError, RefusedError

ARM_S: Final = 60.0
REACH_DEG: Final = 25.0
SWING_DEG: Final = 6.0
UNDER_WAY_DEG: Final = 3.0
PATIENCE_S: Final = 60.0
STILL_S: Final = 0.3
STILL_DEG: Final = 0.2
STATUS_HZ: Final = 50.0
MOST_S: Final = 1.0
SPARE_S: Final = 0.25
SPARE_DEG: Final = 2.0
DEAD_S: Final = 1.5
"""After a daemon's death, the longest that an intact machine moves (0.2 s of watchdog and its braking), twice over."""


@dataclass(frozen=True, slots=True)
class Stopped:
    """How one stop came out. ``further_deg``: from the cause to rest; ``stood_after_s`` likewise, None where nobody was
    there to read it; ``reason``: the machine's own words."""

    way: str
    shows: str
    further_deg: float
    most_deg: float
    stood_after_s: float | None
    reason: str


def tested_stops(daemon: SetupDaemon, rotation: dict[str, Any], stop_input: str) -> list[dict[str, Any]]:
    """All three, one after the other, each after a consent. ``rotation``: its section; ``stop_input``: its backend.

    Raises:
        CliError: no consent, or a stop that is none: the machine must not be used.
    """
    print_text(
        "The blade will turn. Stand where you see its whole reach, with a hand on the emergency stop. Each of the "
        "three tests asks first."
    )
    tests: tuple[Callable[[SetupDaemon, dict[str, Any]], Stopped], ...] = (
        _by_command,
        lambda of, its: _by_switch(of, its, stop_input),
        _by_death,
    )
    found = []
    for test in tests:
        stopped = test(daemon, rotation)
        stood = "" if stopped.stood_after_s is None else f" and stood after {stopped.stood_after_s:.2f} s"
        print_text(
            f"  {stopped.way}: it turned {stopped.further_deg:.1f} deg further ({stopped.most_deg:.1f} at most){stood}"
        )
        if stopped.further_deg > stopped.most_deg or (stopped.stood_after_s or 0.0) > MOST_S:
            cause = "the blade does not stop as it must; do not use this machine"
            raise CliError(f"stop.{stopped.way}", cause, "see docs/integrators/safety.md")
        found.append({name: _rounded(value) for name, value in asdict(stopped).items()})
    return found


def arm(client: Client) -> None:
    """Into manual mode, once everything needed is met.

    Raises:
        CliError: it is not within ``ARM_S``.
    """
    give_up_s = time.monotonic() + ARM_S
    while True:
        status = client.get("/v1/status")
        if status["mode"] == "manual":
            return
        unmet = [need for need in status["readiness"] if need["mandatory"] and not need["met"]]
        if status["mode"] == "stopped":
            raise CliError("arm", f"the machine is stopped: {status['reason']}", "Do it again when the cause is gone")
        if not status["arming"] and not unmet and status["readiness"]:
            with suppress(RefusedError):  # one reading was not fresh just then; told below where it stays so
                client.command("arm")
        if time.monotonic() > give_up_s:
            why = "; ".join(f"{need['name']}: {need['reason']}. {need['remedy']}" for need in unmet)
            raise CliError("arm", why or status["reason"], "see graderd doctor")
        time.sleep(0.1)


def _by_command(daemon: SetupDaemon, rotation: dict[str, Any]) -> Stopped:
    client = daemon.client
    goal_deg = _goal_deg(client, rotation, +1.0)
    agree("stop.command", f"1 of 3: the blade turns to {goal_deg:+.0f} deg and is stopped by a command. Is it clear?")
    with _in_mid_turn(client, goal_deg) as at_deg:
        at_s = time.monotonic()
        client.stop("test of the stop at commissioning")
        rest_deg, rest_s = rest(client)
    stopped = client.get("/v1/status")
    _must_be_latched(client, stopped)
    client.reset()
    return Stopped(
        "command", "F1", abs(rest_deg - at_deg), _most_deg(rotation, SPARE_S), rest_s - at_s, stopped["last_stop"]
    )


def _by_switch(daemon: SetupDaemon, rotation: dict[str, Any], stop_input: str) -> Stopped:
    client = daemon.client
    what = "the emergency stop that cuts the power" if stop_input == "none" else "the stop input's button"
    here_deg = _angle_deg(client.get("/v1/status"))
    here_deg = min(max(here_deg, rotation["min_deg"] + SWING_DEG + 1.0), rotation["max_deg"] - SWING_DEG - 1.0)
    agree(
        "stop.switch", f"2 of 3: the blade turns to and fro by {SWING_DEG:g} deg until you press {what}. Is it clear?"
    )
    arm(client)
    print_text(f"PRESS {what.upper()} NOW")
    last_deg = _swing(client, here_deg)
    at_s = time.monotonic()
    status = client.get("/v1/status")
    if status["mode"] not in ("stopped", "disarmed"):
        raise CliError("stop.switch", f"the blade was held, but not stopped: {status['reason']}", "See graderd status")
    if stop_input != "none":
        names = [fault["name"] for fault in status["faults"]]
        if status["mode"] != "stopped" or not any(name.startswith("stop_input.") for name in names):
            cause = f"something else ended it: {status['reason']}"
            raise CliError("stop.switch", cause, "See graderd status, then do it again")
        _must_be_latched(client, status)
    reason = status["last_stop"] or status["reason"]
    rest_deg, rest_s = rest(client)
    print_text("Stopped. Release it, and give the power back if it was cut")
    _released(client)
    return Stopped(
        "switch",
        "F1, stop input" if stop_input != "none" else "emergency stop, F9",
        abs(rest_deg - last_deg),
        _most_deg(rotation, SPARE_S),
        rest_s - at_s if stop_input != "none" else None,
        reason,
    )


def _by_death(daemon: SetupDaemon, rotation: dict[str, Any]) -> Stopped:
    client = daemon.client
    goal_deg = _goal_deg(client, rotation, -1.0)
    question = f"3 of 3: the blade turns to {goal_deg:+.0f} deg, and the daemon is killed on the way. Is it clear?"
    agree("stop.death", question)
    with _in_mid_turn(client, goal_deg) as at_deg:
        daemon.kill()
    time.sleep(DEAD_S)
    if not agreed("stop.death.stands", "The daemon is dead. Does the blade stand still?"):
        raise CliError("stop.death", "the blade turns on without a daemon", "Cut its power; do not use this machine")
    client = daemon.restart()  # a stop at its start is judged below with the rest
    rest_deg, _ = rest(client)
    status = client.get("/v1/status")
    if status["mode"] not in ("disarmed", "stopped"):
        raise CliError("stop.death", f"a new daemon begins {status['mode']}", "Do not use this machine")
    tripped = [fault["reads"] for fault in status["faults"] if fault["name"] == "rotation.watchdog_tripped"]
    if not tripped and "watchdog_s" in rotation:
        cause = "the servo's watchdog did not trip: something else ended the turn"
        raise CliError("stop.death", cause, "See 'graderd profile verify rotation'")
    most_deg = _most_deg(rotation, SPARE_S + float(rotation.get("watchdog_s", 0.0)))
    return Stopped("death", "F5", abs(rest_deg - at_deg), most_deg, None, tripped[0] if tripped else status["reason"])


@contextmanager
def _in_mid_turn(client: Client, goal_deg: float) -> Iterator[float]:
    """The blade turns there and is well under way: the angle at that moment. The lease is kept meanwhile."""
    arm(client)
    with client.lease("stop test", rate_hz=STATUS_HZ) as lease:
        lease.jog("rotate", goal_deg)
        began_deg = at_deg = _angle_deg(client.get("/v1/status"))
        for status in lease.raw_statuses():
            at_deg = _angle_deg(status)
            if abs(at_deg - began_deg) >= UNDER_WAY_DEG:
                break
        yield at_deg


def _swing(client: Client, here_deg: float) -> float:
    """To and fro until something ends it; the last angle before.

    Raises:
        CliError: nothing did.
    """
    give_up_s, last_deg = time.monotonic() + PATIENCE_S, here_deg
    with client.lease("stop test", rate_hz=STATUS_HZ) as lease:
        try:
            for leg in range(1000):
                lease.jog("rotate", here_deg + (SWING_DEG if leg % 2 == 0 else -SWING_DEG))
                for status in lease.raw_statuses():
                    if status["mode"] != "manual":
                        return last_deg
                    last_deg = _angle_deg(status)
                    if status["axes"]["rotation"]["arrived"] and not status["axes"]["rotation"]["moving"]:
                        break
                    if time.monotonic() > give_up_s:
                        cause = f"nothing ended the turning within {PATIENCE_S:g} s"
                        raise CliError("stop.switch", cause, "Look at the wiring of the stop; then do it again")
        except (LeaseLostError, RefusedError):
            return last_deg
    return last_deg


def _must_be_latched(client: Client, status: dict[str, Any]) -> None:
    """Stopped, and arming is refused.

    Raises:
        CliError: it is not.
    """
    try:
        client.command("arm")
    except RefusedError:
        if status["mode"] == "stopped":
            return
    raise CliError("stop", f"a stop does not latch: {status['mode']}, {status['reason']}", "Do not use this machine")


def _released(client: Client) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        status = client.get("/v1/status")
        pressed = any(fault["name"].startswith("stop_input.") and fault["present"] for fault in status["faults"])
        if not pressed and status["axes"]["rotation"]["measured"] is not None:
            if status["mode"] == "stopped":
                client.reset()
            return
        if time.monotonic() > give_up_s:
            raise CliError("stop.switch", f"it stays pressed: {status['reason']}", "Look at the loop; do it again")
        time.sleep(0.1)


def _goal_deg(client: Client, rotation: Mapping[str, float], way: float) -> float:
    """A goal that is far enough away for a stop under way, and well inside the limits."""
    here_deg = _angle_deg(client.get("/v1/status"))
    low_deg, high_deg = rotation["min_deg"] + 2.0, rotation["max_deg"] - 2.0
    goals = [min(max(here_deg + side * REACH_DEG, low_deg), high_deg) for side in (way, -way)]
    return next((goal for goal in goals if abs(goal - here_deg) >= REACH_DEG / 2.0), goals[0])


def _most_deg(rotation: dict[str, Any], unheard_s: float) -> float:
    """What an intact machine turns at most: at full speed for so long, and its way of braking."""
    speed, acceleration = rotation["speed_deg_per_s"], rotation["acceleration_deg_per_s2"]
    return float(speed * unheard_s + speed**2 / (2.0 * acceleration) + SPARE_DEG)


def rest(client: Client) -> tuple[float, float]:
    """The angle at rest, and since when (monotonic).

    Raises:
        CliError: it does not come to rest, or the angle is not known.
    """
    give_up_s = time.monotonic() + PATIENCE_S
    rest_deg, since_s = math.nan, time.monotonic()
    while True:
        angle_deg, now_s = _angle_deg(client.get("/v1/status"), or_nan=True), time.monotonic()
        if not abs(angle_deg - rest_deg) <= STILL_DEG:
            rest_deg, since_s = angle_deg, now_s
        elif now_s - since_s >= STILL_S:
            return rest_deg, since_s
        if now_s > give_up_s:
            raise CliError("stop", "the blade does not come to rest, or its angle is not known", "Cut its power")
        time.sleep(1.0 / STATUS_HZ)


def _angle_deg(status: dict[str, Any], *, or_nan: bool = False) -> float:
    measured = status["axes"]["rotation"]["measured"]
    if measured is None and not or_nan:
        raise CliError("stop", "the blade's angle is not known", "see graderd status")
    return math.nan if measured is None else float(measured)


def _rounded(value: Any) -> Any:
    return round(value, 2) if isinstance(value, float) else value
