"""The bus side against peers we did not write: the kernel's J1939 stack and can-utils."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from hil import bus
from hil.bus import ADDRESS_CLAIMED, KernelNode, RawBus, daemons_claim
from hil.service import Grader, Rig, faults, run, wait_for
from tests.hil.conftest import STOP_PGN, bus_users

WIRE = "wire0"
DUMPED = "dump0"
OURS = 0xE7
LIFT_LEFT = 0x13
ACM = 0xEF00
COMPONENT_ID = 65259
SOFTWARE_ID = 65242
COMMANDED_ADDRESS = 65240
ACKNOWLEDGE = 0xE800
# Identity 2, arbitrary address capable, otherwise zero: below any NAME the daemon has by default.
LOW_NAME = 0x8000_0000_0000_0002
HIGH_NAME = 0xF000_0000_0000_0002


@contextmanager
def node(address: int, *, name: int = 0) -> Iterator[KernelNode]:
    """A node on the kernel's stack, at the rig's end of the bus."""
    peer = KernelNode(WIRE, address, name=name)
    try:
        yield peer
    finally:
        peer.close()


def control_sources(listener: RawBus, seconds: float) -> set[int]:
    """Source addresses of the actuator control messages within ``seconds``."""
    return {f.source for f in listener.frames(seconds) if f.pgn == ACM}


def test_it_answers_the_kernels_request_for_claims(ready: Grader, listener: RawBus) -> None:
    with node(0x80) as peer:
        peer.request(ADDRESS_CLAIMED)
        address, name = daemons_claim(listener)
    assert address == OURS
    assert name >> 63 == 1
    assert (name >> 40) & 0xFF == 132  # land levelling supervisor


def test_long_messages_cross_to_and_from_the_kernel(ready: Grader) -> None:
    """Component identification is longer than 8 bytes: RTS/CTS when asked directly, BAM when asked globally."""
    with node(0x80) as peer, node(0x81) as bystander:
        peer.request(COMPONENT_ID, OURS)
        direct = peer.receive(5.0, pgn=COMPONENT_ID, source=OURS)
        assert direct is not None
        assert direct.data.startswith(b"graderd*blade controller*")
        bystander.request(COMPONENT_ID)
        broadcast = bystander.receive(5.0, pgn=COMPONENT_ID, source=OURS)
        assert broadcast is not None
        assert broadcast.data == direct.data
        peer.request(SOFTWARE_ID, OURS)
        software = peer.receive(5.0, pgn=SOFTWARE_ID, source=OURS)
        assert software is not None
        assert b"*" in software.data


def test_what_it_does_not_know_it_refuses(ready: Grader) -> None:
    with node(0x80) as peer:
        peer.request(65253, OURS)  # engine hours
        answer = peer.receive(3.0, pgn=ACKNOWLEDGE, source=OURS)
    assert answer is not None
    assert answer.data[0] == 1
    assert int.from_bytes(answer.data[5:8], "little") == 65253


def test_it_defends_its_address_against_a_lower_priority(ready: Grader, listener: RawBus) -> None:
    with node(OURS, name=HIGH_NAME) as thief:
        listener.drain()
        thief.claim()
        assert daemons_claim(listener)[0] == OURS

        def lost() -> bool:
            try:
                thief.send(0xFEF1, bytes(8))
            except OSError as error:
                return "assign" in str(error)
            return False

        wait_for("the kernel's stack to give the address up", lost, 2.0)
        assert control_sources(listener, 0.5) == {OURS}


def test_can_utils_read_and_write_the_same_bus(ready: Grader, rig: Rig, listener: RawBus) -> None:
    dump = subprocess.run(
        ["timeout", "3", "candump", "-n", "30", "-L", WIRE], capture_output=True, text=True, check=False
    )
    seen = {line.split()[2].split("#")[0] for line in dump.stdout.splitlines()}
    assert {"18EF13E7", "18EF14E7", "18EF1BE7", "19EFFF13", "19EFFF14", "19EFFF1B"} <= seen
    with subprocess.Popen(
        ["timeout", "5", "j1939spy", "-P", "-b", "64", f"{WIRE}:"], stdout=subprocess.PIPE, text=True
    ) as spy:
        assert spy.stdout is not None
        assert any("1ef" in line.lower() for line in spy.stdout)
        spy.terminate()
    # testj1939 at address 0x90 sends a request for the component identification and prints the answer.
    receiver = subprocess.Popen(
        ["timeout", "6", "testj1939", "-r", "-w2", f"{WIRE}:0x90"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        # It says nothing when it listens: ask until it has ended with an answer.
        while receiver.poll() is None:
            run("cansend", WIRE, f"18EA{OURS:02X}90#{COMPONENT_ID.to_bytes(3, 'little').hex().upper()}")
            with suppress(subprocess.TimeoutExpired):
                receiver.wait(timeout=0.5)
        said = receiver.communicate(timeout=10)[0]
    finally:
        receiver.kill()
    assert "67 72 61 64 65 72 64" in said.lower(), said  # "graderd"


@pytest.mark.error_frames
def test_graderd_can_dump_shows_a_live_bus_with_all_kinds_of_frames(ready: Grader) -> None:
    """On an interface of the kernel's, as for somebody who looks at a bus that no daemon has."""
    bus.add_vcan(DUMPED, fd=True)
    words = ["graderd", "can", "dump", DUMPED, "--json"]
    try:
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as dump:
            try:
                assert dump.stdout is not None
                wait_for("graderd can dump to listen", lambda: bus_users(DUMPED), 20.0)
                sent = ("18EF13E7#DC05191500000000", "18FEF180##1AABBCCDD", "20000040#0000000000000000", "18FEF180#R8")
                for frame in sent:
                    run("cansend", DUMPED, frame)
                seen = [json.loads(dump.stdout.readline()) for _ in sent]
                assert [frame["kind"] for frame in seen] == ["data", "fd", "error", "remote"]
                assert [frame["name"].split()[0] for frame in seen] == ["ACM", "CAN", "error", "remote"]
                assert seen[2]["signals"]["state"] == "bus_off"
                dump.send_signal(signal.SIGINT)
                assert dump.wait(20.0) == 0
            finally:
                dump.kill()
    finally:
        bus.remove_vcan(DUMPED)


