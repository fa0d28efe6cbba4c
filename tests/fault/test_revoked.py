"""A token that is revoked ends what it moves: a maneuver over TLS, by unmodified processes on the simulated grader."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from graderd.client import AsyncClient, ClientError
from graderd.core.machine import Mode
from graderd.simulator.control_client import RigControl
from graderd.tokens import Right, create_token
from harness.api_daemon import free_port
from tests.machine import Served, standing_machine

pytestmark = [pytest.mark.whole_machine, pytest.mark.xdist_group("beside a machine")]

STEP_DEG, DWELL_S = 50.0, 20.0
MOVING_DEG_PER_S = 3.0
STILL_S = 1.0
NAME = "mechanic"
SETTINGS = """
[api.tcp]
port_n = {port_n}
token_file = "{directory}/tokens"
certificate_file = "{directory}/certificate.pem"
key_file = "{directory}/key.pem"
"""


@dataclass
class Secured:
    machine: Served
    port_n: int
    token: str


@pytest.fixture
def secured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Secured]:
    """A machine whose interface speaks TLS, and a token for it."""
    made = ("-keyout", tmp_path / "key.pem", "-out", tmp_path / "certificate.pem")
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"),
            *("-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", *made),
        ],
        check=True,
        capture_output=True,
    )
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "certificate.pem"))
    port_n = free_port()
    token = create_token(tmp_path / "tokens", NAME, Right.COMMAND)
    with standing_machine(tmp_path, SETTINGS.format(port_n=port_n, directory=tmp_path)) as machine:
        yield Secured(machine, port_n, token)


async def truth(rig: RigControl) -> dict[str, Any]:
    """The blade as it is, and how fast it turns."""
    return await rig.request("state")


async def test_a_maneuver_ends_with_its_token(secured: Secured) -> None:
    machine, directory = secured.machine, secured.machine.directory
    await machine.until(lambda s: all(r.met for r in s.readiness if r.mandatory))
    async with (
        RigControl(directory / "control.sock") as rig,
        AsyncClient(f"https://localhost:{secured.port_n}", token=secured.token, name="cab", timeout_s=10.0) as client,
    ):
        wanted = {"consent": True, "step_deg": STEP_DEG, "dwell_s": DWELL_S}
        moving = asyncio.create_task(client.maneuver("rotation.step_response", **wanted), name="maneuver")
        async with asyncio.timeout(60.0):
            while abs((await truth(rig))["blade_velocity_deg_per_s"]) < MOVING_DEG_PER_S:
                assert not moving.done(), moving.exception()
                await asyncio.sleep(0.02)
        revoke = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "graderd", "token", "revoke", NAME, "--config", directory / "graderd.toml")
        )
        assert await revoke.wait() == 0
        async with asyncio.timeout(DWELL_S / 2):
            with pytest.raises(ClientError):
                await moving
            await machine.until(lambda s: s.mode is Mode.DISARMED)
            while abs((await truth(rig))["blade_velocity_deg_per_s"]) > 0.1:
                await asyncio.sleep(0.05)
        rests_deg = (await truth(rig))["blade_deg"]
        await asyncio.sleep(STILL_S)
        assert (await truth(rig))["blade_deg"] == pytest.approx(rests_deg, abs=0.2)
        assert (await machine.status()).lease is None
        with pytest.raises(ClientError):
            await client.status()
