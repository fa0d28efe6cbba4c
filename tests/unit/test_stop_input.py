"""The stop input: an open loop, a lost port, a silent one and a short circuit all mean stop."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gpiod
import pytest
from pydantic import ValidationError

from graderd.config import Config
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, Reaction
from graderd.drivers.simulated.stop_input import SimulatedStopInput
from graderd.drivers.stop_input import GpioStopInput, SerialStopInput
from graderd.hal.clock import ManualClock, SystemClock
from graderd.hal.errors import DeviceLostError, DeviceMissingError
from graderd.hal.settings import StopInputSettings
from graderd.hal.stop_input import StopInput
from graderd.runtime.stop_input import FIRST_WORD_S, StopInputWatch
from graderd.simulator.stop_loop import StopLoop
from harness.awake_clock import AwakeClock
from tests.contract.conformance import StopInputConformance, StopInputStand

DEADLINE_S = 5.0


class FakePort:
    """The modem lines of a serial port with a loop from RTS to CTS."""

    def __init__(self) -> None:
        self.rts = self.dtr = False
        self.pressed = self.shorted = self.gone = False
        self.closed_n = 0

    @property
    def cts(self) -> bool:
        if self.gone:
            raise OSError(5, "Input/output error")
        return self.shorted or (self.rts and not self.pressed)

    @property
    def dsr(self) -> bool:
        return False

    @property
    def cd(self) -> bool:
        return self.dtr

    def close(self) -> None:
        self.closed_n += 1


def serial_input(port: FakePort, **settings: Any) -> SerialStopInput:
    return SerialStopInput(
        StopInputSettings(backend="serial", port="/dev/null", **settings),
        open_port=lambda _: port,
        sleep=lambda _: None,
    )


def test_the_serial_loop_reads_closed_only_while_driven_and_unbroken() -> None:
    port = FakePort()
    source = serial_input(port)
    source.open()
    assert port.rts
    assert source.is_closed()
    port.pressed = True
    assert not source.is_closed()
    port.pressed = False
    assert source.is_closed()


def test_a_test_pulse_finds_a_short_circuit_and_leaves_the_loop_driven() -> None:
    port = FakePort()
    source = serial_input(port)
    source.open()
    assert source.follows()
    assert port.rts
    port.shorted = True
    assert source.is_closed()
    assert not source.follows()
    assert port.rts


def test_other_lines_can_be_chosen() -> None:
    port = FakePort()
    source = serial_input(port, drive="dtr", line="cd")
    source.open()
    assert port.dtr
    assert source.is_closed()
    assert source.where == "/dev/null CD"


def test_a_pulled_adapter_is_lost_and_the_port_let_go() -> None:
    port = FakePort()
    source = serial_input(port)
    source.open()
    port.gone = True
    with pytest.raises(DeviceLostError, match="is gone"):
        source.is_closed()
    assert port.closed_n == 1
    with pytest.raises(DeviceLostError, match="not open"):
        source.follows()
    with pytest.raises(DeviceMissingError, match=r"stop_input\.port"):
        source.open()


def test_a_port_that_is_not_there_or_has_no_lines_is_missing(tmp_path: Path) -> None:
    missing = SerialStopInput(StopInputSettings(backend="serial", port=str(tmp_path / "none")))
    with pytest.raises(DeviceMissingError, match="Check its cable"):
        missing.open()
    # A pseudo-terminal opens, and has no modem lines: the ioctl fails.
    import pty

    master, slave = pty.openpty()
    import os

    try:
        without = SerialStopInput(StopInputSettings(backend="serial", port=os.ttyname(slave)))
        with pytest.raises(DeviceMissingError):
            without.open()
    finally:
        os.close(master)
        os.close(slave)


class FakeGpio:
    """The kernel's side of ``gpiod.request_lines``: a chip with a loop from line 17 to line 27."""

    def __init__(self) -> None:
        self.asked: dict[int, gpiod.LineSettings] = {}
        self.driven = self.pressed = self.shorted = self.gone = False
        self.releases_n = 0

    def request_lines(self, path: str, consumer: str, config: dict[int, gpiod.LineSettings]) -> FakeGpio:
        if self.gone:
            raise FileNotFoundError(2, "No such file or directory", path)
        assert consumer == "graderd stop input"
        self.asked = config
        self.driven = config[17].output_value is gpiod.line.Value.ACTIVE
        return self

    def set_value(self, line: int, value: gpiod.line.Value) -> None:
        assert line == 17
        self.driven = value is gpiod.line.Value.ACTIVE

    def get_value(self, line: int) -> gpiod.line.Value:
        if self.gone:
            raise OSError(19, "No such device")
        assert line == 27
        closed = self.shorted or (self.driven and not self.pressed)
        return gpiod.line.Value.ACTIVE if closed else gpiod.line.Value.INACTIVE

    def release(self) -> None:
        self.releases_n += 1


