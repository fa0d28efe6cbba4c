"""The interface against its own description: Schemathesis over TCP, on the unmodified daemon with its rig.

Whatever is sent: no 5xx, no answer that the description does not know, no daemon that ends; and by the simulator's own
word no motion of the blade without the right to command and a lease. `make interface` sends many more examples.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from graderd.api.metrics import KINDS
from graderd.client import RefusedError
from graderd.core.machine import ARMED, Mode
from graderd.simulator.control_client import RigControl
from graderd.tokens import Right, create_token
from harness.api_daemon import free_port
from tests.machine import Served, standing_machine

pytestmark = pytest.mark.whole_machine

EXAMPLES_N = int(os.environ.get("GRADERD_INTERFACE_EXAMPLES", "0"))
"""For each operation and run, beside every edge of what is described; 0: a few of them, and no edges."""
ALL, FEW = ("--max-examples", str(EXAMPLES_N)), ("--max-examples", "4", "--phases", "examples,fuzzing")
PATIENCE_S = 300.0 + 10.0 * EXAMPLES_N
STILL_DEG = 0.3
"""The virtual servo's play about a goal that it holds."""
AFTER_LEASE_S = 1.5
"""A hold brakes for less, and a lease is told by status for no longer than it lasts."""
DASHBOARD = Path(__file__).parents[2] / "docs" / "integrators" / "grafana-dashboard.json"
OF_THE_SCRAPE = {"instance", "job"}
"""Labels that Prometheus itself adds."""
SETTINGS = """
[api.tcp]
port_n = {port_n}
token_file = "{directory}/tokens"
[api.limits]
rate_hz = 2000.0
burst_n = 100
"""


@dataclass
class Described:
    """A machine that serves TCP, and tokens for it."""

    machine: Served
    port_n: int
    tokens: dict[Right, str]

    def bearer(self, right: Right) -> tuple[str, str]:
        """Who asks with such a token, in Schemathesis's words."""
        return "--header", f"Authorization: Bearer {self.tokens[right]}"

    async def tried(self, *words: str) -> str:
        """Send everything that the description allows, and much that it does not; what did not agree is the result."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "schemathesis.cli", "--config-file", Path(__file__).with_name("schemathesis.toml")),
            *("run", self.machine.directory / "openapi.json", "--url", f"http://127.0.0.1:{self.port_n}"),
            *("--seed", "1", "--no-color", "--continue-on-failure", *(ALL if EXAMPLES_N else FEW), *words),
            cwd=self.machine.directory,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        assert process.stdout is not None
        try:
            said = (await process.stdout.read()).decode()
            status = await process.wait()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        return said if status else ""


@dataclass
class Watch:
    """What the simulator's blade did, and what the daemon said meanwhile."""

    keep_armed: bool = False
    angles_deg: list[float] = field(default_factory=list)
    modes: set[Mode] = field(default_factory=set)
    unexplained: list[str] = field(default_factory=list)

    async def run(self, machine: Served) -> None:
        """Look until cancelled. Motion is explained by a lease, or by automatic operation, not long ago. A machine that
        its own lateness disarmed, on a busy computer, is armed again where it is to be ``keep_armed``."""
        allowed_s = 0.0
        async with RigControl(machine.directory / "control.sock") as rig:
            while True:
                status = await machine.status()
                angle_deg = float((await rig.request("state"))["blade_deg"])
                self.modes.add(status.mode)
                if status.lease is not None or status.mode is Mode.AUTO:
                    allowed_s = status.time_s + AFTER_LEASE_S
                before_deg = self.angles_deg[-1] if self.angles_deg else angle_deg
                if abs(angle_deg - before_deg) > STILL_DEG and status.time_s > allowed_s:
                    self.unexplained.append(f"{before_deg:.1f} to {angle_deg:.1f} deg in {status.mode}")
                self.angles_deg.append(angle_deg)
                if self.keep_armed and status.mode is Mode.DISARMED and not status.arming:
                    with contextlib.suppress(RefusedError):
                        await machine.command("arm")
                await asyncio.sleep(0.05)

    @property
    def moved_deg(self) -> float:
        return max(self.angles_deg) - min(self.angles_deg)


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Described]:
    directory = tmp_path_factory.mktemp("interface")
    port_n = free_port()
    tokens = {right: create_token(directory / "tokens", right, right) for right in Right}
    with standing_machine(directory, SETTINGS.format(port_n=port_n, directory=directory)) as machine:
        yield Described(machine, port_n, tokens)


