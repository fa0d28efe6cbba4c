"""The daemon as its interface sees it: who may run a device service, and when."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from graderd.api.port import ServiceError
from graderd.config import Config
from graderd.core.machine import Mode, State
from graderd.hal.device import DeviceService
from graderd.hal.errors import DeviceTimeoutError
from graderd.runtime.port import Port


def port_in(mode: Mode, ran: list[str]) -> Port:
    """A port over a machine in ``mode``; what was run is noted in ``ran``."""

    def service(name: str, *, only_reads: bool) -> DeviceService:
        async def run(_: Any) -> dict[str, Any]:
            ran.append(name)
            return {"done": name}

        return DeviceService(run, only_reads=only_reads)

    async def fails(_: Any) -> dict[str, Any]:
        raise DeviceTimeoutError("servo 1", "no answer", "check the cable")

    services = {
        "rotation.reboot": service("reboot", only_reads=False),
        "rotation.verify": service("verify", only_reads=True),
        "rotation.fails": DeviceService(fails, only_reads=True),
    }
    loop = SimpleNamespace(tick=SimpleNamespace(state=State(mode=mode)))
    return Port(Config(), cast("Any", loop), cast("Any", SimpleNamespace(buses={})), cast("Any", None), services)


@pytest.mark.parametrize("mode", list(Mode))
async def test_what_moves_or_unpowers_needs_consent_and_a_disarmed_machine(mode: Mode) -> None:
    ran: list[str] = []
    port = port_in(mode, ran)
    for arguments in ({}, {"consent": False}):
        with pytest.raises(ServiceError, match="may move or unpower the blade"):
            await port.service("rotation.reboot", arguments)
    if mode is Mode.DISARMED:
        assert await port.service("rotation.reboot", {"consent": True}) == {"done": "reboot"}
        assert ran == ["reboot"]
    else:
        with pytest.raises(ServiceError, match=f"needs a disarmed machine; it is {mode}") as refused:
            await port.service("rotation.reboot", {"consent": True})
        assert refused.value.remedy
        assert ran == []


@pytest.mark.parametrize("mode", list(Mode))
async def test_what_only_reads_runs_in_every_mode(mode: Mode) -> None:
    ran: list[str] = []
    assert await port_in(mode, ran).service("rotation.verify", {}) == {"done": "verify"}


async def test_a_service_that_is_not_there_or_fails_is_told_with_the_remedy() -> None:
    port = port_in(Mode.DISARMED, [])
    with pytest.raises(ServiceError, match="there is no service 'x'") as refused:
        await port.service("x", {})
    assert refused.value.remedy == "there are: rotation.fails, rotation.reboot, rotation.verify"
    with pytest.raises(ServiceError, match="servo 1: no answer") as failed:
        await port.service("rotation.fails", {})
    assert failed.value.remedy == "check the cable"
