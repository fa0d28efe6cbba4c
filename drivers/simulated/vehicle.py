"""The rig's vehicle: asks the rig's control socket for speed and distance, as a wheel sensor would be asked."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging

from graderd.hal.clock import Clock
from graderd.hal.reading import Reading
from graderd.hal.vehicle import VehicleTelemetry

_QUESTION = b'{"cmd": "vehicle"}\n'
_PERIOD_S = 0.05
_TIMEOUT_S = 0.5
_RETRY_S = 0.5

_log = logging.getLogger(__name__)


class SimulatedVehicle:
    """See :class:`graderd.hal.vehicle.Vehicle`. A rig that ends is asked again until there is one."""

    def __init__(self, path: str, clock: Clock) -> None:
        self._path = path
        self._clock = clock
        self._telemetry = VehicleTelemetry()
        self._task: asyncio.Task[None] | None = None

    @property
    def where(self) -> str:
        """See the contract."""
        return f"simulated vehicle at {self._path}"

    async def open(self) -> None:
        """See the contract."""
        if self._task is None:
            self._task = asyncio.create_task(self._run(), name="simulated-vehicle")

    def telemetry(self) -> VehicleTelemetry:
        """See the contract."""
        return self._telemetry

    async def close(self) -> None:
        """See the contract."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def _run(self) -> None:
        said = ""
        while True:
            try:
                await self._listen()
            except (OSError, TimeoutError, ValueError, KeyError, TypeError) as error:
                if (why := str(error) or type(error).__name__) != said:
                    _log.warning("%s: not told (%s); asking again", self.where, why)
                    said = why
            await asyncio.sleep(_RETRY_S)

    async def _listen(self) -> None:
        """Ask until something fails.

        Raises:
            OSError, TimeoutError, ValueError, KeyError, TypeError: nobody there, no answer, or one that makes no sense.
        """
        reader, writer = await asyncio.open_unix_connection(self._path)
        try:
            while True:
                asked_s = self._clock.now_s()
                writer.write(_QUESTION)
                async with asyncio.timeout(_TIMEOUT_S):
                    await writer.drain()
                    answer = json.loads(await reader.readline())
                # As old as the question: it was true some time between it and the answer.
                self._telemetry = VehicleTelemetry(
                    Reading(float(answer["speed_m_per_s"]), asked_s), Reading(float(answer["travelled_m"]), asked_s)
                )
                await asyncio.sleep(_PERIOD_S)
        finally:
            writer.close()