@pytest.fixture
def gpio(monkeypatch: pytest.MonkeyPatch) -> FakeGpio:
    chip = FakeGpio()
    monkeypatch.setattr(gpiod, "request_lines", chip.request_lines)
    return chip


def gpio_input(**settings: Any) -> GpioStopInput:
    lines = {"gpio_drive_n": 17, "gpio_sense_n": 27}
    asked = StopInputSettings.model_validate({"backend": "gpio", "port": "/dev/gpiochip9", **lines, **settings})
    return GpioStopInput(asked, sleep=lambda _: None)


def test_the_gpio_loop_is_driven_pulled_down_and_read(gpio: FakeGpio) -> None:
    source = gpio_input()
    source.open()
    assert gpio.asked[17].direction is gpiod.line.Direction.OUTPUT
    assert gpio.asked[27].direction is gpiod.line.Direction.INPUT
    assert gpio.asked[27].bias is gpiod.line.Bias.PULL_DOWN
    assert source.is_closed()
    gpio.pressed = True
    assert not source.is_closed()
    gpio.pressed = False
    assert source.follows()
    assert gpio.driven
    gpio.shorted = True
    assert source.is_closed()
    assert not source.follows()
    assert gpio.driven
    source.close()
    source.close()
    assert gpio.releases_n == 1


def test_a_resistor_may_pull_the_gpio_line_down(gpio: FakeGpio) -> None:
    gpio_input(gpio_pull_down=False).open()
    assert gpio.asked[27].bias is gpiod.line.Bias.AS_IS


def test_a_gpio_chip_that_goes_is_lost_and_let_go(gpio: FakeGpio) -> None:
    source = gpio_input()
    source.open()
    gpio.gone = True
    with pytest.raises(DeviceLostError, match="is gone"):
        source.is_closed()
    assert gpio.releases_n == 1
    with pytest.raises(DeviceMissingError, match="gpio_drive_n"):
        source.open()


def test_a_gpio_chip_that_is_not_there_is_missing(tmp_path: Path) -> None:
    """Through the real library: no such file, and a file that is no chip."""
    no_chip = tmp_path / "file"
    no_chip.write_text("", encoding="utf-8")
    for path in (tmp_path / "none", no_chip, Path("/dev/null")):
        source = GpioStopInput(StopInputSettings(backend="gpio", port=str(path)))
        with pytest.raises(DeviceMissingError, match="cannot be used as stop input"):
            source.open()


def test_without_its_package_the_gpio_backend_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(DeviceMissingError, match=r"graderd\[gpio\]"):
        gpio_input().open()


def test_settings() -> None:
    assert Config().stop_input.backend == "none"
    with pytest.raises(ValidationError, match="needs a port"):
        StopInputSettings(backend="serial")
    with pytest.raises(ValidationError, match="needs a port"):
        StopInputSettings(backend="gpio")
    with pytest.raises(ValidationError, match="two lines"):
        StopInputSettings(backend="gpio", port="/dev/gpiochip0", gpio_drive_n=4, gpio_sense_n=4)


@pytest.mark.parametrize("condition", ["open", "lost", "stale", "stuck"])
def test_every_condition_stops_until_reset(condition: str) -> None:
    row = CATALOGUE[f"stop_input.{condition}"]
    assert row.reaction is Reaction.STOP
    assert row.clear is Clear.ON_RESET
    assert row.debounce_s == 0.0


