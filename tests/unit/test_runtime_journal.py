"""The daemon's log: priorities and fields in the journal, one line an entry elsewhere, and where a loop hangs."""

from __future__ import annotations

import json
import logging
import os
import re
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from graderd.hal.clock import SystemClock
from graderd.runtime.app import journal
from graderd.runtime.app.journal import LATER_MOST_N, JournalHandler, journal_entry, set_up_logging
from graderd.runtime.health import ARM_EVERY_S, HANGS_S, HangWatch

FORGED = "person\nPRIORITY=0\n<0>2026-01-01 ERROR forged\x1b[2J"


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    root, ours = logging.getLogger(), logging.getLogger("graderd")
    handlers, level, our_level = list(root.handlers), root.level, ours.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    ours.setLevel(our_level)


def record(level: int, message: str, *args: object, exc_info: Any = None, **extra: str) -> logging.LogRecord:
    return logging.getLogger("graderd.x").makeRecord(
        "graderd.x", level, "x.py", 1, message, args, exc_info, func="f", extra=extra
    )


def fields(datagram: bytes) -> dict[str, str]:
    """A datagram as journald takes it apart."""
    found, rest = {}, datagram
    while rest:
        line, _, after = rest.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if equals:
            rest = after
        else:
            size_n = int.from_bytes(after[:8], "little")
            value, rest = after[8 : 8 + size_n], after[9 + size_n :]
        assert name.decode() not in found, "a field of the same name twice"
        found[name.decode()] = value.decode()
    return found


