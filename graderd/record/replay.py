"""Recorded inputs through today's perception and tick: what would be decided otherwise, worst first.

With the recording's own configuration this is a regression test: the same code gives the same bytes. With another one
it is a what-if, as far as one can be: what was recorded does not answer to what is decided anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, TypeVar

import cv2

from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core.axes import AXES, FIELDS, UNITS
from graderd.core.machine import State
from graderd.core.soil import SoilObservation
from graderd.core.tick import Controller, Sensed
from graderd.hal.errors import ProtocolError
from graderd.perception.classifier import judge_frame, make_classifier
from graderd.record.export import raw_frames
from graderd.record.layout import (
    GAP,
    MARK,
    MEMORY,
    SENSED,
    TICK,
    Gap,
    Mark,
    Memory,
    Message,
    Unreadable,
    clock,
    controller_of,
    memory_of,
    sensed_bytes,
    sensed_of,
    tick_bytes,
    tick_of,
)
from graderd.record.reader import Recording, said

_T = TypeVar("_T")
WARM_UP_S: Final = 10.0
"""Where the tick's memory is another version's, it is made anew from the state recorded, and not judged for so long:
faults have their debounce and votes their age by then."""
KINDS: Final = ("command", "decision", "picture", "mode", "fault", "other")
"""What may differ, worst first."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that is decided otherwise today, in ``ticks_n`` ticks on end from ``at_s`` (monotonic).

    ``kind``: of :data:`KINDS`. ``size``: within a kind, the greater the worse: degrees or millimetres of a command.
    ``text``: for people. ``frame_number``: the picture's, where it is about one.
    """

    kind: str
    where: str
    at_s: float
    log_ns: int
    ticks_n: int
    size: float
    recorded: str
    today: str
    text: str
    frame_number: int | None = None

    @property
    def order(self) -> tuple[int, float]:
        """Worst first."""
        return KINDS.index(self.kind), -self.size


@dataclass(slots=True)
class Break:
    """Where ticks do not follow one another in the recording. What the tick had in mind is lost there: nothing is
    judged before the next memory, from which everything is bit for bit again.

    ``kind``: ``damaged`` (the file cannot be read there), ``unreadable`` (a message is not as graderd writes it) or
    ``lost`` (the daemon did not keep up, and said so).
    ``missing_n``: ticks that are not there, by the clock or as the daemon counted them; None: nobody knows.
    ``skipped_n``: ticks that are there, and were not judged. ``again_s``: the tick (monotonic) from which on they are
    judged again; None: none is. ``gap``: where in the file, of a damaged one.
    """

    kind: str
    text: str
    missing_n: int | None
    gap: Gap | None = None
    skipped_n: int = 0
    again_s: float | None = None


@dataclass(slots=True)
class Check:
    """What a check has found: ``ticks_n`` were decided again, ``skipped_n`` could not be (no memory to begin with).
    ``picture_gaps``: what of the raw frames cannot be read; there stands what was seen then. ``unreadable``: what is
    not as graderd writes it."""

    ticks_n: int = 0
    skipped_n: int = 0
    frames_n: int = 0
    warm_ups_n: int = 0
    differences: tuple[Difference, ...] = ()
    breaks: list[Break] = field(default_factory=list)
    picture_gaps: tuple[Gap, ...] = ()
    unreadable: tuple[Unreadable, ...] = ()

    @property
    def is_damaged(self) -> bool:
        """Whether something of the recording could not be read."""
        return bool(self.picture_gaps or self.unreadable) or any(each.kind == "damaged" for each in self.breaks)


def check(recording: Recording, config: Config | None = None) -> Check:
    """Decide everything again; ``config``: by another configuration than the recording's.

    Raises:
        ConfigError: the recording's configuration is not one any more.
    """
    found = Check()
    used = config or recording.config
    pictures, differences = _pictures(recording, used, found)
    differences += list(_merged(_decide(recording, used, found, pictures, follows=config is None)))
    found.picture_gaps = tuple(gap for each in recording.beside for gap in each.gaps)
    found.unreadable = recording.unreadable
    found.differences = tuple(sorted(differences, key=lambda difference: difference.order))
    return found


# ---- perception ------------------------------------------------------------------------------------------------------


def _pictures(
    recording: Recording, config: Config, found: Check
) -> tuple[dict[int, SoilObservation], list[Difference]]:
    """Today's observations by frame number, and how they differ. Without raw frames there are none."""
    today: dict[int, SoilObservation] = {}
    differences: list[Difference] = []
    classifier = make_classifier(config.perception, config.camera.calibration, config.blade, camera=config.camera)
    for message, judged in raw_frames(recording):
        try:
            seen = judge_frame(
                classifier,
                judged.frame,
                judged.angle_deg,
                judged.angle_age_s,
                judged.judged_s,
                config.perception.decision,
                judged.attitude,
            )
        except (ValueError, LookupError, ArithmeticError, cv2.error) as error:  # no camera's picture
            recording.refuse(message, error)
            continue
        was = judged.observation
        # How long it took is no part of what was seen; the recorded time keeps what follows comparable.
        seen = replace(seen, cpu_ms=was.cpu_ms)
        if was.profile_mm is None:  # nor what was not measured yet when it was recorded
            seen = replace(seen, profile_mm=None)
        found.frames_n += 1
        today[was.frame_number] = seen
        if seen != was:
            differences.append(_picture(was, seen))
    return today, differences


