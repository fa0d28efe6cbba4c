"""An slcan adapter under the kernel's driver: set up by its unit, error-passive, bus-off, unplugged, plugged again."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hil import slcan
from hil.bus import details, interface_exists
from hil.service import Grader, Unit, armed_and_then, faults, recovered, run, wait_for


@pytest.fixture(scope="module")
def plugged(grader: Grader, wire: str) -> Iterator[list[slcan.Adapter]]:
    """Every adapter so far, which the unit for CAN links has set up; the last one is plugged in."""
    adapters = [slcan.Adapter(wire)]
    yield adapters
    grader.unit.ctl("stop")  # before its link goes
    for adapter in adapters:
        adapter.unplug()


@pytest.fixture(scope="module")
def channel(plugged: list[slcan.Adapter]) -> str:
    """The adapter's interface instead of the virtual bus."""
    return plugged[-1].interface


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
    recovered(service, pid)


def test_unplugged_and_plugged_in_again(plugged: list[slcan.Adapter], ready: Grader, wire: str) -> None:
    pid = ready.unit.pid
    interface = plugged[-1].interface
    ready.arm("manual")
    plugged[-1].unplug()
    ready.wait("told", lambda s: faults(s) & {"can.unplugged", "can.interface_down"}, 4.0)
    ready.wait("disarmed", lambda s: s["mode"] == "disarmed", 3.0)
    wait_for("interface gone", lambda: not interface_exists(interface), 5.0)
    wait_for("link unit stopped", lambda: Unit(f"graderd-can@{interface}.service").state == "inactive", 5.0)
    # The new one: udev tells systemd, systemd sets the link up, the daemon opens it; nobody helps.
    fresh = slcan.Adapter(wire)
    plugged.append(fresh)
    assert fresh.interface == interface
    wait_for("set up", lambda: fresh.bitrate_code == "S5", 10.0)
    recovered(ready, pid)
