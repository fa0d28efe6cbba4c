"""The node: requests and their NACK, DM1, identification, address violation, commanded address."""

from __future__ import annotations

from itertools import pairwise

import pytest

from graderd.drivers.j1939 import dm1
from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, make_id, pgn_of
from graderd.drivers.j1939.name import Name
from graderd.drivers.j1939.node import Identity, J1939Node
from graderd.drivers.j1939.transport import Control

OURS = Name(identity=1, industry_group=3, function=132, arbitrary_address_capable=1)


def claimed_node(*, obey: bool = False) -> J1939Node:
    node = J1939Node(OURS, 231, identity=Identity(serial_number="7", software="graderd 0.1"), obey_commanded=obey)
    node.start(0.0)
    node.poll(0.25)
    node.take()
    assert node.address == 231
    return node


def request(pgn: int, destination: int, source: int = 40) -> Frame:
    return Frame(make_id(6, Pgn.REQUEST, source, destination), pgn.to_bytes(3, "little"))


def run(node: J1939Node, from_s: float, to_s: float) -> list[Frame]:
    frames = []
    for step in range(round((to_s - from_s) / 0.02)):
        node.poll(from_s + 0.02 * step)
        frames += node.take()
    return frames


def test_an_unknown_group_asked_of_us_is_nacked_and_asked_of_all_is_not() -> None:
    node = claimed_node()
    node.on_frame(request(0xF004, GLOBAL), 1.0)
    assert node.take() == []
    node.on_frame(request(0xF004, 231), 1.0)
    (nack,) = node.take()
    assert nack.can_id == 0x18E8FFE7
    assert nack.data == bytes((1, 0xFF, 0xFF, 0xFF, 40, 0x04, 0xF0, 0x00))


def test_a_request_to_somebody_else_is_none_of_our_business() -> None:
    node = claimed_node()
    node.on_frame(request(0xF004, 19), 1.0)
    assert node.take() == []


def test_claims_are_given_on_request_to_us_and_to_all() -> None:
    for destination in (231, GLOBAL):
        node = claimed_node()
        node.on_frame(request(Pgn.ADDRESS_CLAIMED, destination, NULL), 1.0)
        (claim,) = node.take()
        assert claim == Frame(0x18EEFFE7, OURS.to_bytes())


def test_software_and_component_identification() -> None:
    assert Identity(software="graderd 0.1").software_id() == b"\x01graderd 0.1*"
    node = claimed_node()
    node.on_frame(request(Pgn.COMPONENT_ID, GLOBAL), 1.0)
    frames = node.take() + run(node, 1.0, 2.0)
    assert frames[0].data[0] == Control.BAM
    text = b"".join(f.data[1:] for f in frames if pgn_of(f.can_id) == Pgn.TP_DATA).rstrip(b"\xff")
    assert text == b"graderd*blade controller*7**"
    node.on_frame(request(Pgn.SOFTWARE_ID, 231), 3.0)
    (rts,) = node.take()
    assert rts.can_id == make_id(6, Pgn.TP_CONNECTION, 231, 40)
    assert rts.data[0] == Control.RTS


def test_dm1_every_second_at_once_on_a_change_and_with_eight_bytes() -> None:
    node = claimed_node()
    node.publish([], red=False, now_s=1.0)
    quiet = [f for f in run(node, 1.0, 5.99) if pgn_of(f.can_id) == Pgn.DM1]
    assert len(quiet) == 5
    assert quiet[0] == Frame(0x18FECAE7, bytes((0, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF)))
    fault = dm1.dtc_of("lift_left", "overload")
    node.publish([fault], red=True, now_s=6.1)
    (changed,) = run(node, 6.1, 6.12)
    assert len(changed.data) == 8
    lamps, codes = dm1.decode(changed.data)
    assert lamps == {dm1.Lamp.AMBER_WARNING, dm1.Lamp.RED_STOP}
    assert codes == [fault]


def test_dm1_changes_are_sent_at_once_only_once_a_second() -> None:
    node = claimed_node()
    sent_n = 0
    for step in range(100):  # two seconds, another set of codes every 20 ms
        codes = [dm1.Dtc(520_200, 2)] if step % 2 else []
        node.publish(codes, red=False, now_s=1.0 + 0.02 * step)
        node.poll(1.0 + 0.02 * step)
        sent_n += len(node.take())
    assert sent_n <= 5


def said_of(node: J1939Node, changes: dict[float, list[dm1.Dtc]], until_s: float) -> list[tuple[float, set[dm1.Dtc]]]:
    """What the DM1 of a single frame say, and when, while the active codes change so, polled as the link does."""
    said, active = [], list[dm1.Dtc]()
    for step in range(round((until_s - 1.0) / 0.02) + 1):
        now_s = round(1.0 + 0.02 * step, 3)
        active = changes.get(now_s, active)
        node.publish(active, red=False, now_s=now_s)
        node.poll(now_s)
        said += [(now_s, set(dm1.decode(f.data)[1])) for f in node.take() if pgn_of(f.can_id) == Pgn.DM1]
    return said