@pytest.mark.parametrize(
    ("level", "priority"),
    [(logging.DEBUG, "7"), (logging.INFO, "6"), (logging.WARNING, "4"), (logging.ERROR, "3"), (logging.CRITICAL, "2")],
)
@pytest.mark.live
def test_the_journal_gets_priority_and_fields(tmp_path: Path, level: int, priority: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        handler = JournalHandler(logging.NullHandler(), tmp_path / "journal")
        extra = {"device": "rotation", "fault": "rotation.no_reply", "mode": "auto", "client": "cab\n"}
        handler.handle(record(level, "lost: %s", FORGED, **extra))
        got = fields(listener.recv(65536))
        handler.close()
    assert got["MESSAGE"] == "lost: person\\nPRIORITY=0\\n<0>2026-01-01 ERROR forged\\x1b[2J"
    assert got["PRIORITY"] == priority
    assert got["SYSLOG_IDENTIFIER"] == "graderd"
    assert (got["GRADERD_DEVICE"], got["GRADERD_FAULT"]) == ("rotation", "rotation.no_reply")
    assert (got["GRADERD_MODE"], got["GRADERD_CLIENT"]) == ("auto", "cab\\n")


def test_a_traceback_stays_one_entry() -> None:
    try:
        raise ValueError("PRIORITY=0\nMESSAGE=forged")
    except ValueError:
        got = fields(journal_entry(record(logging.ERROR, "unexpected", exc_info=sys.exc_info())))
    assert got["MESSAGE"].startswith("unexpected\nTraceback")
    assert got["PRIORITY"] == "3"


@pytest.mark.live
def test_what_the_journal_does_not_take_is_written_all_the_same(tmp_path: Path) -> None:
    kept: list[str] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            kept.append(record.getMessage())

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        handler = JournalHandler(Kept(), tmp_path / "journal")
        for number in range(2000):  # nobody reads: its queue is full soon
            handler.handle(record(logging.INFO, f"number {number}"))
        handler.close()
    assert kept
    assert kept[-1] == "number 1999"


def logged(code: str, *, in_journal: bool, address: Path) -> str:
    """What a process that sets up our logging prints. Its standard error is the journal's where ``in_journal``."""
    read_fd, write_fd = os.pipe()
    status = os.fstat(write_fd)
    environment = {**os.environ, "JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}" if in_journal else "1:2"}
    program = (
        "import logging; from pathlib import Path; from graderd.runtime.app import journal\n"
        f"journal.JOURNAL_SOCKET = Path({str(address)!r}); journal.JournalHandler.__init__.__defaults__ = "
        f"(journal.JOURNAL_SOCKET,)\njournal.set_up_logging(as_json=False)\n{code}"
    )
    try:
        subprocess.run([sys.executable, "-c", program], stderr=write_fd, env=environment, check=True, timeout=60)
    finally:
        os.close(write_fd)
    with os.fdopen(read_fd) as printed:
        return printed.read()


WARN = 'logging.getLogger("graderd.x").warning("a\\nb", extra={"device": "can"})'


@pytest.mark.live
def test_in_the_journal_without_its_socket_each_line_carries_its_priority(tmp_path: Path) -> None:
    assert logged(WARN, in_journal=True, address=tmp_path / "none") == "<4>a\\nb\n"
    raised = 'try: 1 / 0\nexcept ZeroDivisionError: logging.getLogger("graderd.x").exception("lost")'
    lines = logged(raised, in_journal=True, address=tmp_path / "none").splitlines()
    assert lines[0] == "<3>lost"
    assert lines[-1] == "<3>ZeroDivisionError: division by zero"
    assert all(line.startswith("<3>") for line in lines)


@pytest.mark.live
def test_in_the_journal_entries_go_to_its_socket(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        assert logged(WARN, in_journal=True, address=tmp_path / "journal") == ""
        assert fields(listener.recv(65536))["GRADERD_DEVICE"] == "can"


@pytest.mark.live
def test_elsewhere_a_line_carries_the_time_and_no_priority(tmp_path: Path) -> None:
    printed = logged(WARN, in_journal=False, address=tmp_path / "none")
    assert printed.endswith(" WARNING a\\nb\n")
    assert "<4>" not in printed


def test_json_lines_carry_the_fields(capsys: pytest.CaptureFixture[str]) -> None:
    set_up_logging(as_json=True)
    logging.getLogger("graderd.x").warning("%s", FORGED, extra={"device": "can", "fault": "can.unplugged"})
    logging.getLogger("graderd.x").warning("%s", FORGED, extra={"device": "can", "fault": "can.unplugged"})
    logging.getLogger("numexpr").info("said by a library")
    logging.getLogger().handlers[0].close()
    (line,) = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert line["message"] == FORGED
    assert (line["level"], line["device"], line["fault"]) == ("warning", "can", "can.unplugged")


def test_the_unit_waits_longer_than_the_watch() -> None:
    unit = (Path(__file__).parents[2] / "systemd" / "graderd.service").read_text("utf-8")
    (watchdog_s,) = [float(line.partition("=")[2]) for line in unit.splitlines() if line.startswith("WatchdogSec=")]
    assert watchdog_s > HANGS_S


HANGING = """
import time
from graderd.runtime import health
health.HANGS_S = 0.3
watch = health.HangWatch()
watch.ticked(0.0)
def somewhere_deep():
    {hang}
somewhere_deep()
"""


@pytest.mark.parametrize(
    ("hang", "said"),
    [
        ("time.sleep(1.0)", "Timeout ("),
        # In one call of C code that keeps the interpreter's lock, where no thread of ours could look.
        ("sum(range(10**8))", "Timeout ("),
        ("import os, signal; os.kill(os.getpid(), signal.SIGABRT)", "Fatal Python error: Aborted"),
    ],
)
@pytest.mark.live
def test_where_the_loop_hangs_is_told(hang: str, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", HANGING.format(hang=hang)], capture_output=True, text=True, timeout=60, check=False
    )
    assert said in done.stderr
    assert "in somewhere_deep" in done.stderr


def test_a_loop_that_ticks_is_not_told_of_and_its_ticks_cost_little(capfd: pytest.CaptureFixture[str]) -> None:
    clock, watch = SystemClock(), HangWatch()
    began_s = time.thread_time()
    ticks_n = 0
    while ticks_n * 0.02 < 20 * ARM_EVERY_S:
        watch.ticked(clock.now_s() + ticks_n * 0.02)
        ticks_n += 1
    each_s = (time.thread_time() - began_s) / ticks_n
    watch.close()
    assert each_s < 50e-6, "of a tick's 20 ms"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("level", "told"),
    [
        (logging.DEBUG, ["d", "i", "w", "e", "library w", "library e"]),
        (logging.INFO, ["i", "w", "e", "library w", "library e"]),
        (logging.WARNING, ["w", "e", "library w", "library e"]),
        (logging.ERROR, ["e", "library e"]),
    ],
)
def test_the_level_is_of_our_own_entries_and_libraries_stay_quiet(
    level: int, told: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging(as_json=True, level=level)
    for name, prefix in (("graderd.x", ""), ("numexpr", "library ")):
        for at in (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR):
            logging.getLogger(name).log(at, "%s%s", prefix, logging.getLevelName(at)[0].lower())
    logging.getLogger().handlers[0].close()  # waits for its thread
    assert [json.loads(line)["message"] for line in capsys.readouterr().err.splitlines()] == told


def test_every_logger_of_ours_is_told_at_info() -> None:
    set_up_logging(as_json=False)
    assert logging.getLogger("graderd.drivers.dynamixel.servo_task").isEnabledFor(logging.INFO)
    assert not logging.getLogger("numexpr").isEnabledFor(logging.INFO)
    assert journal.priority(logging.INFO) == 6


def test_a_pipe_that_nobody_reads_is_not_waited_for_and_what_was_lost_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb", buffering=0) as reader, os.fdopen(writing, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        fill(writing)
        set_up_logging(as_json=False)
        handler = logging.getLogger().handlers[0]
        for one in list(handler.filters):
            handler.removeFilter(one)  # repetitions are held back before they come so far
        log = logging.getLogger("graderd.test")
        began_s = time.monotonic()
        many_n = LATER_MOST_N + 100
        for number in range(many_n):
            log.warning("line %d", number)
        assert time.monotonic() - began_s < 2.0
        closing = threading.Thread(target=handler.close)
        text, after_n = b"", 0
        while b"were lost" not in text or not text.endswith(b"\n"):
            text += reader.read(65536)
            log.warning("after")  # may be lost as well while the queue is full
            after_n += 1
        told = int(re.search(rb"(\d+) lines of this log were lost", text)[1])  # type: ignore[index]  # or it fails
        assert many_n - LATER_MOST_N - 2 <= told <= many_n - LATER_MOST_N + after_n
        os.set_blocking(reading, False)
        closing.start()
        while closing.is_alive():
            select.select([reader], [], [], 0.01)
            reader.read(65536)
        closing.join()
    logging.getLogger().handlers.clear()


@pytest.mark.live
def test_a_process_whose_standard_error_nobody_reads_ends(tmp_path: Path) -> None:
    del tmp_path
    code = (
        "import logging, os\nfrom graderd.runtime.app.journal import set_up_logging\n"
        "os.set_blocking(2, False)\n"
        "try:\n    while True: os.write(2, b'x' * 4096)\nexcept BlockingIOError: pass\n"
        "os.set_blocking(2, True)\nset_up_logging(False)\nlogging.getLogger('graderd').error('one')\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE)
    assert process.wait(20) == 0
    assert process.stderr is not None
    process.stderr.close()


def fill(descriptor: int) -> None:
    """Write until the pipe is full."""
    os.set_blocking(descriptor, False)
    try:
        while True:
            os.write(descriptor, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(descriptor, True)