class Watching:
    """A watch over the simulated loop, and what it told."""

    def __init__(
        self, watch: StopInputWatch, loop: StopLoop, stops: list[tuple[float, str]], clock: AwakeClock
    ) -> None:
        self.watch = watch
        self.loop = loop
        self.stops = stops
        self.clock = clock

    async def permitted(self) -> None:
        """Wait until the loop was read and found closed."""
        await self.until(lambda: not self.watch._word.condition and self.conditions() == [])

    def conditions(self) -> list[str]:
        return [fault.condition for fault in self.watch.faults(self.clock.now_s())]

    async def until(self, reached: Callable[[], bool]) -> None:
        async with asyncio.timeout(DEADLINE_S):
            while not reached():
                await asyncio.sleep(0.005)


@asynccontextmanager
async def watching(tmp_path: Path, source: StopInput | None = None, **settings: Any) -> AsyncIterator[Watching]:
    loop = StopLoop(tmp_path / "stop.sock")
    await loop.start()
    stops: list[tuple[float, str]] = []
    clock = AwakeClock()
    watch = StopInputWatch(
        StopInputSettings(backend="simulated", **settings),
        source or SimulatedStopInput(str(loop.path)),
        clock,
        lambda reason: stops.append((clock.now_s(), reason)),
    )
    task = asyncio.create_task(watch.run(), name="watch")
    try:
        yield Watching(watch, loop, stops, clock)
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        await loop.close()
        async with asyncio.timeout(DEADLINE_S):
            while any(thread.name == "stop-input" for thread in threading.enumerate()):
                await asyncio.sleep(0.01)


async def test_without_a_first_reading_it_soon_means_stop(tmp_path: Path) -> None:
    watch = StopInputWatch(StopInputSettings(), SimulatedStopInput("nowhere"), SystemClock(), lambda _: None)
    now_s = time.monotonic()
    assert watch.faults(now_s) == ()
    assert [fault.condition for fault in watch.faults(now_s + FIRST_WORD_S)] == ["lost"]


@pytest.mark.live
async def test_a_press_is_told_at_once_and_once_and_stands_until_released(tmp_path: Path) -> None:
    async with watching(tmp_path) as w:
        await w.permitted()
        pressed_s = w.clock.now_s()
        await w.loop.become("open")
        await w.until(lambda: bool(w.stops))
        # Two looks at 100 Hz; the rest is for a loaded machine.
        assert w.stops[0][0] - pressed_s < 0.5
        assert "open" in w.stops[0][1]
        assert w.conditions() == ["open"]
        await asyncio.sleep(0.1)
        assert len(w.stops) == 1
        await w.loop.become("closed")
        await w.permitted()


