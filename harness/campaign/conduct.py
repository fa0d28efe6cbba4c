"""How one injection is run: into the phase, the fault, what the daemon and the devices make of it, and back."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress

from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, FaultRow, Reaction, catalogue_key
from harness.campaign.model import Case, Outcome, Phase
from harness.campaign.stack import CampaignError, JsonObject, Stack
from harness.campaign.watch import MOVING, axes_of

BRAKE_S = 0.7
"""Promised from detection (or from a ``manual`` command) to standstill: a tick, the wire, the way to stop."""
SLACK_S = 0.4
"""For a loaded machine, on top of every promise: campaign, rig, daemon and pictures share what cores there are."""
STILL_S = 0.3
EITHER_S = 1.0
LATCHED_S = 1.3
"""Drivers show an event for a second; what is still told afterwards is latched."""
EVERYTHING = tuple(MOVING)
OUTSIDE_DEG = 0.5
WAY = {
    "rotation": ("blade_deg", 10.0),
    "lift_left": ("lift_left_mm", 40.0),
    "lift_right": ("lift_right_mm", 40.0),
    "tilt": ("tilt_mm", 25.0),
}
"""How far an axis may still go (deg, mm) once the fault is named: braking, and a look-ahead target of an actuator."""
LIGHT = ("daemon.lease_lapsed", "daemon.tick_overrun")
"""Told by a loaded machine at any time; they hold nothing."""


def row_of(fault: str) -> FaultRow:
    """The catalogue's row for a fault's name."""
    device, _, condition = fault.partition(".")
    return CATALOGUE[catalogue_key(device, condition)]


def held_by(fault: str) -> frozenset[str]:
    """Axes that the catalogue holds for this fault."""
    row, device = row_of(fault), fault.partition(".")[0]
    if row.reaction < Reaction.HOLD:
        return frozenset()
    if row.axes == frozenset({"own"}):
        return frozenset({"tilt" if device == "tilt" else "lift"})
    return row.axes


def expected_mode(reaction: Reaction, before: str) -> str:
    """The mode a reaction leads to."""
    if reaction is Reaction.STOP:
        return "stopped"
    if reaction is Reaction.DISARM:
        return "disarmed"
    return "manual" if reaction is Reaction.RETREAT else before


def must_stand(fault: str, before: str) -> tuple[str, ...]:
    """Axes that must come to rest by themselves."""
    row = row_of(fault)
    if row.reaction >= Reaction.DISARM or (row.reaction is Reaction.RETREAT and before == "auto"):
        return EVERYTHING
    if row.automatic_only and before != "auto":
        return ()
    return axes_of(held_by(fault))


def decisive(case: Case, outcome: Outcome) -> str:
    """The fault whose row says what must happen; of several that were given it is the one with the strongest."""
    told = [fault for fault in case.faults if fault == outcome.named or fault in outcome.seen]
    return max(told, key=lambda fault: row_of(fault).reaction) if case.either and told else case.faults[0]


async def make_ready(stack: Stack) -> None:
    """Armed, manual, standing, and no fault but endured ones: where every injection begins and a recovery ends."""
    await stack.rest()
    end_s = time.monotonic() + 25.0
    while time.monotonic() < end_s:
        status = await stack.read_status()
        if status is None:
            await asyncio.sleep(0.1)
            continue
        faults = [f["name"] for f in status["faults"] if f["name"] not in stack.endured]
        if status["mode"] == "stopped":
            await stack.command("reset")
        elif status["mode"] == "disarmed":
            if not status["arming"] and all(r["met"] for r in status["readiness"] if r["mandatory"]):
                await stack.command("arm")
        elif status["mode"] == "auto":
            await stack.command("manual")
        elif any(not f["present"] for f in status["faults"] if f["clears"] != Clear.WHEN_GONE):
            await stack.command("disarm")
        elif not faults and not stack.watch.moving(EVERYTHING) and status["soil"]["frames_per_s"] > 0:
            return
        await asyncio.sleep(0.05)
    told = {key: stack.status.get(key) for key in ("mode", "reason", "holding")}
    raise CampaignError(
        f"not ready again: {told}, {[(f['name'], f['detail']) for f in stack.status.get('faults', [])]}"
    )


async def enter(stack: Stack, phase: Phase) -> None:
    """Bring the ready machine into the phase.

    Raises:
        CampaignError: it does not get there.
    """
    watch = stack.watch
    if phase is Phase.TURNING:
        angle_deg = watch.newest().state["blade_deg"]
        await stack.ask_rig("scene", zone="right" if angle_deg > 0.0 else "left", seed=3)
        answer = await stack.command("auto")
        if not answer["accepted"]:
            raise CampaignError(f"automatic operation was refused: {answer.get('message') or answer.get('error')}")
        await stack.until(
            lambda: abs(watch.newest().state["blade_deg"] - angle_deg) > 4.0 and watch.moving(("rotation",)),
            10.0,
            f"no turn from {angle_deg:.0f}° ({stack.status['soil']['zone']})",
        )
    elif phase is Phase.LIFTING:
        state = watch.newest().state
        height = "high" if state["lift_left_mm"] < 160.0 else "low"
        await stack.move("preset", name=f"{height}_{'right' if state['blade_deg'] > 0.0 else 'left'}")
        await stack.until(
            lambda: all(watch.moving((axis,)) for axis in ("lift_left", "lift_right", "rotation")),
            5.0,
            "the preset does not move the axes",
        )
        await asyncio.sleep(0.15)


def names_in(status: JsonObject | None) -> tuple[str, ...]:
    """The faults a status tells."""
    return tuple(sorted(f["name"] for f in (status or {}).get("faults", [])))


def goes_up(state: JsonObject) -> bool:
    """Which way the lifts have room."""
    return bool(state["lift_left_mm"] < 160.0)


async def demand(stack: Stack, needs: str) -> None:
    """Move an axis by hand, so that a fault which only shows in motion can show."""
    await stack.command("manual")
    state = stack.watch.newest().state
    if needs == "rotation":
        await stack.move("jog", axis="rotate", value=-25.0 if state["blade_deg"] > 0 else 25.0)
    else:
        await stack.move("jog", axis="lift", value=60.0 if goes_up(state) else -60.0, relative=True)


async def run_case(stack: Stack, case: Case, phase: Phase) -> Outcome:
    """One injection from a ready machine to a ready machine."""
    outcome = Outcome(case.name, str(phase))
    began_s = time.monotonic()
    stack.new_log_errors()
    try:
        await come_to(stack, phase)
        await (case.conduct or general)(stack, case, phase, outcome)
    except CampaignError as error:
        outcome.problems.append(str(error))
    finally:
        await stack.rest()
        with suppress(CampaignError):
            await case.repair(stack)
            await stack.heal()
    unexpected = [e for e in stack.new_log_errors() if not any(part in e for part in case.log_errors)]
    if unexpected:
        outcome.problems.append(f"{len(unexpected)} unexpected log errors, the first: {unexpected[0][:300]}")
    outcome.took_s = time.monotonic() - began_s
    return outcome


async def come_to(stack: Stack, phase: Phase) -> None:
    """Ready and into the phase; a loaded machine may need a second try, for its servo's watchdog waits for nobody."""
    for attempts_left_n in (2, 1, 0):
        try:
            await make_ready(stack)
            await enter(stack, phase)
            return
        except CampaignError as error:
            if not attempts_left_n:
                status = await stack.read_status() or {}
                told = [(f["name"], f["detail"]) for f in status.get("faults", [])]
                raise CampaignError(f"{error} ({status.get('mode')}: {status.get('reason')}; {told})") from None


