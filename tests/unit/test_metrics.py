"""What `/metrics` makes of a status: Prometheus' form, base units, and no sample of what is not known."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from graderd.api.metrics import metrics_text
from graderd.api.settings import TcpSettings
from graderd.core.machine import Mode
from graderd.core.soil import Zone
from graderd.core.status import AheadStatus, AxisStatus, FaultStatus, SoilStatus, Status
from graderd.hal.device import Lifecycle
from graderd.tokens import Right, create_token
from harness.api_daemon import FakeDaemon, free_port, serving

UNITS = (
    "meters",
    "degrees",
    "amperes",
    "volts",
    "celsius",
    "seconds",
    "liters",
    "ratio",
    "newton_meters",
    "per_second",
)
WITHOUT_UNIT = {"build_info", "mode", "lease_held", "fault_active", "requirement_met", "axis_active", "soil_zone"}
WITHOUT_UNIT |= {"recorder_writing", "recorder_waiting"}
PAGE = Path(__file__).parents[2] / "docs" / "integrators" / "metrics.md"
Sample = tuple[str, frozenset[tuple[str, str]]]


def samples_of(status: Status) -> dict[Sample, float]:
    families = text_string_to_metric_families(metrics_text(status).decode())
    return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def sample(name: str, **labels: str) -> Sample:
    return f"graderd_{name}", frozenset(labels.items())


def test_a_status_in_base_units() -> None:
    axis = AxisStatus(name="tilt", unit="mm", lifecycle=Lifecycle.ACTIVE, limited=51.0, measured=49.5)
    axis = axis.model_copy(update={"ages_s": {"measured": 0.02}, "counters": {"restarts_n": 2}})
    fault = FaultStatus(
        name="camera.stale", reads="", detail="", remedy="", reaction="hold", clears="", age_s=1.0, present=True
    )
    ahead = AheadStatus(left_l=1.5, center_l=0.0, right_l=0.0, zone=Zone.LEFT, confidence=0.9, reason="")
    status = FakeDaemon().status()
    told = samples_of(
        status.model_copy(
            update={
                "mode": Mode.AUTO,
                "axes": {"tilt": axis},
                "faults": (fault,),
                "soil": SoilStatus(zone=Zone.LEFT, confidence=0.9, ahead=ahead),
            }
        )
    )
    assert told[sample("axis_extension_meters", axis="tilt", kind="limited")] == pytest.approx(0.051)
    assert told[sample("axis_extension_meters", axis="tilt", kind="measured")] == pytest.approx(0.0495)
    assert told[sample("axis_reading_age_seconds", axis="tilt", reading="measured")] == pytest.approx(0.02)
    assert told[sample("axis_wire_events_total", axis="tilt", event="restarts")] == 2.0
    assert told[sample("fault_active", fault="camera.stale", reaction="hold")] == 1.0
    assert told[sample("soil_volume_liters", part="ahead", third="left")] == 1.5
    assert {mode: told[sample("mode", mode=mode)] for mode in Mode} == {mode: float(mode is Mode.AUTO) for mode in Mode}


def test_what_is_not_known_has_no_sample() -> None:
    axis = AxisStatus(name="tilt", unit="mm", lifecycle=Lifecycle.FAILED)
    told = samples_of(FakeDaemon().status().model_copy(update={"axes": {"tilt": axis}, "soil": SoilStatus()}))
    assert [name for name, _ in told if "extension" in name or "volume" in name or "age" in name] == []
    assert told[sample("axis_active", axis="tilt")] == 0.0


def test_names_say_their_units() -> None:
    text = metrics_text(FakeDaemon().status()).decode()
    for family in text_string_to_metric_families(text):
        name = family.name.removeprefix("graderd_")
        assert name != family.name
        assert family.documentation.endswith(".")
        assert family.type == "counter" or name in WITHOUT_UNIT or name.endswith(UNITS), name


def test_the_page_lists_them_all() -> None:
    text = metrics_text(FakeDaemon().status()).decode()
    families = {f.name + "_total" * (f.type == "counter"): f for f in text_string_to_metric_families(text)}
    rows = dict(re.findall(r"^\| `(graderd_\w+)` \|[^|]*\| (.*) \|$", PAGE.read_text("utf-8"), re.MULTILINE))
    assert rows.keys() == families.keys()
    for name, family in families.items():
        assert rows[name].lower() == family.documentation.rstrip(".").lower()


@pytest.mark.live
async def test_it_wants_a_token_that_may_read(tmp_path: Path) -> None:
    tcp = TcpSettings(port_n=free_port(), token_file=tmp_path / "tokens")
    token = create_token(tcp.token_file, "prometheus", Right.READ)
    prometheus = httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False)
    async with serving(tmp_path, tcp=tcp), prometheus as client:
        assert (await client.get("/metrics")).status_code == 401
        answer = await client.get("/metrics", headers={"Authorization": f"Bearer {token}"})
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=")
    names = {family.name for family in text_string_to_metric_families(answer.text)}
    assert {"graderd_ticks", "process_resident_memory_bytes"} <= names