def _picture(was: SoilObservation, now: SoilObservation) -> Difference:
    before, after = was.coming, now.coming
    size = abs(after.confidence - before.confidence) + (1.0 if before.zone is not after.zone else 0.0)
    return Difference(
        "picture",
        f"frame {was.frame_number}",
        was.capture_s,
        0,
        1,
        size,
        f"{before.zone} ({before.confidence:.2f}): {before.reason}",
        f"{after.zone} ({after.confidence:.2f}): {after.reason}",
        f"frame {was.frame_number}: {before.zone} {before.confidence:.0%} sure was seen, today {after.zone} "
        f"{after.confidence:.0%}",
        was.frame_number,
    )


# ---- the tick --------------------------------------------------------------------------------------------------------


def _decide(
    recording: Recording, config: Config, found: Check, pictures: Mapping[int, SoilObservation], *, follows: bool
) -> Iterator[Difference]:
    """Every difference of every tick. ``follows``: each memory is taken up, so that one difference is not told for the
    rest of the day; a what-if goes its own way."""
    settings = tick_settings(config)
    controller: Controller | None = None
    knew: Message | None = None
    warm_until_s = float("-inf")
    cold = False
    broken: list[Break] = []  # after which nothing was judged yet

    def skipped() -> None:
        found.skipped_n += 1
        if broken:
            broken[-1].skipped_n += 1

    def breaks(new: Break) -> None:
        nonlocal controller, knew
        if controller is not None or new.kind != "unreadable":
            found.breaks.append(new)
            broken.append(new)
        controller = knew = None

    for message in recording.messages((SENSED, TICK, MEMORY, MARK, GAP)):
        if message.topic == SENSED:
            knew = message
        elif message.topic in (MARK, GAP):
            new = recording.value_of(message, partial(_breaks_at, message.topic, config.control.tick_hz))
            if new is None:
                breaks(_unreadable(message))
            elif new:
                breaks(*new)
        elif message.topic == MEMORY:
            if controller is not None and not follows:
                continue
            if (memory := recording.value_of(message, Memory.model_validate_json)) is None:
                continue
            try:
                controller = controller_of(memory.controller, settings)
            except ValueError:
                cold = controller is None
        elif controller is None or knew is None:
            skipped()
            # The state of this tick is all there is to begin with.
            now_s = recording.value_of(message, lambda data: float(said(data)["now_s"])) if cold else None
            if now_s is not None:
                controller, cold = Controller(settings, _state(message.data)), False
                warm_until_s = now_s + WARM_UP_S
                found.warm_ups_n += 1
        else:
            again = recording.value_of(knew, partial(_again, controller, pictures, config))
            if again is None:
                breaks(_unreadable(knew))
                skipped()
                continue
            sensed, told = again
            if sensed.now_s < warm_until_s:
                skipped()
                continue
            some = recording.value_of(message, partial(_differing, told, message.log_ns))
            if some is None:
                skipped()
                continue
            found.ticks_n += 1
            for each in broken:
                each.again_s = sensed.now_s
            broken.clear()
            # Counters and ages began anew where the memory did.
            yield from (each for each in some if not (found.warm_ups_n and each.kind == "other"))


