"""The CAN interface goes away while the service runs: down, deleted. The service stays and recovers."""

from __future__ import annotations

from hil.bus import couple, ip
from hil.service import Grader, armed_and_then, recovered

CAN, WIRE = "vcan0", "wire0"


def test_interface_down_and_up(ready: Grader) -> None:
    pid = ready.unit.pid
    armed_and_then(ready, lambda: ip("link", "set", CAN, "down"), "can.interface_down")
    assert ready.unit.state == "active"
    ip("link", "set", CAN, "up")
    recovered(ready, pid)


def test_interface_deleted_and_created_again(ready: Grader) -> None:
    pid = ready.unit.pid
    armed_and_then(ready, lambda: ip("link", "del", CAN), "can.unplugged")
    assert ready.unit.state == "active"
    ip("link", "add", "dev", CAN, "type", "vcan")
    ip("link", "set", CAN, "txqueuelen", "1000", "up")
    couple(CAN, WIRE)
    recovered(ready, pid)
