"""What an adapter hands back of our own is told from what another node sends."""

from __future__ import annotations

from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.link import SelfReception

FRAMES = [Frame(0x18EF13E7, bytes((n, *[0] * 7))) for n in range(200)]


def test_an_adapter_that_hands_back_everything() -> None:
    own = SelfReception()
    for n, frame in enumerate(FRAMES):
        own.on_sent(frame, 0.1 * n)
        assert own.is_echo(frame, 0.1 * n + 0.01)
        assert not own.is_echo(frame, 0.1 * n + 0.01), "the second time it is somebody else's"


def test_an_adapter_that_hands_back_nothing_and_a_node_that_sends_what_we_send() -> None:
    own = SelfReception()
    own.on_sent(FRAMES[0], 0.0)
    for n in range(1, 50):
        own.on_sent(FRAMES[n], 0.1 * n)
        assert not own.is_echo(FRAMES[n], 0.1 * n + 0.01)


def test_frames_that_never_left_end_the_belief_until_many_came_back_in_a_row() -> None:
    own = SelfReception()
    own.on_sent(FRAMES[0], 0.0)
    assert own.is_echo(FRAMES[0], 0.01)
    own.on_sent(FRAMES[1], 1.0)
    told = []
    for n in range(2, 100):
        own.on_sent(FRAMES[n], 1.0 + n)
        told.append(own.is_echo(FRAMES[n], 1.01 + n))
    assert told == [False] * 63 + [True] * 35