async def general(stack: Stack, case: Case, phase: Phase, outcome: Outcome) -> None:
    """Inject, see it named, see it stop what the catalogue says, take the cause away, see it recover."""
    before = "auto" if phase is Phase.TURNING else "manual"
    shows = not case.needs or phase is Phase.LIFTING or (phase is Phase.TURNING and case.needs == "rotation")
    from_s = time.monotonic()
    await case.inject(stack)
    if not shows:
        before = "manual"
        await asyncio.sleep(STILL_S)
        from_s = time.monotonic()
        await demand(stack, case.needs)
    if case.hidden_by and phase is Phase.LIFTING:
        await stack.until(lambda: not stack.watch.moving((case.hidden_by,)), 10.0, "the lifts do not come to rest")
        from_s = time.monotonic()
    await detect(stack, case, outcome, from_s)
    await react(stack, case, outcome, from_s, before)
    await recover(stack, case, outcome, before)


async def detect(stack: Stack, case: Case, outcome: Outcome, from_s: float) -> None:
    """Wait until the daemon names the fault."""
    end_s = time.monotonic() + case.detect_s + SLACK_S + 1.0
    while time.monotonic() < end_s:
        status = await stack.read_status()
        named = [] if status is None else [f for f in status["faults"] if f["name"] in case.faults]
        if status is not None and named and status["time_s"] >= from_s:
            outcome.detected, outcome.named = True, named[0]["name"]
            outcome.detection_s = max(0.0, status["time_s"] - from_s)
            outcome.message = f"{named[0]['reads']} ({named[0]['detail']})".replace(str(stack.directory), "RIG")
            if outcome.detection_s > case.detect_s + SLACK_S:
                outcome.problems.append(f"detected after {outcome.detection_s:.2f} s, {case.detect_s:g} s promised")
            return
        await asyncio.sleep(0.015)
    names = [f["name"] for f in stack.status.get("faults", [])]
    now = f"{stack.status.get('mode')}: {stack.status.get('reason')}"
    outcome.problems.append(f"not detected; active: {names or 'nothing'}; {now}")


