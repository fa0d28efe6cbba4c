"""The daemon process: builds everything, runs it in one task group, ends it in order."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import shutil
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from graderd import places
from graderd.api.app import make_app
from graderd.api.server import serve
from graderd.config import Config, ConfigError, load
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.core.tick import Sensed, Tick
from graderd.hal.clock import SystemClock
from graderd.hal.errors import DeviceError
from graderd.record.recorder import Recorder
from graderd.runtime.app.devices import build_devices, build_stop_input, problems
from graderd.runtime.app.journal import set_up_logging
from graderd.runtime.app.last_run import remember
from graderd.runtime.app.live_view import LiveView
from graderd.runtime.app.services import build_services
from graderd.runtime.app.sim import RigProcess, attach, new_rig_directory
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import open_devices
from graderd.runtime.health import HangWatch, HealthWatch, SleepWatch
from graderd.runtime.perception_supervisor import PerceptionSupervisor
from graderd.runtime.port import Port
from graderd.runtime.sd_notify import SystemdNotifier
from graderd.runtime.state_file import StateFile

STATUS_LINE_S = 5.0
RESTART_S = 1.0
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

log = logging.getLogger("graderd")


def run_daemon(
    config_path: Path | None,
    sim: bool,
    rig_dir: Path | None,
    as_json: bool,
    log_level: int = logging.INFO,
    socket: Path | None = None,
) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP. Returns the exit status: 0 after a clean end, 1 where it could not run.
    ``socket``: where to serve, whatever the configuration says."""
    set_up_logging(as_json, log_level)
    try:
        config = served_at(load(config_path), socket)
        refusals = problems(config)
    except ConfigError as error:
        refusals = error.problems
    if refusals:
        for line in refusals:
            log.error("%s", line)
        return 2
    failures: list[DeviceError] = []
    try:
        asyncio.run(_main(config, config_path, sim, rig_dir))
    except* DeviceError as group:
        failures = _leaves(group)
    for failure in failures:
        log.error("%s", failure)
    return 1 if failures else 0


def served_at(config: Config, socket: Path | None) -> Config:
    """The configuration with the socket that is asked for; where nobody names one and the service's place is not ours,
    a place of this user's, which the clients know. Not beside the service, which is what they would talk to."""
    own = places.own_socket()
    service = Path(config.api.socket)
    if socket is None and own is not None and "socket" not in config.api.model_fields_set:
        if os.access(service.parent, os.W_OK) or places.is_there(service):
            return config
        socket = own
        with contextlib.suppress(OSError):  # then the socket cannot be made, which says so
            own.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if socket is None:
        return config
    return config.model_copy(update={"api": config.api.model_copy(update={"socket": str(socket)})})


async def _main(config: Config, source: Path | None, sim: bool, rig_dir: Path | None) -> None:
    rig: RigProcess | None = None
    own_directory: Path | None = None
    if sim and rig_dir is None:
        own_directory = new_rig_directory()
        rig = RigProcess(own_directory)
    try:
        if rig is not None:
            await rig.start()
            config = attach(config, rig.directory)
        elif rig_dir is not None:
            config = attach(config, rig_dir)
        daemon = Daemon(config, source, rig)
        # What was imported stays for good: a full collection that looked at it would hold up several ticks.
        gc.collect()
        gc.freeze()
        await daemon.run()
    finally:
        if rig is not None:
            await rig.stop()
        if own_directory is not None:
            shutil.rmtree(own_directory, ignore_errors=True)