@pytest.mark.parametrize(
    ("looks", "found"),
    [
        ("CCOCCCCCOCCCCCCOCCCC", [""]),  # now and then one alone: a disturbance
        ("CCCC" + "OC" * 10, ["", "open"]),  # a contact that shakes is no closed one
        ("CCCC" + "OCC" * 10, ["", "open"]),
        ("COO" + "CO" * 5 + "C" * 5 + "OC", ["", "open"]),  # and stays open while it does
        ("COO" + "C" * 6, ["", "open", ""]),
    ],
)
def test_a_loop_that_opens_again_and_again_is_open(
    looks: str, found: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Shaking(SimulatedStopInput):
        def is_closed(self) -> bool:
            if len(left) == 1:
                watch._ending.set()
            return left.pop(0) == "C"

    left, told = list(looks), list[str]()
    settings = StopInputSettings(backend="simulated", poll_hz=1000.0, test_every_s=0.0)
    watch = StopInputWatch(settings, Shaking("nowhere"), ManualClock(0.0), lambda _: None)
    say = watch._say

    def heard(loop: asyncio.AbstractEventLoop, condition: str, detail: str) -> None:
        told.append(condition)
        say(loop, condition, detail)

    monkeypatch.setattr(watch, "_say", heard)
    watch._read_loop(cast("Any", SimpleNamespace(call_soon_threadsafe=lambda call, *said: call(*said))))
    assert [condition for condition, _ in groupby(told)] == found


@pytest.mark.live
async def test_a_lost_loop_is_told_and_found_again(tmp_path: Path) -> None:
    async with watching(tmp_path) as w:
        await w.permitted()
        await w.loop.become("gone")
        await w.until(lambda: w.conditions() == ["lost"])
        await w.until(lambda: bool(w.stops))
        await w.loop.become("closed")
        await w.permitted()


@pytest.mark.live
async def test_a_short_circuit_is_found_by_the_test_pulse(tmp_path: Path) -> None:
    async with watching(tmp_path, test_every_s=0.05) as w:
        await w.permitted()
        await w.loop.become("shorted")
        await w.until(lambda: w.conditions() == ["stuck"])
        await w.until(lambda: bool(w.stops))
        await w.loop.become("closed")
        await w.permitted()


@pytest.mark.live
async def test_a_port_that_blocks_is_stale_and_nothing_else_waits_for_it(tmp_path: Path) -> None:
    release = threading.Event()

    class Blocking(SimulatedStopInput):
        def is_closed(self) -> bool:
            release.wait(DEADLINE_S)
            return super().is_closed()

    async with watching(tmp_path, Blocking(str(tmp_path / "stop.sock")), stale_s=0.1) as w:
        # Never read: lost from the beginning, whatever its age.
        assert [f.condition for f in w.watch.faults(w.clock.now_s() + FIRST_WORD_S)] == ["lost"]
        release.set()
        await w.permitted()
        release.clear()
        await w.until(lambda: w.conditions() == ["stale"])
        release.set()
        await w.permitted()


@pytest.mark.live
async def test_a_silent_loop_is_stale_then_lost(tmp_path: Path) -> None:
    async with watching(tmp_path, stale_s=0.1) as w:
        await w.permitted()
        await w.loop.become("silent")
        await w.until(lambda: w.conditions() == ["stale"])
        await w.until(lambda: w.conditions() == ["lost"])
        await w.loop.become("closed")
        await w.permitted()


def test_a_frozen_process_does_not_take_its_own_silence_for_the_loops(tmp_path: Path) -> None:
    settings = StopInputSettings(backend="simulated", port=str(tmp_path / "stop.sock"))
    watch = StopInputWatch(settings, SimulatedStopInput(settings.port), ManualClock(0.0), lambda _: None)
    read_s = FIRST_WORD_S + 1.0
    watch._word = replace(watch._word, condition="", time_s=read_s)
    assert watch.faults(read_s) == ()
    thawed_s = read_s + 1.0
    assert watch.faults(thawed_s) == ()
    after_s = thawed_s + 2.0 / settings.poll_hz
    assert watch.faults(after_s - 1e-6) == ()
    assert [fault.condition for fault in watch.faults(after_s)] == ["stale"]


class WiredStand(StopInputStand):
    """A driver on a fake port or chip."""

    def __init__(self, source: StopInput, wire: FakePort | FakeGpio) -> None:
        self.source = source
        self._wire = wire

    def become(self, loop: str) -> None:
        self._wire.pressed, self._wire.shorted, self._wire.gone = loop == "open", loop == "shorted", loop == "gone"


class TestSerial(StopInputConformance):
    @pytest.fixture
    def stop_stand(self) -> WiredStand:
        port = FakePort()
        return WiredStand(serial_input(port), port)


class TestGpio(StopInputConformance):
    @pytest.fixture
    def stop_stand(self, gpio: FakeGpio) -> WiredStand:
        return WiredStand(gpio_input(), gpio)


class SimulatedStand(StopInputStand):
    """The simulator's loop, served from a thread, because the driver's calls block."""

    def __init__(self, path: Path) -> None:
        self.source = SimulatedStopInput(str(path))
        self._events = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._events.run_forever, name="stop-loop")
        self._thread.start()
        self._loop = StopLoop(path)
        self.become("closed")

    def become(self, loop: str) -> None:
        asyncio.run_coroutine_threadsafe(self._loop.become(loop), self._events).result(DEADLINE_S)  # type: ignore[arg-type]

    def end(self) -> None:
        self.source.close()
        self.become("gone")

        async def rest() -> None:
            await asyncio.gather(*(asyncio.all_tasks() - {asyncio.current_task()}), return_exceptions=True)

        asyncio.run_coroutine_threadsafe(rest(), self._events).result(DEADLINE_S)
        self._events.call_soon_threadsafe(self._events.stop)
        self._thread.join()
        self._events.close()


@pytest.mark.live
class TestSimulated(StopInputConformance):
    @pytest.fixture
    def stop_stand(self, tmp_path: Path) -> Iterator[SimulatedStand]:
        made = SimulatedStand(tmp_path / "stop.sock")
        yield made
        made.end()