@pytest.mark.parametrize("since_change_s", [0.02, 0.3, 0.7, 0.98])
def test_a_code_that_comes_and_goes_between_two_dm1_is_told_once(since_change_s: float) -> None:
    """Where another code had changed in the second before, one that was over within it was never told."""
    one, other = dm1.Dtc(520_200, 2), dm1.Dtc(520_201, 2)
    came_s = round(2.2 + since_change_s, 3)
    changes: dict[float, list[dm1.Dtc]] = {2.2: [one], 2.24: [], came_s: [other], round(came_s + 0.02, 3): []}
    said = said_of(claimed_node(), changes, 6.0)
    assert [at_s for at_s, codes in said if other in codes] == [came_s], "at once: it had not changed for a second"
    assert sum(one in codes for _, codes in said) in (1, 2)
    assert said[-1][1] == set()


def test_a_code_that_flaps_is_told_at_most_once_a_second_and_no_change_of_it_for_good_is_missed() -> None:
    code = dm1.Dtc(520_200, 2)
    changes = {round(2.0 + 0.04 * n, 3): [code] if n % 2 else [] for n in range(50)}
    said = said_of(claimed_node(), changes, 8.0)
    told_s = [at_s for at_s, _ in said if at_s > 2.02]
    assert all(later - at >= 0.99 for at, later in pairwise(told_s))
    assert [bool(codes) for at_s, codes in said if at_s > 5.0] == [True] * 3


def test_what_is_owed_waits_for_a_long_message_under_way_and_for_an_address() -> None:
    node = claimed_node()
    code = dm1.Dtc(520_200, 2)
    node.publish([], red=False, now_s=1.0)
    run(node, 1.0, 1.1)
    long = [dm1.Dtc(520_300 + n, 2) for n in range(8)]
    node.publish(long, red=False, now_s=1.2)
    node.poll(1.2)
    node.publish([*long, code], red=False, now_s=1.24)
    node.publish(long, red=False, now_s=1.26)
    frames = run(node, 1.26, 3.0)
    bodies = b"".join(f.data[1:] for f in frames if pgn_of(f.can_id) == Pgn.TP_DATA)
    assert code.to_bytes() in bodies


def test_several_codes_travel_by_bam() -> None:
    node = claimed_node()
    codes = [dm1.dtc_of("lift_left", "overload"), dm1.dtc_of("can", "bus_off"), dm1.dtc_of("tilt", "no_feedback")]
    node.publish(codes, red=False, now_s=1.0)
    frames = run(node, 1.0, 1.5)
    assert frames[0].data[:4] == bytes((Control.BAM, 14, 0, 2))
    data = b"".join(f.data[1:] for f in frames[1:3])
    assert dm1.decode(data[:14])[1] == sorted(codes, key=lambda code: code.spn)


def test_trouble_codes_of_graderd_are_in_the_proprietary_block_and_differ() -> None:
    devices = ("daemon", "camera", "rotation", "lift_left", "lift_right", "tilt", "can", "servo_bus")
    conditions = ("no_feedback", "overload", "fatal", "something_else")
    codes = {dm1.dtc_of(device, condition) for device in devices for condition in conditions}
    assert len(codes) == len(devices) * len(conditions)
    assert all(520_192 <= code.spn <= 524_287 for code in codes)
    for code in codes:
        assert dm1.Dtc.from_bytes(code.to_bytes()) == code


def test_a_frame_from_our_own_address_is_a_violation_and_answered_with_a_claim() -> None:
    node = claimed_node()
    node.on_frame(Frame(make_id(6, Pgn.PROPRIETARY_A, 231, 19), bytes(8)), 1.0)
    (claim,) = node.take()
    assert claim.can_id == 0x18EEFFE7
    assert node.claimer.violated(1.1)


def test_a_commanded_address_by_bam_is_obeyed_where_configured() -> None:
    for obey in (True, False):
        node = claimed_node(obey=obey)
        data = OURS.to_bytes() + bytes((150,))
        node.on_frame(Frame(make_id(6, Pgn.TP_CONNECTION, 40), bytes((32, 9, 0, 2, 255, 0xD8, 0xFE, 0))), 1.0)
        node.on_frame(Frame(make_id(6, Pgn.TP_DATA, 40), b"\x01" + data[:7]), 1.05)
        node.on_frame(Frame(make_id(6, Pgn.TP_DATA, 40), b"\x02" + data[7:] + b"\xff" * 5), 1.1)
        node.poll(1.5)
        assert node.address == (150 if obey else 231)


def test_requests_without_end_get_answers_with_an_end() -> None:
    node = claimed_node()
    for step in range(2000):
        node.on_frame(request(0xF004, 231), 1.0 + step / 1000)
    assert len(node.take()) <= 10 + 2 * 20
