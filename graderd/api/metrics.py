"""``/metrics``: the status in Prometheus' text format, for the fleet.

A scrape reads the status of the last tick, as any client does; text is made of it in a thread. What is not known has no
sample: an old number is never told as the last one. Units are Prometheus' base units (metres, seconds), and degrees.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric

from graderd.api.port import DaemonPort
from graderd.core.axes import UNITS
from graderd.core.machine import Mode
from graderd.core.soil import Zone
from graderd.core.status import AxisStatus, SoilStatus, Status

Samples = Iterable[tuple[tuple[str, ...], float | None]]
"""Values of the labels, and the value; None: not known."""
THIRDS = ("left", "center", "right")
NO_EVENTS = {"low_latency_n"}
"""Told among a wire's counters, and a state."""
KINDS = ("requested", "limited", "sent", "measured")


def metrics_routes(port: DaemonPort) -> APIRouter:
    """``GET /metrics`` over ``port``."""
    router = APIRouter()
    process = CollectorRegistry()
    ProcessCollector(registry=process)

    @router.get(
        "/metrics",
        tags=["status"],
        summary="The status in Prometheus' text format",
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    )
    async def metrics() -> Response:
        status = port.status()
        text = await asyncio.to_thread(lambda: metrics_text(status) + generate_latest(process))
        return Response(text, media_type=CONTENT_TYPE_LATEST)

    return router


def metrics_text(status: Status) -> bytes:
    """What a status comes to."""
    registry = CollectorRegistry()
    registry.register(_Once(tuple(_families(status))))
    return generate_latest(registry)


class _Once:
    """Families made already, as a registry wants them."""

    def __init__(self, families: tuple[Metric, ...]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        """As prometheus_client asks for them."""
        return self._families


def _gauge(name: str, text: str, samples: Samples, labels: tuple[str, ...] = ()) -> Metric:
    return _filled(GaugeMetricFamily(f"graderd_{name}", text, labels=labels), samples)


def _counter(name: str, text: str, samples: Samples, labels: tuple[str, ...] = ()) -> Metric:
    return _filled(CounterMetricFamily(f"graderd_{name}", text, labels=labels), samples)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, samples: Samples) -> Metric:
    for labels, value in samples:
        if value is not None:
            family.add_metric(labels, float(value))
    return family


def _one(value: float | None) -> Samples:
    return (((), value),)


def _families(status: Status) -> Iterator[Metric]:
    yield from _machine(status)
    yield from _axes(status.axes)
    yield from _soil(status)
    yield from _health(status)


def _machine(status: Status) -> Iterator[Metric]:
    simulated = str(status.simulated).lower()
    yield _gauge("build_info", "Which graderd this is.", [((status.version, simulated), 1)], ("version", "simulated"))
    yield _gauge("mode", "1 for the mode it is in.", [((m,), m is status.mode) for m in Mode], ("mode",))
    yield _gauge("lease_held", "Whether somebody moves the blade by hand.", _one(status.lease is not None))
    yield _counter("stops", "Stops since the start, and one that was not reset before it.", _one(status.stop_n))
    yield _gauge(
        "fault_active",
        "1 for a fault that counts, 0 where its cause is gone and only its latch keeps it.",
        [((fault.name, fault.reaction), fault.present) for fault in status.faults],
        ("fault", "reaction"),
    )
    yield _gauge(
        "requirement_met",
        "Whether a requirement for arming is met.",
        [((r.name, str(r.mandatory).lower()), r.met) for r in status.readiness],
        ("requirement", "mandatory"),
    )
    told = status.attitude
    yield _gauge("blade_height_meters", "Height of the blade's centre.", _one(_meters(told.height_mm)))
    yield _gauge("blade_slope_degrees", "Slope of the blade.", _one(told.slope_deg))
    yield _gauge("blade_pitch_degrees", "Pitch of the blade.", _one(told.pitch_deg))
    vehicle = status.vehicle
    yield _gauge("vehicle_speed_meters_per_second", "Speed of the machine.", _one(vehicle.speed_m_per_s))
    yield _gauge("vehicle_travelled_meters", "Way of the machine.", _one(vehicle.travelled_m))


