"""One filter keeps repetitions out of the log: at once, after a minute, then hourly, with a count."""

from __future__ import annotations

import logging

import pytest

from graderd.runtime.app import journal
from graderd.runtime.app.journal import BURST_N, RepeatFilter


class Log:
    """A filter on a clock of our own, and what it lets through, with the times."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.told: list[tuple[float, str]] = []
        self._filter = RepeatFilter(lambda: self.now_s)

    def say(self, message: str, level: int = logging.WARNING, **extra: object) -> None:
        record = logging.makeLogRecord({"name": "graderd.x", "levelno": level, "msg": message, **extra})
        if self._filter.filter(record):
            self.told.append((self.now_s, record.getMessage()))

    def every(self, period_s: float, until_s: float, message: str) -> None:
        while self.now_s < until_s:
            self.say(message.replace("N", str(int(self.now_s))))
            self.now_s += period_s


def test_an_absent_device_is_told_at_once_after_a_minute_and_then_hourly_with_a_count() -> None:
    log = Log()
    log.every(1.0, 86_400.0, "rotation: no such port (try N)")
    assert [at_s for at_s, _ in log.told] == [0.0, 60.0, *range(3660, 86_400, 3600)]
    assert log.told[1][1] == "rotation: no such port (try 60) (59 more not told)"
    assert log.told[2][1].endswith("(3599 more not told)")


def test_another_cause_and_another_severity_are_told_at_once() -> None:
    log = Log()
    for message in ("can: no such interface", "can: the interface is down", "can: no such interface"):
        log.say(message)
    log.say("can: no such interface", logging.ERROR)
    assert [message for _, message in log.told] == [
        "can: no such interface", "can: the interface is down", "can: no such interface"
    ]  # fmt: skip


def test_what_comes_again_after_a_quiet_time_is_news() -> None:
    log = Log()
    log.say("rotation: lost")
    log.now_s = 30.0
    log.say("rotation: lost")
    log.now_s = 900.0
    log.say("rotation: lost")
    assert [at_s for at_s, _ in log.told] == [0.0, 900.0]


def test_what_somebody_did_is_told_each_time_and_still_fills_no_disk() -> None:
    log = Log()
    for _ in range(BURST_N):
        log.say("auto -> stopped: stop command", event=True)
    assert len(log.told) == BURST_N
    while log.now_s < 4 * 3600.0:
        log.say("disarmed -> stopped: stop command", event=True)
        log.now_s += 0.1
    assert len(log.told) < BURST_N + 4 * 60 + 1
    assert "more not told)" in log.told[-1][1]


def test_messages_that_are_all_different_fill_no_disk() -> None:
    log = Log()
    while log.now_s < 3600.0:
        log.say("camera: " + "".join(chr(97 + int(d)) for d in str(int(log.now_s * 10))))
        log.now_s += 0.1
    assert BURST_N <= len(log.told) <= BURST_N + 61


def test_no_more_messages_are_remembered_than_so_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "KEYS_MOST_N", 3)
    log = Log()
    for message in "abcda":
        log.say(f"camera: {message}")
    assert [message[-1] for _, message in log.told] == ["a", "b", "c", "d", "a"]  # the first was forgotten meanwhile
