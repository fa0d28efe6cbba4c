"""The stop loop on two lines of a GPIO chip, through the kernel's character device (libgpiod 2).

The input is pulled down, by the chip or by a resistor, so that an open loop reads low. The package ``gpiod`` is the
optional extra ``gpio``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from graderd.drivers.stop_input.loop import LoopStopInput
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import StopInputSettings

if TYPE_CHECKING:
    import gpiod

CONSUMER = "graderd stop input"
"""What ``gpioinfo`` shows of who holds the lines."""


class _GpioWire:
    """The two lines, held until closed. The kernel gives a line to one holder only."""

    def __init__(self, settings: StopInputSettings) -> None:
        # Imported where it is used: the extra may be missing, and no other backend needs it.
        import gpiod

        self._drive_n, self._sense_n = settings.gpio_drive_n, settings.gpio_sense_n
        self._active, self._inactive = gpiod.line.Value.ACTIVE, gpiod.line.Value.INACTIVE
        bias = gpiod.line.Bias.PULL_DOWN if settings.gpio_pull_down else gpiod.line.Bias.AS_IS
        self._lines: gpiod.LineRequest = gpiod.request_lines(
            settings.port,
            consumer=CONSUMER,
            config={
                self._drive_n: gpiod.LineSettings(
                    direction=gpiod.line.Direction.OUTPUT, output_value=gpiod.line.Value.ACTIVE
                ),
                self._sense_n: gpiod.LineSettings(direction=gpiod.line.Direction.INPUT, bias=bias),
            },
        )

    def drive(self, on: bool) -> None:
        self._lines.set_value(self._drive_n, self._active if on else self._inactive)

    def reads(self) -> bool:
        return self._lines.get_value(self._sense_n) == self._active

    def close(self) -> None:
        self._lines.release()


class GpioStopInput(LoopStopInput):
    """See the module's text. ``sleep`` is for tests."""

    def __init__(self, settings: StopInputSettings, sleep: Callable[[float], None] = time.sleep) -> None:
        super().__init__(
            f"{settings.port} lines {settings.gpio_drive_n} and {settings.gpio_sense_n}",
            "stop_input.port, gpio_drive_n and gpio_sense_n",
            lambda: self._open(settings),
            sleep,
        )

    def _open(self, settings: StopInputSettings) -> _GpioWire:
        try:
            return _GpioWire(settings)
        except ImportError as error:
            raise DeviceMissingError(
                self.where, f"the package gpiod is not installed ({error})", "pip install 'graderd[gpio]'"
            ) from error