def _sensed(data: bytes) -> Sensed:
    """What a tick knew, at a time that there is."""
    sensed = sensed_of(data)
    if not math.isfinite(sensed.now_s):
        raise ValueError(f"it was at {sensed.now_s} s")
    return sensed


def _again(
    controller: Controller, pictures: Mapping[int, SoilObservation], config: Config, data: bytes
) -> tuple[Sensed, bytes]:
    """What a tick knew, and what is decided of it today."""
    sensed = _seen_today(_sensed(data), pictures, config)
    return sensed, tick_bytes(controller.step(sensed))


def _breaks_at(topic: str, tick_hz: float, data: bytes) -> list[Break]:
    """What a gap or mark says of missing ticks: one, or none."""
    if topic == GAP:
        gap = Gap.model_validate_json(data)
        missing_n = None if gap.duration_s is None else max(0, round(gap.duration_s * tick_hz) - 1)
        return [Break("damaged", str(gap), missing_n, gap)]
    mark = Mark.model_validate_json(data)
    return [Break("lost", f"not recorded: {mark.text}", mark.lost_n)] if mark.kind == "lost" else []


def _unreadable(message: Message) -> Break:
    """A message that would say what was: one tick is missing at least."""
    return Break("unreadable", f"{message.topic} at {clock(message.log_ns)} is not as graderd writes it", None)


def _seen_today(sensed: Sensed, pictures: Mapping[int, SoilObservation], config: Config) -> Sensed:
    """What the tick would have known, had today's perception seen the pictures."""
    if sensed.observation is None or (seen := pictures.get(sensed.observation.frame_number)) is None:
        return sensed
    return replace(sensed, observation=seen.as_of(sensed.now_s, config.perception.decision.max_frame_age_s))


def _state(tick: bytes) -> State | None:
    try:
        return tick_of(tick).state
    except ValueError:  # another version's
        return None


def _differing(now: bytes, log_ns: int, was: bytes) -> list[Difference]:
    """As :func:`_differences`, of a recorded tick."""
    found = [] if was == now else list(_differences(said(was), said(now), log_ns))
    if not all(math.isfinite(each.size) for each in found):
        raise ValueError("a number in it is none")
    return found


def _differences(was: dict[str, Any], now: dict[str, Any], log_ns: int) -> Iterator[Difference]:
    """What differs in one tick; everything beyond commands, decision, mode and faults only where nothing else does."""

    def told(kind: str, where: str, size: float, recorded: str, today: str, text: str) -> Difference:
        return Difference(kind, where, now["now_s"], log_ns, 1, size, recorded, today, text)

    any_told = False
    for axis in AXES:
        before, after = was["axes"].get(axis, {}), now["axes"].get(axis, {})
        if before.get("send") == after.get("send") and before.get("hold") == after.get("hold"):
            continue
        any_told = True
        measured = now["pose"].get(FIELDS[axis])
        verb = "turned" if axis == "rotation" else "moved"
        recorded, today = _order(before, axis), _order(after, axis)
        text = f"{axis}: {recorded} was sent, today {today}"
        if before.get("send") is None and after.get("send") is not None:
            text = f"{axis}: would have {verb} to {after['send']:.2f} {UNITS[axis]}, {recorded}"
        elif after.get("send") is None and before.get("send") is not None:
            text = f"{axis}: would not have {verb}; it was sent to {before['send']:.2f} {UNITS[axis]}"
        yield told("command", axis, _size(before, after, measured), recorded, today, text)
    decided, decides = (tick["state"].get("decision", {}) for tick in (was, now))
    if any(decided.get(key) != decides.get(key) for key in ("zone", "angle_deg")):
        any_told = True
        recorded, today = (f"{d.get('zone', 'none')} ({d.get('angle_deg', '-')} deg)" for d in (decided, decides))
        size = abs((decides.get("angle_deg") or 0.0) - (decided.get("angle_deg") or 0.0))
        yield told("decision", "decision", size, recorded, today, f"decided {recorded}, today {today}")
    if was["state"]["mode"] != now["state"]["mode"]:
        any_told = True
        recorded, today = (f"{tick['state']['mode']}: {tick['state']['reason']}" for tick in (was, now))
        yield told("mode", "mode", 1.0, recorded, today, f"mode {recorded}; today {today}")
    names = [{fault["name"] for fault in tick["faults"]} for tick in (was, now)]
    if names[0] != names[1]:
        any_told = True
        recorded, today = (", ".join(sorted(some)) or "none" for some in names)
        yield told("fault", "faults", len(names[0] ^ names[1]), recorded, today, f"faults {recorded}; today {today}")
    if not any_told:
        places = [key for key in {**was, **now} if was.get(key) != now.get(key)]
        where = ", ".join(sorted(places)) or "the order of fields"
        yield told("other", "tick", 0.0, "", "", f"other words or numbers in {where}")


