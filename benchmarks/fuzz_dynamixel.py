"""Damage for the Dynamixel decoders: ``python benchmarks/fuzz_dynamixel.py [--strings N] [--seed N] [--json]``.

Each byte string goes into the client's side (decoder, then the bus's own checks of id and length, then the splitting
of fast replies) or into the servo's side (decoder, then execution by a virtual servo). Counted are exceptions that
escape, and replies accepted although the string is not the original.

What the checksum is sure to find (a burst of up to 16 bits before it, up to three flipped bits anywhere, cut ends) must
never be accepted. Other damage (random bytes, bytes inserted or removed, several bursts) is a valid packet once in
65,536 candidates by arithmetic, a burst into the checksum (whose bytes travel in the other order) somewhat more often.
Such a packet is valid for every implementation of the protocol; how often it happened is printed.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter
from collections.abc import Callable

from graderd.drivers.dynamixel.codec import (
    FastReply,
    Instruction,
    Packet,
    StreamDecoder,
    encode,
    encode_fast_status,
    encode_status,
    split_fast_status,
)
from graderd.simulator.servo import VirtualServo
from graderd.simulator.servo.line import answers

FAST_LAYOUT = [(1, 4), (3, 4)]
SURE = ("burst", "bits", "cut")


def _burst(raw: bytes, rng: random.Random) -> bytes:
    return _flipped(raw[:-2], rng) + raw[-2:]


def _burst_at_end(raw: bytes, rng: random.Random) -> bytes:
    return raw[:-4] + _flipped(raw[-4:], rng)


def _flipped(raw: bytes, rng: random.Random) -> bytes:
    """One burst: up to 16 bits of which the first and the last are wrong."""
    width = rng.randint(1, 16)
    pattern = (rng.getrandbits(width) | 1 | 1 << (width - 1)) << rng.randrange(len(raw) * 8 - width + 1)
    return (int.from_bytes(raw, "big") ^ pattern).to_bytes(len(raw), "big")


def _bits(raw: bytes, rng: random.Random) -> bytes:
    value = int.from_bytes(raw, "big")
    for at in rng.sample(range(len(raw) * 8), rng.randint(1, 3)):
        value ^= 1 << at
    return value.to_bytes(len(raw), "big")


def _cut(raw: bytes, rng: random.Random) -> bytes:
    return raw[: rng.randrange(len(raw))]


def _insert(raw: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(raw))
    return raw[:at] + rng.randbytes(rng.randint(1, 4)) + raw[at:]


def _remove(raw: bytes, rng: random.Random) -> bytes:
    at, width = rng.randrange(len(raw)), rng.randint(1, 4)
    return raw[:at] + raw[at + width :] + rng.randbytes(width)


def _bursts(raw: bytes, rng: random.Random) -> bytes:
    return _flipped(_flipped(raw, rng), rng)


def _noise(raw: bytes, rng: random.Random) -> bytes:
    return rng.randbytes(len(raw) + rng.randint(0, 20))


def _header_noise(raw: bytes, rng: random.Random) -> bytes:
    return raw[: rng.randint(4, 8)] + rng.randbytes(rng.randint(0, 60))


KINDS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "burst": _burst,
    "burst_at_end": _burst_at_end,
    "bits": _bits,
    "cut": _cut,
    "insert": _insert,
    "remove": _remove,
    "bursts": _bursts,
    "noise": _noise,
    "header_noise": _header_noise,
}


def _originals(rng: random.Random) -> tuple[list[bytes], list[bytes]]:
    """Good packets of both directions, many with bytes that need stuffing."""
    nasty = (b"\xff\xff\xfd\xff", b"\xff\xff\xfd\xfd", b"\xff\xff\xfd\x00", b"\xff" * 4, bytes(4))
    replies = [encode_status(1, 0, data) for data in (*nasty, b"", rng.randbytes(25), rng.randbytes(4))]
    replies.append(encode_fast_status([FastReply(i, 0, rng.randbytes(n)) for i, n in FAST_LAYOUT]))
    requests = [encode(1, Instruction.WRITE, b"\x34\x02" + data) for data in nasty]
    requests += [
        encode(1, Instruction.READ, b"\x3a\x02\x19\x00"),
        encode(1, Instruction.PING),
        encode(254, Instruction.SYNC_READ, b"\x44\x02\x04\x00\x01\x03"),
        encode(254, Instruction.BULK_READ, bytes((1, 0, 2, 1, 0, 3, 0, 2, 2, 0))),
        encode(254, Instruction.SYNC_WRITE, b"\x01\x02\x01\x00\x01\x05\x03\x06"),
        encode(1, Instruction.REG_WRITE, b"\x01\x02\x07"),
    ]
    return replies, requests


def _client_accepts(data: bytes, original: bytes) -> bool:
    """Whether the client's side takes a wrong value from ``data``."""
    (good,) = StreamDecoder().feed(original)
    accepted = False
    for packet in StreamDecoder().feed(data + bytes(40)):
        if not packet.is_status or packet.packet_id != good.packet_id or packet.error:
            continue
        if packet.packet_id == 254:
            try:
                split_fast_status(packet, FAST_LAYOUT)
            except ValueError:
                continue
            accepted |= packet.raw != original
        elif len(packet.data) == len(good.data):
            accepted |= packet.data != good.data
    return accepted


def _servo_accepts(servos: tuple[VirtualServo, ...], data: bytes, original: bytes, at_s: float) -> bool:
    """Whether the servo's side carries out something else than the original."""
    packets: list[Packet] = StreamDecoder().feed(data + bytes(40))
    for packet in packets:
        answers(servos, packet, at_s)
    return any(not p.is_status and p.raw != original for p in packets)


def run(strings_n: int, seed: int) -> dict[str, object]:
    """Feed ``strings_n`` strings, half to each side; the counts as plain data."""
    rng = random.Random(seed)
    replies, requests = _originals(rng)
    servos = (VirtualServo(1), VirtualServo(3))
    fed: Counter[str] = Counter()
    accepted: Counter[str] = Counter()
    escaped: Counter[str] = Counter()
    kinds = list(KINDS)
    began_s = time.monotonic()
    for index in range(strings_n):
        kind = kinds[rng.randrange(len(kinds))]
        client = index % 2 == 0
        original = rng.choice(replies if client else requests)
        data = KINDS[kind](original, rng)
        if data == original:
            continue
        fed[kind] += 1
        try:
            wrong = _client_accepts(data, original) if client else _servo_accepts(servos, data, original, index * 1e-4)
        except Exception as e:  # exactly what is being looked for
            escaped[f"{kind}: {e!r}"] += 1
            continue
        accepted[kind] += wrong
    return {
        "strings_n": strings_n,
        "seed": seed,
        "seconds": round(time.monotonic() - began_s, 1),
        "fed_n": dict(fed),
        "wrong_accepted_n": {kind: accepted[kind] for kind in kinds},
        "wrong_by_arithmetic_n": round(sum(n for kind, n in fed.items() if kind not in SURE) / 65_536, 1),
        "escaped": dict(escaped),
        "ok": not escaped and not any(accepted[kind] for kind in SURE),
    }


def main() -> int:
    """Entry point; status 1 where something escaped or was wrongly accepted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strings", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    result = run(args.strings, args.seed)
    if args.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key}: {value}")
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
