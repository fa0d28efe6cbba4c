"""``graderd watch`` and ``graderd status`` on terminals of three sizes: faults first, numbers whole, and a hand that is
let go, frozen or cut off moves nothing."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot

from graderd.cli.watch_app import HOLDS, KEYS, STALE_S, WatchApp
from graderd.core.machine import Mode
from graderd.core.soil import Zone
from graderd.core.status import AheadStatus, FaultStatus, RequirementStatus, SoilStatus, ThirdsStatus
from graderd.view import LEAST_COLUMNS_N, fitting, lines, profile, shown
from harness.api_daemon import FakeDaemon, serving
from harness.awake_clock import AwakeClock
from harness.person import Person

SIZES = ((60, 20), (80, 24), (120, 40))
LEFT = "\x1b[D"
REPEAT_S = 0.03


def fault(name: str, reaction: str = "hold") -> FaultStatus:
    return FaultStatus(
        name=name,
        reads="the blade was told to turn and does not, or hardly, although the servo says that it pushes",
        detail=f"{name}: 12.3 A for 4.5 s at -57.8 deg",
        remedy="lift and free the blade, look at the servo's horn and cable; then graderd arm, which takes it up again",
        reaction=reaction,
        clears="on re-arm",
        age_s=1.5,
        present=True,
    )


def status_of(faults_n: int, unmet_n: int = 0) -> dict[str, Any]:
    """A status with long numbers in every place that has one."""
    daemon = FakeDaemon(positions={"rotation": -123.4, "lift_left": 1234.5, "lift_right": 1234.6, "tilt": 987.6})
    litres = {"left_l": 123.4, "center_l": 234.5, "right_l": 345.6}
    soil = SoilStatus(
        zone=Zone.LEFT,
        confidence=0.87,
        reason="left 345.6 l of 703.5",
        age_s=0.12,
        share_left=0.49,
        share_center=0.33,
        share_right=0.18,
        ahead=AheadStatus(zone=Zone.LEFT, confidence=0.9, reason="more of it", **litres),
        carried=ThirdsStatus(**litres),
        profile_mm=(None, 0.0, *(10.0 * n for n in range(22))),
    )
    status = daemon.status().model_copy(
        update={
            "soil": soil,
            "faults": tuple(fault(f"rotation.not_moving_{n}", "stop" if n else "hold") for n in range(faults_n)),
            "readiness": tuple(
                RequirementStatus(name=f"need {n}", met=False, mandatory=True, reason="not there", remedy="plug it in")
                for n in range(unmet_n)
            ),
        }
    )
    return status.model_dump(mode="json")


@pytest.mark.parametrize(("columns_n", "lines_n"), SIZES)
@pytest.mark.parametrize(("faults_n", "unmet_n"), [(0, 0), (1, 2), (2, 0), (3, 4)])
def test_it_fits_faults_first_and_no_number_is_cut(columns_n: int, lines_n: int, faults_n: int, unmet_n: int) -> None:
    status = status_of(faults_n, unmet_n)
    found = lines(status, columns_n, lines_n - 3)
    text = [line.text for line in found]
    assert len(text) <= lines_n - 3
    assert max(map(len, text)) <= columns_n
    first_axis = next((place for place, line in enumerate(text) if line.startswith("rotation")), len(text))
    for number in range(faults_n):
        place = next(p for p, line in enumerate(text) if line.startswith(f"! rotation.not_moving_{number}"))
        assert place < first_axis
    if faults_n < 3:
        for whole in ("-123.4 deg", "1234.5 mm", "1234.6 mm", "987.6 mm", "123.4 l  center 234.5 l  right 345.6 l"):
            assert whole in shown(found)
        assert sum("lift and free the blade" in line for line in text) == faults_n
    assert not re.search(r"\d…", shown(found)), "a number with its end cut off is another number"


@pytest.mark.parametrize(("columns_n", "lines_n"), SIZES)
@pytest.mark.parametrize("faults_n", [1, 3, 5])
def test_no_remedy_ends_in_its_middle_without_a_mark(columns_n: int, lines_n: int, faults_n: int) -> None:
    remedy = "plug it in again, in any port; it is found by its serial number, whichever that is, and then arm again"
    status = status_of(faults_n, 0)
    for number, told in enumerate(status["faults"]):
        told |= {"name": f"rotation.not_moving_{number}", "remedy": remedy, "detail": ""}
    text = [line.text for line in lines(status, columns_n, lines_n - 3)]
    begins = [place for place, line in enumerate(text) if line.startswith("  > ")]
    assert begins
    for place in begins:
        goes_on = [line for line in text[place + 1 : place + 2] if line.startswith("    ")]
        said = " ".join([text[place].removeprefix("  > "), *(line.strip() for line in goes_on)])
        assert said == remedy or (said.endswith("…") and remedy.startswith(said[:-1]))


@pytest.mark.parametrize(("columns_n", "lines_n"), SIZES)
def test_a_long_reason_leaves_the_remedy_its_room(columns_n: int, lines_n: int) -> None:
    """A machine that was stopped before its start says why at length, and then what to do."""
    status = status_of(0, 1)
    status["readiness"][0] |= {
        "name": "stop",
        "reason": "stopped: a loop that nobody has read " * 5,
        "remedy": "reset it",
    }
    text = [line.text for line in lines(status, columns_n, lines_n - 3)]
    (unmet,) = (line for line in text if line.startswith("not ready: stop, stopped: "))
    assert unmet.endswith("… > reset it")


def test_what_a_fault_says_already_is_not_said_again() -> None:
    status = status_of(1, 1)
    status["readiness"][0]["name"] = status["faults"][0]["name"]
    assert "not ready" not in shown(lines(status, 80, 40))


def test_the_profile_is_bars_with_its_highest_as_a_number() -> None:
    bars = "left ?··▁▁▂▂▂▃▃▄▄▄▅▅▅▆▆▇▇▇███ right, 210 mm high"
    assert f"  profile  {bars}" in shown(lines(status_of(0), 60, 20)).split("\n")
    assert profile((None,) * 24) == f"left {24 * '?'} right, none of it seen"
    assert profile((12.0, None) * 12) == f"left {12 * '▁?'} right, 12 mm high"


@pytest.mark.parametrize("columns_n", range(8, 60))
@pytest.mark.parametrize(
    "text",
    [
        "held at -57.8 deg because 12.34 A flowed for 0.75 s in the servo",
        "soil none: left 0.0, center 12.3, right 4.5; 100% sure of that since 7: so it is",
    ],
)
def test_what_is_cut_is_cut_between_words_and_never_in_a_number(columns_n: int, text: str) -> None:
    cut = fitting(text, columns_n)
    assert len(cut) <= columns_n
    assert cut.endswith("…")
    kept = cut.removesuffix("…")
    assert text.startswith(kept)
    assert text[len(kept)] in " ,;:" or len(text.split(" ")[0]) > columns_n - 1
    assert not kept[-1].isdigit()


@pytest.mark.parametrize(("columns_n", "lines_n"), SIZES)
def test_status_on_a_terminal_fits_it(
    columns_n: int, lines_n: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from graderd.cli import status as command
    from graderd.cli.console import print_rich

    monkeypatch.setenv("COLUMNS", str(columns_n))
    monkeypatch.setenv("LINES", str(lines_n))
    for faults_n in (0, 1, 3):
        print_rich(command._on_terminal(status_of(faults_n)))
        printed = capsys.readouterr().out.rstrip("\n").split("\n")
        assert len(printed) < lines_n, "the shell's next prompt has a line too"
        assert max(map(len, printed)) <= columns_n


# -- the application ---------------------------------------------------------------------------------------------------


def on_screen(app: WatchApp) -> list[str]:
    return [strip.text.rstrip() for strip in app.screen._compositor.render_strips()]


async def until(condition: Any, timeout_s: float = 10.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.01)


@asynccontextmanager
async def watching(
    folder: Path, size: tuple[int, int], daemon: FakeDaemon | None = None
) -> AsyncIterator[tuple[WatchApp, Pilot[None], FakeDaemon]]:
    async with serving(folder, daemon) as (fake, path):
        app = WatchApp(path)
        async with app.run_test(size=size) as pilot:
            await until(lambda: app._status is not None)
            await pilot.pause()
            yield app, pilot, fake


async def hold(app: WatchApp, key: str, condition: Any) -> None:
    """As a keyboard repeats a held key, until something is so."""
    async with asyncio.timeout(10.0):
        while not condition():
            app.post_message(events.Key(key, None))
            await asyncio.sleep(REPEAT_S)


async def armed(pilot: Pilot[None], daemon: FakeDaemon) -> None:
    await pilot.press("A")
    await daemon.until_mode(Mode.MANUAL)


@pytest.mark.live
@pytest.mark.parametrize("size", SIZES)
async def test_the_screen_at_each_size(tmp_path: Path, size: tuple[int, int]) -> None:
    daemon = FakeDaemon(
        positions={"rotation": -123.4, "lift_left": 1234.5, "lift_right": 1234.6, "tilt": 987.6},
        held={"rotation": fault("rotation.not_moving")},
    )
    async with watching(tmp_path, size, daemon) as (app, _, _):
        await until(lambda: any("rotation.not_moving" in line for line in on_screen(app)))
        screen = on_screen(app)
        assert len(screen) == size[1]
        assert max(map(len, screen)) <= size[0]
        for whole in ("-123.4 deg", "1234.5 mm", "1234.6 mm", "987.6 mm", "lift and free the blade"):
            assert whole in "\n".join(screen)
        assert screen[1].startswith("! rotation.not_moving")
        assert [screen[-2], screen[-1]] == [KEYS, HOLDS], "what stops it is always in sight"


@pytest.mark.live
async def test_space_stops_whatever_else_is_going_on(tmp_path: Path) -> None:
    async with watching(tmp_path, (80, 24)) as (app, pilot, daemon):
        await armed(pilot, daemon)
        await hold(app, "left", lambda: daemon.positions["rotation"] > 3.0)
        await pilot.press("space")
        await daemon.until_mode(Mode.STOPPED)
        await pilot.press("R")
        await daemon.until_mode(Mode.DISARMED)
        await armed(pilot, daemon)
        app._heard_s = time.monotonic() + 1e6  # what it shows does not matter
        await pilot.press("space")
        await daemon.until_mode(Mode.STOPPED)


@pytest.mark.live
async def test_a_key_moves_while_it_repeats_and_a_tap_does_not(tmp_path: Path) -> None:
    async with watching(tmp_path, (80, 24)) as (app, pilot, daemon):
        await armed(pilot, daemon)
        await pilot.press("left")
        await asyncio.sleep(0.3)
        assert daemon.positions["rotation"] == 0.0
        await hold(app, "left", lambda: daemon.positions["rotation"] > 5.0)
        await daemon.until(lambda: daemon.state.lease is None)
        await until(lambda: any("released" in line for line in on_screen(app)))
        stood_deg = daemon.positions["rotation"]
        await asyncio.sleep(0.2)
        assert daemon.positions["rotation"] == stood_deg
        assert daemon.state.mode is Mode.MANUAL
        await hold(app, "right", lambda: daemon.positions["rotation"] < stood_deg - 3.0)


@pytest.mark.live
async def test_what_is_old_is_not_shown(tmp_path: Path) -> None:
    """No status any more: the last numbers are gone from the screen, and a held key begins nothing."""
    still = FakeDaemon(positions={"rotation": 12.3, "lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0})
    async with watching(tmp_path, (80, 24), still) as (app, pilot, daemon):
        await armed(pilot, daemon)
        assert any("12.3 deg" in line for line in on_screen(app))
        app.workers.cancel_group(app, "listen")
        await asyncio.sleep(STALE_S + 0.2)
        screen = on_screen(app)
        assert screen[0].startswith("LAST HEARD ")
        assert not any("deg" in line for line in screen)
        for _ in range(12):
            app.post_message(events.Key("left", None))
            await asyncio.sleep(REPEAT_S)
        assert daemon.positions["rotation"] == 12.3


class Terminal:
    """A real terminal with ``graderd watch`` in it, and a finger on its keys."""

    def __init__(self, socket: Path) -> None:
        self.person = Person(
            [sys.executable, "-m", "graderd", "--socket", str(socket), "watch"], dict(os.environ), columns_n=80
        )
        self.holding = True

    def hold(self) -> None:
        """Repeat the key and read the screen, as a terminal does, until told otherwise."""
        while self.holding:
            self.person.type(LEFT, enter=False)
            self.person._read(0.001)
            time.sleep(REPEAT_S)


@pytest.mark.live
@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("what", ["the session freezes", "the program is halted"])
async def test_a_frozen_session_stops_the_blade(tmp_path: Path, what: str) -> None:
    """Unmodified processes on a real pseudo-terminal. Frozen in mid-jog, its keys and its screen go nowhere: the blade
    stands within the lease. Thawed, all the keys of that time arrive at once, and move nothing."""
    async with serving(tmp_path) as (daemon, path):
        daemon.state = replace(daemon.state)
        terminal = Terminal(path)
        with terminal.person as person:
            await asyncio.to_thread(person.expect, "SPACE stop", 60.0)
            await asyncio.to_thread(person.expect, "rotation", 30.0)
            person.type("A", enter=False)
            await daemon.until_mode(Mode.MANUAL)
            finger = asyncio.create_task(asyncio.to_thread(terminal.hold))
            await daemon.until(lambda: daemon.positions["rotation"] > 5.0, 30.0)
            terminal.holding = False  # nobody reads its screen and no key comes
            if what == "the program is halted":
                person.freeze()
            clock = AwakeClock()
            frozen_s = last_s = clock.now_s()

            def ended() -> bool:
                nonlocal last_s
                last_s = clock.now_s()
                return daemon.state.lease is None

            await daemon.until(ended, 30.0)
            assert last_s - frozen_s < 1.0
            await finger
            stood_deg = daemon.positions["rotation"]
            for _ in range(100):
                person.type(LEFT, enter=False)  # the backlog, in one piece
            if what == "the program is halted":
                person.process.send_signal(signal.SIGCONT)
            await asyncio.sleep(0.6)
            assert daemon.positions["rotation"] == pytest.approx(stood_deg, abs=0.01)
            assert daemon.state.mode is Mode.MANUAL
            person.type(" ", enter=False)  # and the stop key still works
            await daemon.until_mode(Mode.STOPPED)


@pytest.mark.live
@pytest.mark.slow
@pytest.mark.timeout(120)
async def test_it_ends_with_its_terminal_though_no_signal_tells_it(tmp_path: Path) -> None:
    """As below su or sudo, whose session it is that ends: nothing is left that streams, or holds a pad's lease."""
    async with serving(tmp_path) as (_, path):
        words = shlex.join([sys.executable, "-m", "graderd", "--socket", str(path), "watch"])
        with Person(["sh", "-c", f"trap '' HUP; exec {words}"], dict(os.environ)) as person:
            await asyncio.to_thread(person.expect, "rotation", 60.0)
            person.hang_up()
            await asyncio.to_thread(person.process.wait, 30.0)


def test_without_the_extra_one_line_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from graderd.cli import watch as command
    from graderd.cli.app import run_app

    monkeypatch.setattr(command, "for_people", lambda: True)
    monkeypatch.setitem(sys.modules, "graderd.cli.watch_app", None)
    assert run_app(["watch"]) == 2
    said = capsys.readouterr().err
    assert "pip install 'graderd[terminal]'" in said
    assert said.count("\n") == 1


def test_the_keys_fit_the_narrowest_terminal() -> None:
    assert max(len(KEYS), len(HOLDS)) <= LEAST_COLUMNS_N
