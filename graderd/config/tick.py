"""From the configuration to what the tick goes by."""

from __future__ import annotations

from graderd.config.models import Config
from graderd.core.plausibility import motion_figures
from graderd.core.tick import TickSettings


def tick_settings(config: Config) -> TickSettings:
    """What the tick goes by, out of the configuration."""
    figures = config.figures()
    return TickSettings(
        figures=figures,
        motion=motion_figures(config.rotation, config.actuators(), figures),
        machine=config.machine,
        rule=config.rule,
        gate=config.gate,
        lift_pair=config.lift_pair,
        attitude=config.attitude,
        presets=config.presets,
        overrun_s=config.control.overrun_s,
        max_frame_age_s=config.perception.decision.max_frame_age_s,
        max_vehicle_age_s=config.vehicle.max_age_s,
        no_auto=config.perception.why_not_to_drive(),
    )