def _order(axis: Mapping[str, Any], name: str) -> str:
    if axis.get("send") is not None:
        return f"{axis['send']:.4g} {UNITS[name]}"
    return "a hold" if axis.get("hold") else "nothing"


def _size(before: Mapping[str, Any], after: Mapping[str, Any], measured: float | None) -> float:
    """How far apart the two orders lead; an axis that is sent nowhere stays where it is."""
    stays = 0.0 if measured is None else measured
    goals = [stays if order.get("send") is None else order["send"] for order in (before, after)]
    return float(abs(goals[1] - goals[0]))


def _merged(differences: Iterator[Difference]) -> Iterator[Difference]:
    """Those of one kind and place in ticks on end as one, with the words of its worst tick."""
    going: dict[tuple[str, str], tuple[Difference, float]] = {}
    for each in differences:
        key = (each.kind, each.where)
        former = going.get(key)
        if former is not None and each.at_s - former[1] < 0.5:
            first, _ = former
            worst = each if each.size > first.size else first
            going[key] = (replace(worst, at_s=first.at_s, log_ns=first.log_ns, ticks_n=first.ticks_n + 1), each.at_s)
        else:
            if former is not None:
                yield former[0]
            going[key] = (each, each.at_s)
    yield from (each for each, _ in going.values())


def decided_again(recording: Recording) -> Iterator[Message]:
    """The recording's messages with what today is seen and decided in place of what was: a new reference.

    Where the tick's memory is another version's, the first tick is kept as it was, and its state begun with.

    Raises:
        ProtocolError: something in it is not as graderd writes it, or ticks are missing.
    """
    settings = tick_settings(recording.config)
    pictures, _ = _pictures(recording, recording.config, Check())
    controller: Controller | None = None
    sensed: Sensed | None = None
    cold = False

    def value_of(message: Message, how: Callable[[bytes], _T]) -> _T:
        found = recording.value_of(message, how)
        if found is None:
            raise ProtocolError(str(recording.path), str(recording.unreadable[0]))
        return found

    def memory(now_s: float, of: Controller) -> bytes:
        return Memory(now_s=now_s, controller=memory_of(of, settings)).model_dump_json().encode()

    for message in recording.messages():
        if message.topic == SENSED:
            sensed = _seen_today(value_of(message, _sensed), pictures, recording.config)
            yield message._replace(data=sensed_bytes(sensed))
        elif message.topic == MEMORY:
            told = value_of(message, Memory.model_validate_json)
            if controller is None:
                try:
                    controller = controller_of(told.controller, settings)
                except ValueError:
                    cold = True
                    continue
            yield message._replace(data=memory(told.now_s, controller))
        elif message.topic in (MARK, GAP) and value_of(message, partial(_breaks_at, message.topic, 0.0)):
            cause = "ticks are missing in it, so that nobody knows what today would be decided after them"
            raise ProtocolError(str(recording.path), cause, "Make a reference of a recording that is whole")
        elif message.topic == TICK and sensed is not None and controller is not None:
            yield message._replace(data=tick_bytes(controller.step(sensed)))
        elif message.topic == TICK and sensed is not None and cold:
            yield message
            controller = Controller(settings, _state(message.data))
            yield message._replace(topic=MEMORY, data=memory(sensed.now_s, controller))
        else:
            yield message
