"""Stop inputs: the modem lines of a serial port, two lines of a GPIO chip, and the rig's."""

from __future__ import annotations

from graderd.drivers.simulated.stop_input import SimulatedStopInput
from graderd.drivers.stop_input.gpio import GpioStopInput
from graderd.drivers.stop_input.serial_line import SerialStopInput
from graderd.hal.settings import StopInputSettings
from graderd.hal.stop_input import StopInput


def make_stop_input(settings: StopInputSettings) -> StopInput | None:
    """The input of these settings, not opened yet; None where there is none."""
    match settings.backend:
        case "serial":
            return SerialStopInput(settings)
        case "gpio":
            return GpioStopInput(settings)
        case "simulated":
            return SimulatedStopInput(settings.port)
        case "none":
            return None


__all__ = ["GpioStopInput", "SerialStopInput", "SimulatedStopInput", "make_stop_input"]