def test_a_claiming_daemon_of_can_utils_lives_beside_it(ready: Grader, listener: RawBus) -> None:
    daemon = subprocess.Popen(
        ["j1939acd", "-v", "-r", f"{OURS},{OURS - 1}", "-c", "/tmp/hil.jacd", "f000000000000007", WIRE],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        until_s = time.monotonic() + 6.0
        taken = None
        while taken is None and time.monotonic() < until_s:
            frame = listener.receive(0.2)
            if frame and frame.pgn == ADDRESS_CLAIMED and frame.data == bytes.fromhex("07000000000000f0"):
                taken = frame.source if frame.source != OURS else None
        assert taken == OURS - 1, "our address was defended, the other one is theirs"
    finally:
        daemon.terminate()
        daemon.communicate(timeout=5)
    assert not faults(ready.status()) - {"can.address_conflict"}


def test_a_stop_message_stops_and_a_commanded_address_is_taken(ready: Grader, listener: RawBus) -> None:
    with node(0x80) as peer:
        listener.drain()
        peer.request(ADDRESS_CLAIMED)
        _, name = daemons_claim(listener)
        # 9 bytes: the kernel sends it as BAM.
        peer.send(COMMANDED_ADDRESS, name.to_bytes(8, "little") + bytes([0xC1]))
        assert daemons_claim(listener, 5.0)[0] == 0xC1
        listener.drain()
        assert control_sources(listener, 0.5) == {0xC1}
    ready.arm("manual")
    run("cansend", WIRE, f"18{STOP_PGN:04X}80#0000000000000000")
    state = ready.wait("stopped by the bus", lambda s: s["mode"] == "stopped", 2.0)
    assert "PGN" in state["reason"] or "stop" in state["reason"]


def test_it_moves_away_from_a_higher_priority_and_goes_on(ready: Grader, listener: RawBus) -> None:
    with node(0x80) as peer:
        listener.drain()
        peer.request(ADDRESS_CLAIMED)
        had, _ = daemons_claim(listener)
    with node(had, name=LOW_NAME) as winner:
        listener.drain()
        winner.claim()
        moved_to, _ = daemons_claim(listener)
        assert moved_to not in (had, 0xFE)
        while control_sources(listener, 0.5) != {moved_to}:
            pass  # the frames on their way are still from before; the test's own time limit ends this
        winner.send(0xFEF1, bytes(8))  # the address is the kernel's now
        listener.drain()
        assert control_sources(listener, 0.5) == {moved_to}
        state = ready.wait("all axes readable", lambda s: s["axes"]["tilt"]["lifecycle"] == "standby", 5.0)
        assert state["mode"] == "disarmed"
