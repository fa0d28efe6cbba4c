"""The byte level of Protocol 2.0, against the e-manual's examples, the SDK's CRC and everything hypothesis invents."""

from __future__ import annotations

import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.dynamixel.codec import (
    FastReply,
    Instruction,
    Packet,
    StreamDecoder,
    crc16,
    encode,
    encode_fast_status,
    encode_status,
    split_fast_status,
)

# Example packets as printed in the ROBOTIS e-manual, page "DYNAMIXEL Protocol 2.0".
VALID = {
    "ping": "FF FF FD 00 01 03 00 01 19 4E",
    "ping status": "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D",
    "ping broadcast": "FF FF FD 00 FE 03 00 01 31 42",
    "ping status of id 2": "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D",
    "read": "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15",
    "read status": "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0",
    "write": "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
    "write status": "FF FF FD 00 01 04 00 55 00 A1 0C",
    "reg write": "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E",
    "action": "FF FF FD 00 01 03 00 05 02 CE",
    "factory reset": "FF FF FD 00 01 04 00 06 01 A1 E6",
    "reboot": "FF FF FD 00 01 03 00 08 2F 4E",
    "clear": "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC",
    "control table backup": "FF FF FD 00 01 08 00 20 01 43 54 52 4C 16 F5",
    "sync read": "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    "sync read status": "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE",
    "sync write": "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    "fast sync read": "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
    "bulk read": "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    "bulk read status 1": "FF FF FD 00 01 06 00 55 00 77 00 C3 69",
    "bulk read status 2": "FF FF FD 00 02 05 00 55 00 24 8B A9",
    "bulk write": "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68",
    "fast sync status": "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA "
    "00 04 FF 03 00 00 D1 9E",
    "fast bulk status": "FF FF FD 00 FE 14 00 55 00 03 A6 00 00 00 67 A4 00 07 A5 01 24 74 00 04 1F D9 C1",
}
# Two more are misprints there: with the right CRC (second column) they are good packets.
MISPRINTS = {
    "control table restore": ("FF FF FD 00 01 08 00 20 02 43 54 52 4C 92 F5", "9E F5"),
    "fast bulk read": (
        "FF FF FD 00 FE 12 00 9A 03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00 20 F2",
        "DA 2D",
    ),
}


def decode(data: bytes) -> list[Packet]:
    return StreamDecoder().feed(data)


@pytest.mark.parametrize("name", VALID)
def test_every_valid_example_of_the_manual_decodes_and_encodes_to_the_same_bytes(name: str) -> None:
    raw = bytes.fromhex(VALID[name])
    (packet,) = decode(raw)
    assert packet.raw == raw
    assert encode(packet.packet_id, packet.instruction, packet.params) == raw


@pytest.mark.parametrize("name", MISPRINTS)
def test_the_two_misprints_are_refused_and_right_with_the_right_checksum(name: str) -> None:
    printed, right = (bytes.fromhex(h) for h in MISPRINTS[name])
    decoder = StreamDecoder()
    assert decoder.feed(printed) == []
    assert decoder.crc_errors_n == 1
    (packet,) = decode(printed[:-2] + right)
    assert encode(packet.packet_id, packet.instruction, packet.params) == printed[:-2] + right


def test_fast_status_examples_split_into_their_shares() -> None:
    (sync,) = decode(bytes.fromhex(VALID["fast sync status"]))
    assert [(r.packet_id, r.error, int.from_bytes(r.data, "little")) for r in split_fast_status(
        sync, [(3, 4), (7, 4), (4, 4)]
    )] == [(3, 0, 166), (7, 0, 2079), (4, 0, 1023)]  # fmt: skip
    (bulk,) = decode(bytes.fromhex(VALID["fast bulk status"]))
    shares = split_fast_status(bulk, [(3, 4), (7, 2), (4, 1)])
    assert [(r.packet_id, int.from_bytes(r.data, "little")) for r in shares] == [(3, 166), (7, 421), (4, 31)]
    assert encode_fast_status(shares) == bulk.raw


@pytest.mark.parametrize("expected", [[(3, 4), (7, 4)], [(3, 4), (7, 4), (5, 4)], [(3, 8), (7, 4)], []])
def test_a_fast_status_that_does_not_fit_the_request_is_refused(expected: list[tuple[int, int]]) -> None:
    (packet,) = decode(bytes.fromhex(VALID["fast sync status"]))
    with pytest.raises(ValueError, match="fast status"):
        split_fast_status(packet, expected)


def test_damage_inside_a_fast_status_is_found_in_the_share_although_the_last_checksum_is_made_right() -> None:
    raw = bytearray.fromhex(VALID["fast sync status"])
    raw[11] ^= 0x10
    raw[-2:] = crc16(raw[:-2]).to_bytes(2, "little")
    (packet,) = decode(bytes(raw))
    with pytest.raises(ValueError, match="servo 3"):
        split_fast_status(packet, [(3, 4), (7, 4), (4, 4)])


