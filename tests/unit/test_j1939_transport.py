"""Transport protocol: both directions, both kinds, lost and wrong packets, bounded sessions."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.j1939.ids import GLOBAL, Frame, Pgn, destination_of, make_id, pgn_of, source_of
from graderd.drivers.j1939.transport import (
    BAM_GAP_S,
    DATA_BURST_N,
    DATA_RATE_HZ,
    MAX_SESSIONS_N,
    Abort,
    Control,
    Message,
    Transport,
)


def node(address: int) -> Transport:
    transport = Transport()
    transport.address = address
    return transport


def feed(to: Transport, frame: Frame, now_s: float) -> tuple[list[Frame], Message | None]:
    pgn, source, destination = pgn_of(frame.can_id), source_of(frame.can_id), destination_of(frame.can_id)
    if pgn == Pgn.TP_CONNECTION:
        return to.on_connection(source, destination, frame.data, now_s), None
    return to.on_data(source, destination, frame.data, now_s)


def converse(sender: Transport, receiver: Transport, frames: list[Frame], seconds: float = 120.0) -> list[Message]:
    """Carry frames between two nodes, moving time in steps of 10 ms."""
    nodes = {sender.address: sender, receiver.address: receiver}
    messages: list[Message] = []
    now_s = 0.0
    while now_s < seconds:
        for frame in frames:
            source = source_of(frame.can_id)
            other = receiver if nodes[source] is sender else sender
            answers, message = feed(other, frame, now_s)
            frames = [*frames[1:], *answers]
            messages += [message] if message else []
            break
        else:
            now_s += 0.01
            frames = [*sender.poll(now_s), *receiver.poll(now_s)]
    return messages


@pytest.mark.parametrize("size", [9, 14, 15, 100, 1785])
@pytest.mark.parametrize("destination", [GLOBAL, 20])
def test_every_size_arrives_whole_by_bam_and_by_rts_cts(size: int, destination: int) -> None:
    data = bytes(i % 251 for i in range(size))
    sender, receiver = node(10), node(20)
    messages = converse(sender, receiver, sender.send(Pgn.COMPONENT_ID, data, destination, 0.0), seconds=20.0)
    assert messages == [Message(Pgn.COMPONENT_ID, 10, destination, data)]
    assert sender.aborted_n == receiver.aborted_n == 0


def test_bam_packets_are_at_least_50_ms_apart_and_padded() -> None:
    sender = node(10)
    first = sender.send(Pgn.DM1, bytes(range(20)), GLOBAL, 0.0)
    assert first[0].data == bytes((32, 20, 0, 3, 255, 0xCA, 0xFE, 0x00))
    times, packets = [], []
    for step in range(100):
        for frame in sender.poll(step * 0.01):
            times.append(step * 0.01)
            packets.append(frame)
    assert len(packets) == 3
    assert min(b - a for a, b in zip([0.0, *times], times, strict=False)) >= BAM_GAP_S - 1e-9
    assert packets[-1].data == bytes((3, *range(14, 20), 0xFF))


def test_a_lost_packet_ends_a_bam_session_without_a_word_and_a_connection_with_an_abort() -> None:
    for destination in (GLOBAL, 20):
        receiver = node(20)
        control = Control.BAM if destination == GLOBAL else Control.RTS
        receiver.on_connection(10, destination, bytes((control, 20, 0, 3, 255, 0xEB, 0xFE, 0)), 0.0)
        receiver.on_data(10, destination, bytes((1, *range(7))), 0.1)
        frames, message = receiver.on_data(10, destination, bytes((3, *range(7))), 0.2)
        assert message is None
        if destination == GLOBAL:
            assert frames == []
        else:
            assert frames[0].data[:2] == bytes((Control.ABORT, Abort.BAD_SEQUENCE))


def test_silence_in_the_middle_times_out() -> None:
    receiver = node(20)
    receiver.on_connection(10, 20, bytes((Control.RTS, 20, 0, 3, 255, 0xEB, 0xFE, 0)), 0.0)
    assert receiver.poll(1.0) == []
    (abort,) = receiver.poll(1.3)
    assert abort.data[:2] == bytes((Control.ABORT, Abort.TIMEOUT))
    sender = node(10)
    sender.send(Pgn.COMPONENT_ID, bytes(20), 20, 0.0)
    (abort,) = sender.poll(1.3)
    assert abort.data[:2] == bytes((Control.ABORT, Abort.TIMEOUT))


def test_the_senders_window_is_respected() -> None:
    receiver = node(20)
    (cts,) = receiver.on_connection(10, 20, bytes((Control.RTS, 70, 0, 10, 4, 0xEB, 0xFE, 0)), 0.0)
    assert cts.data[:3] == bytes((Control.CTS, 4, 1))
    for n in range(1, 4):
        assert receiver.on_data(10, 20, bytes((n, *range(7))), 0.1)[0] == []
    (cts,) = receiver.on_data(10, 20, bytes((4, *range(7))), 0.1)[0]
    assert cts.data[:3] == bytes((Control.CTS, 4, 5))


def test_a_cts_of_zero_means_wait_and_one_beyond_the_end_is_refused() -> None:
    sender = node(10)
    sender.send(Pgn.COMPONENT_ID, bytes(20), 20, 0.0)
    about = Pgn.COMPONENT_ID.to_bytes(3, "little")
    assert sender.on_connection(20, 10, bytes((Control.CTS, 0, 1, 255, 255)) + about, 0.1) == []
    (abort,) = sender.on_connection(20, 10, bytes((Control.CTS, 1, 9, 255, 255)) + about, 0.2)
    assert abort.data[0] == Control.ABORT


def test_clear_to_send_without_end_draws_packets_with_an_end() -> None:
    """1,000 CTS drew 4,000 frames. The standard lets a packet be asked for three times in all."""
    sender = node(10)
    sender.send(Pgn.COMPONENT_ID, bytes(28), 20, 0.0)
    about = Pgn.COMPONENT_ID.to_bytes(3, "little")
    frames: list[Frame] = []
    for step in range(1000):
        frames += sender.on_connection(20, 10, bytes((Control.CTS, 4, 1, 255, 255)) + about, 0.001 * step)
        frames += sender.poll(0.001 * step)
    packets = [frame for frame in frames if pgn_of(frame.can_id) == Pgn.TP_DATA]
    assert len(packets) <= 3 * 4
    assert frames[-1].data[:2] == bytes((Control.ABORT, Abort.RETRANSMITS))
    assert len(frames) == len(packets) + 1


def test_packets_leave_no_faster_than_their_rate() -> None:
    sender = node(10)
    about = Pgn.COMPONENT_ID.to_bytes(3, "little")
    sent_n = 0
    for destination in range(20, 20 + MAX_SESSIONS_N):
        sender.send(Pgn.COMPONENT_ID, bytes(1785), destination, 0.0)
        sent_n += len(sender.on_connection(destination, 10, bytes((Control.CTS, 255, 1, 255, 255)) + about, 0.0))
    for step in range(1, 101):
        sent_n += len(sender.poll(0.01 * step))
    assert sent_n <= DATA_BURST_N + DATA_RATE_HZ * 1.0


def test_requests_to_send_without_end_are_not_all_answered() -> None:
    receiver = node(20)
    rts = bytes((Control.RTS, 20, 0, 3, 255, 0xEB, 0xFE, 0))
    answers_n = sum(len(receiver.on_connection(10, 20, rts, 0.001 * step)) for step in range(2000))
    assert answers_n <= 20 + 2 * 50


@pytest.mark.parametrize("size", [0, 8, 1786, 65535])
def test_sizes_that_cannot_be_are_aborted_or_ignored(size: int) -> None:
    receiver = node(20)
    head = size.to_bytes(2, "little") + bytes((1, 255, 0xEB, 0xFE, 0))
    assert receiver.on_connection(10, GLOBAL, bytes((Control.BAM,)) + head, 0.0) == []
    (abort,) = receiver.on_connection(10, 20, bytes((Control.RTS,)) + head, 0.0)
    assert abort.data[0] == Control.ABORT
    with pytest.raises(ValueError, match="9 to 1785"):
        receiver.send(Pgn.DM1, bytes(size), GLOBAL, 0.0)


def test_sessions_are_bounded() -> None:
    receiver = node(200)
    head = bytes((20, 0, 3, 255, 0xEB, 0xFE, 0))
    for source in range(100):
        receiver.on_connection(source, GLOBAL, bytes((Control.BAM,)) + head, 0.0)
    (abort,) = receiver.on_connection(150, 200, bytes((Control.RTS,)) + head, 0.0)
    assert abort.data[:2] == bytes((Control.ABORT, Abort.RESOURCES))
    assert len(receiver._incoming) == MAX_SESSIONS_N


@given(
    st.lists(
        st.tuples(st.booleans(), st.integers(0, 3), st.sampled_from([GLOBAL, 20]), st.binary(max_size=8)), max_size=80
    )
)
def test_arbitrary_frames_never_raise_and_never_pile_up(frames: list[tuple[bool, int, int, bytes]]) -> None:
    receiver = node(20)
    for index, (is_control, source, destination, data) in enumerate(frames):
        pgn = Pgn.TP_CONNECTION if is_control else Pgn.TP_DATA
        feed(receiver, Frame(make_id(7, pgn, source, destination), data), index * 0.01)
        receiver.poll(index * 0.01)
    assert len(receiver._incoming) <= MAX_SESSIONS_N
