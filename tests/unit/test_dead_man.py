"""Which key a terminal holds, and which stick a pad: what is late, old, odd or silent holds nothing."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.cli.dead_man import FASTEST_S, LEAST_S, MOST_S, REPEAT_S, HeldKey
from graderd.cli.gamepad import ABS_X, ABS_Y, EV_ABS, EV_KEY, EV_SYN, EVENT, SILENT_S, SYN_DROPPED, Event, Pad, PadState

BTN_TL = 0x136


def repeated(key: str, times_s: list[float]) -> HeldKey:
    hand = HeldKey()
    for at_s in times_s:
        hand.press(key, at_s)
    return hand


def held_from(start_s: float, period_s: float, n: int, delay_s: float = 0.5) -> list[float]:
    """A key as a keyboard repeats it: once, a delay, then again and again."""
    return [start_s, *(start_s + delay_s + i * period_s for i in range(n))]


def test_a_tap_moves_nothing_nor_do_two() -> None:
    assert repeated("left", [1.0]).held(1.01) is None
    assert repeated("left", [1.0, 1.15]).held(1.16) is None, "no finger taps as fast as a keyboard repeats"
    assert repeated("left", [1.0, 1.5]).held(1.51) is None, "the keyboard's first repeat may be a second tap"


@pytest.mark.parametrize(("period_s", "ends_s"), [(0.011, LEAST_S), (0.033, LEAST_S), (0.05, 0.15), (0.1, MOST_S)])
def test_the_shortest_gap_rules_when_a_held_key_was_let_go(period_s: float, ends_s: float) -> None:
    times_s = held_from(1.0, period_s, 20)
    hand = repeated("left", times_s)
    assert hand.held(times_s[-1] + ends_s - 0.005) == "left"
    assert hand.held(times_s[-1] + ends_s + 0.005) is None
    assert hand.held(times_s[-1] + 0.001) is None, "over is over, until it repeats again"


def test_another_key_ends_what_the_first_one_held() -> None:
    hand = repeated("left", held_from(1.0, 0.03, 10))
    hand.press("right", 1.8)
    assert hand.held(1.8) is None


def test_what_a_frozen_connection_hands_over_holds_nothing() -> None:
    """Five seconds of repeats come in one piece when it thaws."""
    hand = repeated("left", held_from(1.0, 0.03, 10))
    assert hand.held(1.78) == "left"
    for number in range(150):
        hand.press("left", 7.0 + number * 0.0001)
        assert hand.held(7.0 + number * 0.0001) is None
    assert hand.held(7.02) is None


def test_a_gap_that_a_busy_computer_makes_in_what_thaws_holds_nothing() -> None:
    hand, now_s = HeldKey(), 7.0
    for number in range(150):
        now_s += 0.02 if number % 3 == 2 else 0.0005
        hand.press("left", now_s)
        assert hand.held(now_s) is None


@given(st.lists(st.floats(0.0, 0.6), min_size=1, max_size=60), st.floats(0.0, 2.0))
def test_nothing_is_held_longer_than_a_quarter_of_a_second(gaps_s: list[float], after_s: float) -> None:
    hand, now_s = HeldKey(), 10.0
    previous_s: list[float] = []
    for gap_s in gaps_s:
        now_s += gap_s
        hand.press("up", now_s)
        if hand.held(now_s) is not None:
            quick = [b - a for a, b in zip(previous_s, [*previous_s[1:], now_s], strict=True)]
            assert any(FASTEST_S <= gap <= REPEAT_S + 1e-9 for gap in quick), "it has repeated as a keyboard does"
        previous_s.append(now_s)
    if after_s > MOST_S:
        assert hand.held(now_s + after_s) is None


def pressed(state: PadState, now_s: float, *, x: int = -32768, y: int = 0, button: int = 1) -> None:
    state.take(Event(now_s, EV_ABS, ABS_X, x), now_s)
    state.take(Event(now_s, EV_ABS, ABS_Y, y), now_s)
    state.take(Event(now_s, EV_KEY, BTN_TL, button), now_s)


def test_a_pad_moves_while_its_button_is_held_and_its_stick_is_out() -> None:
    state = PadState()
    state.take(Event(1.0, EV_ABS, ABS_X, -32768), 1.0)
    assert state.wants(1.0) is None, "no button"
    pressed(state, 1.1)
    assert state.wants(1.1) == "left"
    state.take(Event(1.2, EV_ABS, ABS_X, 32767), 1.2)
    assert state.wants(1.2) == "right"
    for x, y, wants in ((0, 0, None), (0, -32768, "forward"), (0, 32767, "back"), (9000, 9000, None)):
        pressed(state, 1.3, x=x, y=y)
        assert state.wants(1.3) == wants
    pressed(state, 1.4, button=0)
    assert state.wants(1.4) is None


def test_a_silent_pad_releases_and_is_held_again_only_after_its_button_was_let_go() -> None:
    state = PadState()
    pressed(state, 1.0)
    assert state.wants(1.0 + SILENT_S - 0.01) == "left"
    assert state.wants(1.0 + SILENT_S + 0.01) is None
    state.take(Event(3.0, EV_ABS, ABS_X, -32000), 3.0)
    state.take(Event(3.0, EV_KEY, BTN_TL, 2), 3.0)  # the kernel repeats a button; the pad did not say so
    assert state.wants(3.0) is None
    pressed(state, 3.1, button=0)
    pressed(state, 3.2)
    assert state.wants(3.2) == "left"


def test_lost_events_release() -> None:
    state = PadState()
    pressed(state, 1.0)
    state.take(Event(1.1, EV_SYN, SYN_DROPPED, 0), 1.1)
    assert state.wants(1.1) is None


def test_the_devices_own_range_is_the_sticks() -> None:
    state = PadState({ABS_X: (0, 255), ABS_Y: (0, 255)})
    pressed(state, 1.0, x=128, y=128)
    assert state.wants(1.0) is None, "in the middle of 0 to 255"
    pressed(state, 1.1, x=0, y=128)
    assert state.wants(1.1) == "left"


def test_the_bytes_of_an_event_device_and_its_unplugging(tmp_path: Path) -> None:
    """The same bytes through a pipe: this computer has no /dev/uinput to make a device with."""
    assert EVENT.size == struct.calcsize("llHHi")
    fifo = tmp_path / "event0"
    os.mkfifo(fifo)
    pad = Pad(fifo)
    other_end = os.open(fifo, os.O_RDWR)
    assert "shoulder" in pad.open()
    for kind, code, value in ((EV_ABS, ABS_X, 32767), (EV_KEY, BTN_TL, 1), (EV_SYN, 0, 0)):
        os.write(other_end, EVENT.pack(100, 5000, kind, code, value))
    assert pad.wants(50.0) == "right"
    assert pad.wants(50.5) == "right"
    os.close(other_end)  # pulled
    assert pad.wants(50.6) is None
    assert pad.wants(50.7) is None
    assert "No such file" in Pad(tmp_path / "nothing").open()