def test_checksum_check_value() -> None:
    assert crc16(b"123456789") == 0xFEE8


@given(st.binary(max_size=80))
def test_checksum_equals_the_sdks(data: bytes) -> None:
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, list(data), len(data))


def test_stuffing_of_the_goal_that_needs_it() -> None:
    # Goal -131073 is FF FF FD FF; bytes as the C++ SDK sends them.
    raw = encode(1, Instruction.WRITE, (564).to_bytes(2, "little") + (-131073).to_bytes(4, "little", signed=True))
    assert raw == bytes.fromhex("FF FF FD 00 01 0A 00 03 34 02 FF FF FD FD FF 23 51")


_nasty = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=60).map(bytes)
_payload = st.one_of(st.binary(max_size=120), _nasty)
_ids = st.one_of(st.integers(0, 252), st.just(254))


@given(_ids, st.sampled_from(list(Instruction)), _payload)
def test_what_is_encoded_is_decoded(packet_id: int, instruction: Instruction, params: bytes) -> None:
    if instruction is Instruction.STATUS and (packet_id == 254 or not params):
        return  # fast status packets are not stuffed; a status has an error byte
    (packet,) = decode(encode(packet_id, instruction, params))
    assert (packet.packet_id, packet.instruction, packet.params) == (packet_id, instruction, params)
    assert packet.raw.find(b"\xff\xff\xfd", 3, -2) in (-1, packet.raw.find(b"\xff\xff\xfd\xfd", 3, -2))


@given(st.lists(st.tuples(st.integers(0, 252), _nasty), max_size=6), st.data())
def test_chunks_do_not_matter(messages: list[tuple[int, bytes]], data: st.DataObject) -> None:
    stream = b"".join(encode_status(i, 0, p) for i, p in messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    decoder = StreamDecoder()
    got = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        got += decoder.feed(stream[begin:end])
    assert [(p.packet_id, p.data) for p in got] == messages
    assert decoder.stray_n == decoder.crc_errors_n == decoder.pending_n == 0


@given(st.binary(max_size=40), st.integers(0, 252), _payload, st.binary(max_size=10))
def test_a_good_packet_is_found_behind_debris(junk: bytes, packet_id: int, payload: bytes, tail: bytes) -> None:
    good = encode_status(packet_id, 0, payload)
    flushed = StreamDecoder(max_length=600)
    got = flushed.feed(junk + good + tail + bytes(700))
    assert any(p.raw == good for p in got)


@given(st.integers(0, 252), _payload, st.data())
def test_a_damaged_packet_is_never_taken_for_the_original(packet_id: int, payload: bytes, data: st.DataObject) -> None:
    raw = bytearray(encode_status(packet_id, 0, payload))
    # Up to a burst of 16 bits a 16-bit CRC finds all damage.
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] ^= data.draw(st.integers(1, 255))
    for packet in decode(bytes(raw)):
        assert crc16(packet.raw[:-2]) == int.from_bytes(packet.raw[-2:], "little")
        assert packet.raw != bytes(raw)


@given(st.binary(max_size=400))
def test_any_bytes_are_survived(data: bytes) -> None:
    decoder = StreamDecoder(max_length=300)
    packets = decoder.feed(data)
    assert sum(len(p.raw) for p in packets) + decoder.stray_n + decoder.pending_n == len(data)
    for packet in packets:
        if packet.is_status:
            assert packet.params
            assert 0 <= packet.error <= 127


def test_reset_counts_what_it_throws_away() -> None:
    decoder = StreamDecoder()
    decoder.feed(bytes.fromhex(VALID["ping"])[:6])
    assert decoder.reset() == 6
    assert decoder.stray_n == 6
    assert len(decoder.feed(bytes.fromhex(VALID["ping"]))) == 1


@pytest.mark.parametrize("packet_id", [-1, 253, 255, 256])
def test_illegal_ids_are_not_encoded(packet_id: int) -> None:
    with pytest.raises(ValueError, match="id"):
        encode(packet_id, Instruction.PING)


def test_a_packet_too_long_for_its_length_field_is_not_encoded() -> None:
    with pytest.raises(ValueError, match="fit"):
        encode(1, Instruction.WRITE, bytes(70_000))


def test_fast_status_round_trip_without_stuffing() -> None:
    replies = [FastReply(1, 0x80, b"\xff\xff\xfd\xff"), FastReply(9, 0, b"\xff\xff\xfd\xfd")]
    (packet,) = decode(encode_fast_status(replies))
    assert split_fast_status(packet, [(1, 4), (9, 4)]) == replies