class Daemon:
    """Everything that runs, and the order in which it ends."""

    def __init__(self, config: Config, source: Path | None, rig: RigProcess | None = None) -> None:
        clock = SystemClock()
        self._config = config
        self._source = source
        self._rig = rig
        self._notifier = SystemdNotifier()
        self._hang_watch = HangWatch()
        self._eyes = PerceptionSupervisor(
            config.camera, config.camera.calibration, config.perception, config.blade, clock
        )
        self._devices = build_devices(config, clock, on_bus_stop=self._stop_from_bus)
        self._state_file = StateFile(config.state.directory)
        self._loop = ControlLoop(config, self._devices, self._eyes, clock, self._state_file)
        self._recorder = Recorder(config, self._loop.settings, self._loop.controller, self._eyes)
        services = build_services(config, self._devices, self._loop, self._eyes, self._recorder)
        self._port = Port(config, self._loop, self._devices, self._eyes, services, self._recorder.status)
        self._health = HealthWatch(config)
        self._loop.fault_sources += [self._recorder.faults, self._health.faults, SleepWatch().faults]
        self._stop_input = build_stop_input(config, clock, on_stop=self._stop_from_input)
        if self._stop_input is not None:
            self._loop.fault_sources.append(self._stop_input.faults)
        self._loop.on_tick = self._after_tick
        self._loop.on_step = self._after_step
        if self._recorder.directory is not None:
            for name, watch in self._devices.buses.items():
                watch(self._recorder.listen(name))
        self._status_line_due_s = 0.0
        self._ended = asyncio.Event()

    def _stop_from_bus(self, reason: str) -> None:
        self._loop.stop_now(cmd.Stop(reason=reason, client="can"))

    def _stop_from_input(self, reason: str) -> None:
        self._loop.stop_now(cmd.Stop(reason=reason, client="stop input"))

    def _after_tick(self) -> None:
        """Runs in the tick: nothing here may wait, and nothing that fails here may end it."""
        self._notifier.feed_watchdog()
        tick = self._loop.tick
        tells: tuple[Callable[[], None], ...] = (
            lambda: self._hang_watch.ticked(tick.now_s),
            lambda: self._devices.publish_faults(tick.device_faults(), tick.state.mode is Mode.STOPPED),
            self._port.published,
        )
        for tell in tells:
            try:
                tell()
            except Exception:
                log.exception("after a tick: failed")
        if tick.now_s >= self._status_line_due_s:
            self._status_line_due_s = tick.now_s + STATUS_LINE_S
            self._notifier.status(f"{tick.state.mode}: {tick.state.reason}")

    def _after_step(self, sensed: Sensed, tick: Tick) -> None:
        """Runs in every step of the controller: what fails here may end neither a tick nor a stop."""
        try:
            self._recorder.take(sensed, tick)
        except Exception:
            log.exception("recording a step failed")

    async def run(self) -> None:
        """Run until a signal, then stop motion, close the devices in the configured order, and return."""
        running = asyncio.get_running_loop()
        for number in ENDING_SIGNALS:
            running.add_signal_handler(number, self._on_signal, number)
        answering = asyncio.Event()
        try:
            async with asyncio.TaskGroup() as group:
                api = group.create_task(self._interface(answering), name="api")
                # A second daemon learns here that the socket is taken: before it touches a device.
                await answering.wait()
                remember(self._config, self._source)
                tasks = [
                    group.create_task(self._tick(), name="control-tick"),
                    group.create_task(open_devices(self._devices), name="open-devices"),
                    *(group.create_task(keep_running(name, run), name=name) for name, run in self._helpers().items()),
                ]
                self._notifier.ready("disarmed")
                log.info("ready on %s, disarmed", self._config.api.socket)
                await self._ended.wait()
                # First: who sends thousands of requests a second must not have the time that the devices need.
                api.cancel()
                await self._close_devices()
                for task in tasks:
                    task.cancel()
        finally:
            await self._close_devices()
            self._state_file.settle()
            # Not earlier: a second signal, taken the default way, would end the process before the wires are safe.
            for number in ENDING_SIGNALS:
                running.remove_signal_handler(number)
            self._notifier.close()

    async def _tick(self) -> None:
        """The control loop. Where it fails, motion ends before anything else is ended in order."""
        try:
            await self._loop.run()
        except Exception:
            self._devices.hold_all()
            raise
        finally:
            self._hang_watch.close()  # a helper may need longer than that to end, beside a disk that hangs

    def _helpers(self) -> dict[str, Callable[[], Coroutine[Any, Any, None]]]:
        """What may fail without a word to the blade, and is started again; what it fails to do is told as a fault."""
        helpers = {"perception": self._eyes.run, "health": self._health.run, "recorder": self._recorder.run}
        if self._config.foxglove.port_n is not None:
            view = LiveView(self._config.foxglove, Path(self._config.api.socket))
            helpers["live-view"] = view.run
        if self._stop_input is not None:
            helpers["stop-input"] = self._stop_input.run
        if self._rig is not None:
            helpers["rig"] = self._rig.run
        return helpers

    async def _interface(self, answering: asyncio.Event) -> None:
        """The interface: what keeps it from starting ends the daemon, what fails later is started again."""
        try:
            await self._serve(answering)
        except Exception as error:
            if not answering.is_set():
                raise
            log.error("the interface failed and is started again: %s", error)
            await asyncio.sleep(RESTART_S)
            await keep_running("api", lambda: self._serve(asyncio.Event()))

    async def _serve(self, answering: asyncio.Event) -> None:
        api = self._config.api
        path = Path(api.socket)
        await serve(
            make_app(self._port, api.limits),
            path,
            int(api.socket_mode, 8),
            api.socket_group or None,
            api.tcp,
            limits=api.limits,
            ready=answering,
        )

    def _on_signal(self, number: int) -> None:
        name = signal.Signals(number).name
        log.info("ending: %s received", name)
        self._notifier.stopping()
        if not self._loop.end(f"{name} received"):
            self._recorder.expect_stop()
        self._ended.set()

    async def _close_devices(self) -> None:
        """Motion and torque end in the configured order, within the configured time, whatever a device does."""
        order = self._config.control.shutdown_order
        try:
            async with asyncio.timeout(self._config.control.shutdown_timeout_s):
                for part in order:
                    await self._close_part(part)
                if self._devices.vehicle is not None:
                    await self._devices.vehicle.close()
                await self._devices.link.close()
        except TimeoutError:
            log.error("devices did not close within %.1f s", self._config.control.shutdown_timeout_s)

    async def _close_part(self, part: str) -> None:
        devices = [self._devices.rotation] if part == "rotation" else list(self._devices.actuators.values())
        for result in await asyncio.gather(*(device.close() for device in devices), return_exceptions=True):
            if isinstance(result, Exception):
                log.error("closing %s: %s", part, result)


async def keep_running(name: str, run: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run it until it ends by itself; what fails is told and started again, and never ends control."""
    while True:
        try:
            return await run()
        except Exception as error:
            log.exception("%s failed and is started again: %s", name, error)
            await asyncio.sleep(RESTART_S)


def _leaves(group: BaseExceptionGroup[DeviceError]) -> list[DeviceError]:
    found: list[DeviceError] = []
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            found += _leaves(error)
        elif error not in found:
            found.append(error)
    return found