async def react(stack: Stack, case: Case, outcome: Outcome, from_s: float, before: str) -> None:
    """Mode, standstill and limits, against the catalogue."""
    watch = stack.watch
    if case.either:  # one way to notice may follow the other
        await asyncio.sleep(EITHER_S)
        outcome.seen = names_in(await stack.read_status())
    fault = decisive(case, outcome)
    outcome.expected_state = expected_mode(row_of(fault).reaction, before)
    with suppress(CampaignError):
        await stack.until_status(lambda s: s["mode"] == outcome.expected_state, 1.0, "the mode does not change")
    stopping = tuple(a for a in must_stand(fault, before) if a not in axes_of(case.own_motion))
    still = await watch.until_still(stopping, STILL_S, 3.0) if stopping else True
    # Some more time under the fault: what began to move again would be seen, and later faults would be named.
    await asyncio.sleep(0.2)
    status = await stack.read_status() or {}
    outcome.seen = names_in(status)
    outcome.final_state = str(status.get("mode", "no answer"))
    if stopping:
        outcome.standstill_s = watch.standstill_s(stopping, from_s)
        if outcome.detection_s is not None:
            outcome.problems += _ways_too_long(stack, stopping, from_s + outcome.detection_s)
    others = tuple(a for a in EVERYTHING if a not in stopping and a not in axes_of(case.own_motion))
    released_s = time.monotonic()
    if others and outcome.final_state in ("manual", "auto"):
        await stack.rest()
        await stack.command("manual")
        still = await watch.until_still(others, STILL_S, 3.0) and still
        if watch.standstill_s(others, released_s) > BRAKE_S + SLACK_S:
            outcome.problems.append("did not come to rest after 'manual' under the fault")
    if not stopping:
        outcome.standstill_s, outcome.standstill_from = watch.standstill_s(others, released_s), "manual command"
    outcome.safe = _judge(stack, case, outcome, from_s) and still


def _ways_too_long(stack: Stack, axes: tuple[str, ...], from_s: float) -> list[str]:
    """Axes that went further after the fault was named than braking takes."""
    samples = stack.watch.since(from_s)
    ways = {axis: abs(samples[-1].state[WAY[axis][0]] - samples[0].state[WAY[axis][0]]) for axis in axes if samples}
    return [
        f"{axis} went on for {way:.0f} after the fault was named" for axis, way in ways.items() if way > WAY[axis][1]
    ]


