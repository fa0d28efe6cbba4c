"""Address claim: who keeps an address, how long one waits, and that nobody can make us storm."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.j1939.claim import SELF_CONFIGURABLE, VETO_S, AddressClaimer, ClaimState
from graderd.drivers.j1939.ids import NULL, Frame, Pgn, pgn_of, source_of
from graderd.drivers.j1939.name import Name

OURS = Name(identity=5, industry_group=3, function=132, arbitrary_address_capable=1)
LOWER, HIGHER = OURS.value - 1, OURS.value + 1


def claims(frames: list[Frame]) -> list[int]:
    return [source_of(f.can_id) for f in frames if pgn_of(f.can_id) == Pgn.ADDRESS_CLAIMED]


def claimed(name: Name = OURS, address: int = 231, **changes: bool) -> AddressClaimer:
    claimer = AddressClaimer(name, address, seed=1, **changes)
    claimer.start(0.0)
    claimer.poll(VETO_S)
    assert claimer.state is ClaimState.CLAIMED
    return claimer


def test_it_asks_who_is_there_then_claims_and_waits_250_ms() -> None:
    claimer = AddressClaimer(OURS, 231)
    frames = claimer.start(0.0)
    assert [f.can_id for f in frames] == [0x18EAFFFE, 0x18EEFFE7]
    assert frames[0].data == bytes.fromhex("00EE00")
    assert frames[1].data == OURS.to_bytes()
    claimer.poll(0.249)
    assert claimer.address is None
    claimer.poll(0.25)
    assert claimer.address == 231


@pytest.mark.parametrize("address", [0, 19, 127, 248, 253])
def test_fixed_addresses_may_be_used_at_once(address: int) -> None:
    claimer = AddressClaimer(OURS, address)
    claimer.start(0.0)
    assert claimer.address == address


def test_against_a_higher_name_it_claims_again_and_keeps_the_address() -> None:
    claimer = claimed()
    assert claims(claimer.on_claim(231, HIGHER, 1.0)) == [231]
    assert claimer.address == 231


def test_against_a_lower_name_it_takes_a_self_configurable_address() -> None:
    claimer = claimed()
    claimer.on_claim(128, 7, 0.5)  # 128 is taken by somebody
    assert claims(claimer.on_claim(231, LOWER, 1.0)) == [129]
    assert claimer.address is None  # the 250 ms hold for the new address too
    claimer.poll(1.0 + VETO_S)
    assert claimer.address == 129


def test_it_loses_while_still_waiting_just_the_same() -> None:
    claimer = AddressClaimer(OURS, 231)
    claimer.start(0.0)
    assert claims(claimer.on_claim(231, LOWER, 0.1)) == [128]


def test_without_the_arbitrary_address_bit_the_loser_says_so_after_a_random_delay_and_is_silent() -> None:
    claimer = claimed(Name(identity=5, industry_group=3, function=132))
    assert claimer.on_claim(231, 1, 1.0) == []
    assert claimer.state is ClaimState.CANNOT_CLAIM
    assert claimer.address is None
    assert claimer.poll(1.0) == []
    late = claimer.poll(1.153)
    assert claims(late) == [NULL]
    assert claimer.poll(5.0) == []
    claimer.on_request(6.0)
    assert claims(claimer.poll(6.153)) == [NULL], "a request for claims is answered with cannot claim"


def test_after_ten_seconds_a_node_without_address_tries_again() -> None:
    claimer = claimed(Name(identity=5, industry_group=3, function=132))
    claimer.on_claim(231, 1, 1.0)
    claimer.poll(1.2)
    assert claims(claimer.poll(11.0)) == [231]
    claimer.poll(11.25)
    assert claimer.address == 231


def test_all_addresses_taken_ends_in_cannot_claim() -> None:
    claimer = claimed()
    for address in SELF_CONFIGURABLE:
        claimer.on_claim(address, 1000 + address, 0.5)
    claimer.on_claim(231, LOWER, 1.0)
    assert claimer.state is ClaimState.CANNOT_CLAIM


def test_a_node_that_moved_leaves_its_address_free() -> None:
    claimer = claimed()
    claimer.on_claim(128, 7, 0.5)
    claimer.on_claim(140, 7, 0.6)
    assert claims(claimer.on_claim(231, LOWER, 1.0)) == [128]


def test_requests_for_claims_are_answered() -> None:
    assert claims(claimed().on_request(1.0)) == [231]


def test_a_claim_that_is_owed_is_put_off_and_never_dropped() -> None:
    """Else the one who asked, or who claimed our address with a higher NAME, believes that it is free."""
    for ask in (lambda c, t: c.on_request(t), lambda c, t: c.on_claim(231, HIGHER, t)):
        claimer = claimed()
        for _ in range(8):
            claimer.on_request(1.0)
        assert claims(ask(claimer, 1.01)) == [], "the bucket is empty"
        later = [frame for step in range(15) for frame in claimer.poll(1.02 + 0.02 * step)]
        assert claims(later) == [231], "owed once, however often it was asked for"
        assert [frame for step in range(100) for frame in claimer.poll(2.0 + 0.02 * step)] == []


def test_a_cannot_claim_that_is_owed_is_put_off_and_never_dropped() -> None:
    claimer = claimed(Name(identity=5, industry_group=3, function=132))
    for _ in range(8):
        claimer.on_request(1.0)
    claimer.on_claim(231, 1, 1.0)
    assert claims([frame for step in range(60) for frame in claimer.poll(1.0 + 0.02 * step)]) == [NULL]


def test_a_putting_off_is_forgotten_with_the_address_it_was_about() -> None:
    claimer = claimed()
    for _ in range(8):
        claimer.on_request(1.0)
    claimer.on_claim(231, LOWER, 1.0)
    sent = [frame for step in range(100) for frame in claimer.poll(1.0 + 0.02 * step)]
    assert claims(sent) == [128]


def test_an_address_violation_is_answered_with_a_claim_at_most_every_five_seconds() -> None:
    claimer = claimed()
    sent = [len(claimer.on_violation(1.0 + 0.1 * i)) for i in range(100)]
    assert sum(sent) == 2
    assert claimer.violated(10.9)
    assert not claimer.violated(30.0)


@pytest.mark.parametrize("obey", [True, False])
def test_a_commanded_address_is_obeyed_or_ignored_as_configured(obey: bool) -> None:
    claimer = claimed(obey_commanded=obey)
    frames = claimer.on_commanded(OURS.value, 150, 1.0)
    assert claims(frames) == ([150] if obey else [])
    claimer.poll(1.25)
    assert claimer.address == (150 if obey else 231)
    assert claimer.on_commanded(OURS.value ^ 1, 151, 2.0) == [], "meant for another node"
    assert claimer.on_commanded(OURS.value, 254, 2.0) == [], "no address"


def test_equal_names_do_not_answer_each_other_without_end_and_are_reported() -> None:
    ours, theirs = claimed(), claimed()
    bus = [(theirs, f) for f in ours.on_request(1.0)]
    carried_n = 0
    now_s = 1.0
    while bus and carried_n < 10_000:
        now_s += 0.0006  # a claim takes about 0.6 ms at 250 kbit/s
        to, frame = bus.pop(0)
        carried_n += 1
        answers = to.on_claim(source_of(frame.can_id), int.from_bytes(frame.data, "little"), now_s)
        bus += [(ours if to is theirs else theirs, f) for f in answers]
    assert carried_n <= 6
    assert ours.equal_name_seen(now_s)
    assert ours.address == 231


def test_a_storm_of_claims_makes_no_storm_of_ours() -> None:
    claimer = claimed()
    sent_n = sum(len(claimer.on_claim(231, HIGHER, 1.0 + i / 2000)) for i in range(3000))
    assert sent_n <= 3 + 1.5 / VETO_S
    assert claimer.storming(2.5)
    assert not claimer.storming(10.0)


def test_a_thief_of_every_address_cannot_make_us_storm_either() -> None:
    claimer = claimed()
    sent_n, now_s = 0, 1.0
    for _ in range(2000):
        now_s += 0.001
        sent_n += len(claimer.on_claim(claimer.wanted, 1, now_s)) + len(claimer.poll(now_s))
    assert sent_n <= 3 + 2.0 / VETO_S


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 2**64 - 1), st.floats(0, 1)), max_size=60))
def test_whatever_is_claimed_it_never_uses_an_address_it_lost(events: list[tuple[int, int, float]]) -> None:
    claimer = claimed()
    now_s = 1.0
    for source, name, wait_s in events:
        now_s += wait_s
        claimer.poll(now_s)
        claimer.on_claim(source, name, now_s)
        if claimer.address == source:
            assert name >= OURS.value
        assert claimer.address is None or 0 <= claimer.address <= 253
