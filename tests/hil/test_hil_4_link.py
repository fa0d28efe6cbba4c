"""The CAN link goes bad while the service runs: down, deleted, bus-off, unplugged. The service stays and recovers."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from hil import slcan
from hil.bus import couple, details, interface_exists, ip
from hil.service import Grader, Rig, Unit, faults, run, wait_for

CAN, WIRE = "vcan0", "wire0"
TOLD_S = 0.5
BACK_S = 8.0


def armed_and_then(grader: Grader, action: object, fault: str, mode_after: str = "disarmed") -> None:
    """Arm, let ``action`` happen, see the fault told in time and the machine left as the catalogue says."""
    grader.arm("manual")
    assert callable(action)
    began_s = time.monotonic()
    action()
    grader.wait(fault, lambda s: fault in faults(s), 3.0)
    told_s = time.monotonic() - began_s
    assert told_s <= TOLD_S + 0.5, f"{fault} told after {told_s:.2f} s"
    grader.wait(mode_after, lambda s: s["mode"] == mode_after, 3.0)


def back(grader: Grader, pid: int) -> None:
    """Everything readable again, by the same process, and it can be armed."""
    grader.wait("actuators back", lambda s: not any(n.startswith("can.") for n in faults(s)), BACK_S)
    grader.wait_ready(BACK_S)
    assert grader.unit.pid == pid
    grader.arm("manual")
    grader.disarm()


def test_interface_down_and_up(ready: Grader) -> None:
    pid = ready.unit.pid
    armed_and_then(ready, lambda: ip("link", "set", CAN, "down"), "can.interface_down")
    assert ready.unit.state == "active"
    ip("link", "set", CAN, "up")
    back(ready, pid)


def test_interface_deleted_and_created_again(ready: Grader) -> None:
    pid = ready.unit.pid
    armed_and_then(ready, lambda: ip("link", "del", CAN), "can.unplugged")
    assert ready.unit.state == "active"
    ip("link", "add", "dev", CAN, "type", "vcan")
    ip("link", "set", CAN, "txqueuelen", "1000", "up")
    couple(CAN, WIRE)
    back(ready, pid)


@pytest.fixture(scope="module")
def plugged(service: Grader, rig: Rig) -> Iterator[list[slcan.Adapter]]:
    """The service moved to an slcan adapter, the last of these, which the unit for CAN links has set up."""
    adapters = [slcan.Adapter(WIRE)]
    service.start_with({"can.channel": adapters[0].interface})
    yield adapters
    # Back on the virtual bus before the adapter goes.
    service.start_with({"can.channel": CAN})
    for adapter in adapters:
        adapter.unplug()


@pytest.fixture
def adapter(plugged: list[slcan.Adapter], ready: Grader) -> slcan.Adapter:
    """The adapter that is plugged in, with the service ready on it."""
    return plugged[-1]


def test_the_link_unit_sets_the_adapter_up(adapter: slcan.Adapter, service: Grader) -> None:
    assert adapter.bitrate_code == "S5"  # 250 kbit/s
    assert Unit(f"graderd-can@{adapter.interface}.service").state == "active"
    assert str(details(adapter.interface)).count("ERROR-ACTIVE") == 1
    after = service.unit.show("After")
    assert f"graderd-can@{adapter.interface}.service" in after
    assert f"sys-subsystem-net-devices-{adapter.interface}.device" in after


@pytest.mark.error_frames
def test_error_passive_is_told_and_gone_again(adapter: slcan.Adapter, service: Grader) -> None:
    adapter.report(slcan.NO_ACKNOWLEDGE)
    adapter.report(slcan.ERROR_PASSIVE)
    service.wait("error-passive", lambda s: "can.error_passive" in faults(s), 3.0)
    adapter.report(slcan.ERROR_ACTIVE)
    service.wait("error-active", lambda s: "can.error_passive" not in faults(s), 15.0)


@pytest.mark.error_frames
def test_bus_off_disarms_and_a_restart_of_the_link_brings_it_back(adapter: slcan.Adapter, service: Grader) -> None:
    pid = service.unit.pid
    armed_and_then(service, lambda: adapter.report(slcan.BUS_OFF), "can.bus_off")
    assert "BUS-OFF" in str(details(adapter.interface))
    run("systemctl", "restart", f"graderd-can@{adapter.interface}.service")
    assert service.unit.pid == pid, "restarting the link does not restart the service"
    back(service, pid)


def test_unplugged_and_plugged_in_again(plugged: list[slcan.Adapter], ready: Grader) -> None:
    pid = ready.unit.pid
    interface = plugged[-1].interface
    ready.arm("manual")
    plugged[-1].unplug()
    ready.wait("told", lambda s: faults(s) & {"can.unplugged", "can.interface_down"}, 4.0)
    ready.wait("disarmed", lambda s: s["mode"] == "disarmed", 3.0)
    wait_for("interface gone", lambda: not interface_exists(interface), 5.0)
    wait_for("link unit stopped", lambda: Unit(f"graderd-can@{interface}.service").state == "inactive", 5.0)
    # The new one: udev tells systemd, systemd sets the link up, the daemon opens it; nobody helps.
    fresh = slcan.Adapter(WIRE)
    plugged.append(fresh)
    assert fresh.interface == interface
    wait_for("set up", lambda: fresh.bitrate_code == "S5", 10.0)
    back(ready, pid)