def _judge(stack: Stack, case: Case, outcome: Outcome, from_s: float) -> bool:
    """Whether the machine did what was promised; what it did not is added to the problems."""
    named_s = case.detect_s if outcome.detection_s is None else min(case.detect_s, outcome.detection_s)
    promised_s = BRAKE_S + (named_s if outcome.standstill_from == "injection" else 0.0)
    if case.stand_s is not None and outcome.standstill_from == "injection":
        promised_s = case.stand_s
    wrong = []
    if outcome.standstill_s is None or outcome.standstill_s > promised_s + SLACK_S:
        wrong.append(f"standstill after {outcome.standstill_s} s, {promised_s:.1f} s promised")
    if outcome.final_state != outcome.expected_state:
        reason = stack.status.get("reason", "")
        wrong.append(f"ended {outcome.final_state} ({reason}), the catalogue says {outcome.expected_state}")
    if "rotation" not in case.own_motion:
        most_deg = max(abs(s.state["blade_deg"]) for s in stack.watch.since(from_s))
        if most_deg > 60.0 + OUTSIDE_DEG:
            wrong.append(f"the blade came to {most_deg:.1f}°")
    outcome.problems += wrong
    return not wrong


async def recover(stack: Stack, case: Case, outcome: Outcome, before: str) -> None:
    """Take the cause away; see the fault go, or stay, and the machine come back, as the catalogue says."""
    fault = decisive(case, outcome)
    row = row_of(fault)
    await stack.rest()
    await case.repair(stack)
    way = []
    mode = outcome.final_state
    if case.either:  # what had not been noticed may be now that the cause is gone
        await asyncio.sleep(EITHER_S)
        mode = str((await stack.read_status() or {}).get("mode", mode))
    try:
        if row.clear is Clear.WHEN_GONE:
            await stack.until_status(lambda s: not _named(s, case.faults), case.recover_s, f"{fault} does not go away")
        else:
            await asyncio.sleep(LATCHED_S)
            if outcome.detected and not _named(await stack.read_status() or {}, case.faults):
                raise CampaignError(f"{fault} went away by itself; the catalogue says: {row.clear}")
        if case.before_arm is not None:
            await case.before_arm(stack)
            way.append("what the remedy says")
        if mode == "stopped":
            if (await stack.command("arm"))["accepted"]:
                raise CampaignError("armed without a reset after a stop")
            await asyncio.sleep(0.2)
            await _retry(stack, "reset", case.recover_s)
            way.append("reset")
        elif mode != "disarmed" and row.clear is not Clear.WHEN_GONE:
            await stack.command("disarm")
            way.append("disarm")
        if mode in ("stopped", "disarmed") or way:
            await _arm(stack, case.recover_s)
            way.append("arm")
        if before == "auto" and row.reaction is Reaction.RETREAT:
            await _retry(stack, "auto", 2.0)
            way.append("auto")
        await stack.until_status(lambda s: not _named(s, case.faults), 3.0, f"{fault} is still there after {way}")
        outcome.recovered_as_catalogued = stack.daemon.returncode is None
        outcome.recovery = ", ".join(way) or "by itself"
    except CampaignError as error:
        outcome.problems.append(str(error))


async def _retry(stack: Stack, command: str, timeout_s: float) -> None:
    """Devices come back and are found again in their own time: ask until it is accepted."""
    end_s = time.monotonic() + timeout_s
    answer: JsonObject = {}
    while time.monotonic() < end_s:
        answer = await stack.command(command)
        if answer["accepted"]:
            return
        await asyncio.sleep(0.1)
    raise CampaignError(f"{command} stays refused: {answer.get('message') or answer.get('error')}")


async def _arm(stack: Stack, timeout_s: float) -> None:
    """Arm, and see it armed. A device that is only just back may take the request and then refuse: whoever stands there
    arms again, and so does this."""
    end_s = time.monotonic() + timeout_s
    said = ""
    while time.monotonic() < end_s:
        status = await stack.read_status() or {}
        if status.get("mode") == "manual":
            return
        if status.get("mode") == "disarmed" and not status["arming"]:
            answer = await stack.command("arm")
            said = answer.get("message") or answer.get("error") or ""
        await asyncio.sleep(0.1)
    raise CampaignError(f"not armed again within {timeout_s:g} s: {stack.status.get('reason')}; {said}")


def _named(status: JsonObject, faults: tuple[str, ...]) -> list[str]:
    return [f["name"] for f in status.get("faults", []) if f["name"] in faults]


__all__ = ["BRAKE_S", "SLACK_S", "come_to", "detect", "general", "react", "run_case"]
