"""Stop inputs: the modem lines of a serial port, and two lines of a GPIO chip."""

from graderd.drivers.stop_input.gpio import GpioStopInput
from graderd.drivers.stop_input.serial_line import SerialStopInput

__all__ = ["GpioStopInput", "SerialStopInput"]
