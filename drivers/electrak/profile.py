"""What one Electrak model can do, read from ``firmware_profiles/<name>.toml``: plain numbers, each with its source."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from importlib import resources
from typing import Any

from graderd import firmware_profiles
from graderd.hal.errors import WrongDeviceError


@dataclass(frozen=True, slots=True)
class Figures:
    """The numbers of a profile; the TOML file gives source and confidence of each."""

    bitrate_n: int
    default_address_n: int
    address_count_n: int
    manufacturer_n: int
    acm_period_s: float
    afm_period_s: float
    sleep_after_s: float
    wake_claim_s: float
    wake_feedback_s: float
    wake_motion_s: float
    stroke_mm: float
    current_limit_max_a: float
    measured_current_max_a: float
    speed_min_percent: int
    rated_load_n: float
    static_load_n: float
    speed_no_load_mm_per_s: float
    speed_full_load_mm_per_s: float
    duty_offset_percent: float
    soft_start_s: float
    taper_from_mm: float
    taper_speed_percent: float
    dead_zone_mm: float
    dead_zone_spread_mm: float
    restart_zone_mm: float
    position_noise_mm: float
    current_no_load_a: float
    current_full_load_a: float
    inrush_s: float
    overload_hold_s: float
    duty_cycle_percent: float
    thermal_time_constant_s: float
    supply_min_v: float
    supply_max_v: float
    temperature_min_c: float
    temperature_max_c: float

    def speed_mm_per_s(self, duty_percent: float, load_n: float = 0.0) -> float:
        """Speed at a motor duty against an opposing load; 0 below the lowest duty that turns the motor."""
        if duty_percent < self.speed_min_percent:
            return 0.0
        share = max(0.0, load_n) / self.rated_load_n
        full = self.speed_no_load_mm_per_s - (self.speed_no_load_mm_per_s - self.speed_full_load_mm_per_s) * share
        return max(0.0, full * (duty_percent - self.duty_offset_percent) / 100.0)

    def current_a(self, load_n: float) -> float:
        """Motor current while moving against an opposing load."""
        share = max(0.0, load_n) / self.rated_load_n
        return self.current_no_load_a + (self.current_full_load_a - self.current_no_load_a) * share


@dataclass(frozen=True, slots=True)
class ActuatorProfile:
    """One model: its name, its message layout (base name of a DBC file), its figures and what is only assumed."""

    name: str
    model: str
    layout: str
    figures: Figures
    unknown: frozenset[str]
    """Names of figures that are assumptions."""
    sources: dict[str, str]

    def with_figures(self, measured: Mapping[str, float]) -> ActuatorProfile:
        """The same model with figures that were measured on the bench; those are no longer assumptions.

        Raises:
            WrongDeviceError: a name is no figure of a profile; the message has the nearest one.
        """
        for name in measured:
            if name not in self.sources:
                near = difflib.get_close_matches(name, self.sources, n=1)
                remedy = f"Did you mean {near[0]}?" if near else f"Known: {', '.join(sorted(self.sources))}"
                raise WrongDeviceError(f"figures of {self.name}", f"there is no figure {name!r}", remedy)
        if not measured:
            return self
        figures: dict[str, Any] = asdict(self.figures) | dict(measured)
        return replace(
            self,
            figures=Figures(**figures),
            unknown=self.unknown - measured.keys(),
            sources=self.sources | dict.fromkeys(measured, "settings"),
        )


def read_layout(layout: str) -> str:
    """Text of ``firmware_profiles/<layout>.dbc``.

    Raises:
        WrongDeviceError: no such file.
    """
    try:
        return (resources.files(firmware_profiles) / f"{layout}.dbc").read_text(encoding="utf-8")
    except FileNotFoundError:
        raise WrongDeviceError(f"message layout {layout}", "firmware_profiles has no such DBC file") from None


@functools.cache
def load_profile(name: str) -> ActuatorProfile:
    """Read ``firmware_profiles/<name>.toml``.

    Raises:
        WrongDeviceError: no such profile, or it lacks a figure or has one that is not known.
    """
    try:
        raw: dict[str, Any] = firmware_profiles.load(name)
    except firmware_profiles.UnknownProfileError as error:
        raise WrongDeviceError(f"profile {name}", str(error)) from error
    figures: dict[str, dict[str, Any]] = raw.get("figures", {})
    wanted = {f.name for f in fields(Figures)}
    if odd := sorted(wanted ^ figures.keys()):
        raise WrongDeviceError(f"profile {name}", f"figures missing or not known: {', '.join(odd)}")
    return ActuatorProfile(
        name=raw["name"],
        model=raw["model"],
        layout=raw["layout"],
        figures=Figures(**{key: figure["value"] for key, figure in figures.items()}),
        unknown=frozenset(key for key, figure in figures.items() if figure["confidence"] == "unknown"),
        sources={key: figure["source"] for key, figure in figures.items()},
    )