async def watched(described: Described, *tries: tuple[str, ...], keep_armed: bool = False) -> Watch:
    """Try the interface, with such words and at the same time, and watch the blade."""
    machine, watch = described.machine, Watch(keep_armed)
    description = await machine.client.get("/v1/openapi.json")
    (machine.directory / "openapi.json").write_text(json.dumps(description), encoding="utf-8")
    watching = asyncio.create_task(watch.run(machine), name="watch")
    try:
        differ = await asyncio.gather(*(described.tried(*words) for words in tries))
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
    assert "".join(differ) == ""
    assert len(watch.angles_deg) > 10
    return watch


async def armed(machine: Served) -> None:
    """In manual mode: whoever may would move it."""
    status = await machine.until(lambda s: all(r.met for r in s.readiness if r.mandatory))
    if status.mode is Mode.STOPPED:
        await machine.command("reset", stop_n=status.stop_n)
    if status.mode not in ARMED:
        await machine.command("arm")
    await machine.until(lambda s: s.mode is Mode.MANUAL)


@pytest.mark.timeout(PATIENCE_S)
async def test_who_may_not_command_moves_nothing(described: Described) -> None:
    await armed(described.machine)
    reads = ("--exclude-path", "/v1/stop", *described.bearer(Right.READ))  # who may read may stop
    watch = await watched(described, ("--mode", "positive"), reads, keep_armed=True)
    assert Mode.MANUAL in watch.modes
    assert watch.modes <= {Mode.MANUAL, Mode.DISARMED}
    assert watch.moved_deg < STILL_DEG


async def test_the_dashboard_asks_for_what_is_there(described: Described) -> None:
    """Every query's names and labels, against the metrics of this daemon."""
    await described.machine.until(lambda s: s.soil.ahead is not None)
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{described.port_n}", trust_env=False) as prometheus:
        _, bearer = described.bearer(Right.READ)
        text = (await prometheus.get("/metrics", headers=dict([bearer.split(": ", 1)]))).text
    names, labels = set(), defaultdict(set)
    for family in text_string_to_metric_families(text):
        names |= {family.name + "_total" * (family.type == "counter")}
        for sample in family.samples:
            for label, value in sample.labels.items():
                labels[sample.name, label].add(value)
    panels = json.loads(DASHBOARD.read_text("utf-8"))["panels"]
    queries = [target["expr"] for panel in panels for target in panel.get("targets", ())]
    assert len(queries) > 30
    for axis in ("axis_angle_degrees", "axis_extension_meters"):  # nothing is asked of a machine at rest
        labels[f"graderd_{axis}", "kind"] |= set(KINDS)
    for query in queries:
        asked = re.findall(r"\b((?:graderd|process)_\w+)(?:\{([^}]*)\})?", query)
        assert asked
        for name, matchers in asked:
            assert name in names, query
            for label, values in re.findall(r'(\w+)=~?"([^"]*)"', matchers):
                if label not in OF_THE_SCRAPE:
                    assert set(values.split("|")) <= labels[name, label], query
            for label in re.findall(r"by \((\w+)\)", query):
                assert label in OF_THE_SCRAPE


@pytest.mark.timeout(PATIENCE_S)
async def test_who_may_command_moves_it_by_a_lease_alone(described: Described) -> None:
    await armed(described.machine)
    watch = await watched(described, described.bearer(Right.COMMAND))
    assert watch.unexplained == []
    assert (await described.machine.status()).mode in Mode