def _axes(axes: dict[str, AxisStatus]) -> Iterator[Metric]:
    turning = {name: axis for name, axis in axes.items() if UNITS[name] == "deg"}
    sliding = {name: axis for name, axis in axes.items() if UNITS[name] == "mm"}
    yield _gauge(
        "axis_angle_degrees",
        "Angle of an axis, counter-clockwise seen from above.",
        [((name, kind), getattr(axis, kind)) for name, axis in turning.items() for kind in KINDS],
        ("axis", "kind"),
    )
    yield _gauge(
        "axis_extension_meters",
        "Extension of an actuator.",
        [((name, kind), _meters(getattr(axis, kind))) for name, axis in sliding.items() for kind in KINDS],
        ("axis", "kind"),
    )
    every = axes.items()
    for name, text, field in (
        ("axis_current_amperes", "Current of an axis.", "current_a"),
        ("axis_torque_newton_meters", "Torque of an axis.", "torque_nm"),
        ("axis_voltage_volts", "Supply of an axis.", "voltage_v"),
        ("axis_temperature_celsius", "Temperature of an axis.", "temperature_c"),
        ("axis_thermal_load_ratio", "Share of an actuator's duty that is used up.", "thermal_load"),
    ):
        yield _gauge(name, text, [((axis,), getattr(told, field)) for axis, told in every], ("axis",))
    yield _gauge(
        "axis_active",
        "Whether an axis has its power.",
        [((axis,), told.lifecycle == "active") for axis, told in every],
        ("axis",),
    )
    yield _gauge(
        "axis_reading_age_seconds",
        "How old what is known of an axis is.",
        [((axis, reading), age_s) for axis, told in every for reading, age_s in told.ages_s.items()],
        ("axis", "reading"),
    )
    yield _counter(
        "axis_wire_events",
        "What happened on an axis's wire, by the driver's own names.",
        [
            ((axis, event.removesuffix("_n")), n)
            for axis, told in every
            for event, n in told.counters.items()
            if event not in NO_EVENTS
        ],
        ("axis", "event"),
    )


def _soil(status: Status) -> Iterator[Metric]:
    soil, decision = status.soil, status.decision
    yield _gauge(
        "soil_volume_liters",
        "Soil by the third of the blade, in all and told apart.",
        _volumes(soil),
        ("part", "third"),
    )
    yield _gauge("soil_zone", "1 for the zone where the soil is.", [((z,), z is soil.zone) for z in Zone], ("zone",))
    yield _gauge("soil_confidence_ratio", "How sure that is.", _one(soil.confidence))
    yield _gauge("soil_age_seconds", "How old the picture is that it is from.", _one(soil.age_s))
    yield _counter("decisions", "Decisions of automatic operation.", _one(decision.decisions_n))
    yield _gauge("decision_angle_degrees", "Angle that the last decision asked for.", _one(decision.angle_deg))
    yield _gauge("decision_age_seconds", "Since when it stands.", _one(decision.age_s))


def _volumes(soil: SoilStatus) -> Samples:
    yield from ((("all", third), getattr(soil, f"volume_{third}_l")) for third in THIRDS)
    for part, told in (("ahead", soil.ahead), ("carried", soil.carried)):
        if told is not None:
            yield from (((part, third), getattr(told, f"{third}_l")) for third in THIRDS)


def _health(status: Status) -> Iterator[Metric]:
    camera, tick, recording = status.camera, status.tick, status.recording
    yield _counter("camera_frames", "Pictures that perception looked at.", _one(camera.frames_n))
    yield _counter("camera_restarts", "Times that the perception worker was started anew.", _one(camera.restarts_n))
    yield _counter("ticks", "Control ticks.", _one(tick.ticks_n))
    yield _counter("tick_overruns", "Control ticks that were too late.", _one(tick.overruns_n))
    yield _gauge(
        "tick_lateness_p99_seconds", "Of the last 500 ticks 99 % were no later.", _one(tick.lateness_p99_ms / 1000.0)
    )
    yield _gauge(
        "recorder_writing",
        "Whether such a file is being written.",
        [(("run",), recording.run), (("incident",), recording.incident)],
        ("file",),
    )
    yield _gauge("recorder_waiting", "What the recorder has not written yet.", _one(recording.waiting_n))
    yield _counter("recorder_lost_ticks", "Ticks that could not be recorded.", _one(recording.lost_n))


def _meters(value_mm: float | None) -> float | None:
    return None if value_mm is None else value_mm / 1000.0
