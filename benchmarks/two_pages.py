"""What two operator pages cost the daemon: ``python -m benchmarks.two_pages [--json] [--seconds 20]``.

The unmodified daemon on the virtual wires of a rig, with a camera of 30 pictures a second at full size (1280x800
colour, 848x480 depth, held in memory: a driver from elsewhere, in this file). Two clients behave as two pages do: each
follows the status stream and asks for 15 pictures a second, 640 wide. Prints the processor time of the daemon and of
its worker as shares of one core, and how late the tick is at the 99th percentile, without pages and with them.

Bars, on a quiet machine: daemon and worker together at most 60 % of a core with two pages; tick p99 at most 5 ms.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from websockets.asyncio.client import connect

from graderd.client import AsyncClient
from graderd.drivers.backend import CameraBackend
from graderd.hal.camera import Frame
from graderd.hal.settings import PluginCameraSettings, Settings
from graderd.perception.frame_set import FrameSet
from graderd.simulator.dataset import export
from graderd.tokens import Right, create_token

RATE_HZ = 30.0
PAGES_N = 2
PICTURES_HZ = 15.0
STATUSES_HZ = 15.0
SCENES_N = 6
PICTURE = "/v1/preview.jpg?labels=false&width_px=640"
CORE_PERCENT, LATE_MS = 60.0, 5.0
SETTLE_S = 3.0
CONFIG = """
[api]
socket = "{directory}/graderd.sock"
[api.tcp]
port_n = {port_n}
token_file = "{directory}/tokens"
[camera]
source = "benchmarks.two_pages:CAMERA"
rate_hz = {rate_hz}
[camera.driver]
frames = "{directory}/frames"
"""


# ---- the camera ------------------------------------------------------------------------------------------------------


class Table(Settings):
    """``[camera.driver]``."""

    frames: str


class MemorySettings(PluginCameraSettings):
    """``[camera]`` with this driver."""

    driver: Table  # type: ignore[assignment]  # a model of its own, as every driver from elsewhere has


@dataclass
class MemoryCamera:
    """Gives frames of a frame set in turn, in real time, as new buffers, as a camera's driver does."""

    settings: MemorySettings

    @property
    def description(self) -> str:
        return "frames in memory"

    def open(self) -> None:
        self._frames = [frame for _, frame in FrameSet(Path(self.settings.driver.frames)).frames()]
        self._due_s = time.monotonic()
        self._number = 0

    def read(self, timeout_s: float) -> Frame:
        del timeout_s
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        now_s = time.monotonic()
        self._due_s = max(self._due_s + 1.0 / self.settings.rate_hz, now_s)
        self._number += 1
        frame = self._frames[self._number % len(self._frames)]
        depth_mm = None if frame.depth_mm is None else np.array(frame.depth_mm)
        return replace(
            frame,
            color_bgr=np.array(frame.color_bgr),
            depth_mm=depth_mm,
            capture_s=now_s,
            color_number=self._number,
            depth_number=self._number,
        )

    def settings_read_back(self) -> dict[str, float]:
        return {}

    def reset_hardware(self) -> None:
        pass

    def close(self) -> None:
        pass


CAMERA = CameraBackend(MemorySettings, lambda settings, _: MemoryCamera(settings))


# ---- the pages -------------------------------------------------------------------------------------------------------


async def page(port_n: int, token: str) -> None:
    """Ask as the operator page does, until cancelled."""
    await asyncio.gather(statuses(port_n, token), pictures(port_n, token))


async def statuses(port_n: int, token: str) -> None:
    async with connect(
        f"ws://127.0.0.1:{port_n}/v1/stream?rate_hz={STATUSES_HZ:g}&token={token}", proxy=None
    ) as stream:
        async for _ in stream:
            pass


async def pictures(port_n: int, token: str) -> None:
    """Count what comes on standard output: a page that gets fewer costs less."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port_n)
    head = f"GET {PICTURE} HTTP/1.1\r\nHost: localhost:{port_n}\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
    while True:
        began_s = time.monotonic()
        writer.write(head)
        answer = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        if not answer.startswith("http/1.1 200"):
            sys.exit(answer)
        await reader.readexactly(int(answer.split("content-length:", 1)[1].split("\r\n", 1)[0]))
        print(".", end="", flush=True)
        await asyncio.sleep(max(0.0, 1.0 / PICTURES_HZ - (time.monotonic() - began_s)))


# ---- the measurement -------------------------------------------------------------------------------------------------


def used_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


async def measured(daemon: psutil.Process, client: AsyncClient, seconds: float) -> dict[str, float]:
    """Shares of a core over ``seconds``, and the tick's lateness in its last 10 s."""
    (worker,) = (child for child in daemon.children() if "perception_child" in " ".join(child.cmdline()))
    frames_n, began_s = (await client.status()).camera.frames_n, time.monotonic()
    before = used_s(daemon), used_s(worker)
    await asyncio.sleep(seconds)
    took_s, status = time.monotonic() - began_s, await client.status()
    return {
        "frames_per_s": round((status.camera.frames_n - frames_n) / took_s, 1),
        "daemon_percent": round(100.0 * (used_s(daemon) - before[0]) / took_s, 1),
        "worker_percent": round(100.0 * (used_s(worker) - before[1]) / took_s, 1),
        "tick_p99_ms": round(status.tick.lateness_p99_ms, 2),
    }


async def run(seconds: float) -> dict[str, dict[str, float]]:
    """Without pages, and with them."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        export(directory / "frames", SCENES_N, seed=1, progress=False)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port_n = probe.getsockname()[1]
        token = create_token(directory / "tokens", "page", Right.COMMAND)
        config = directory / "graderd.toml"
        config.write_text(CONFIG.format(directory=directory, port_n=port_n, rate_hz=RATE_HZ), encoding="utf-8")
        here = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
        rig = await asyncio.create_subprocess_exec(sys.executable, "-m", "graderd.simulator", "--dir", name)
        while not (directory / "rig.json").exists():  # noqa: ASYNC110  (another process makes it)
            await asyncio.sleep(0.1)
        words = ("-m", "graderd", "run", "--config", str(config), "--rig-dir", name)
        daemon = await asyncio.create_subprocess_exec(
            sys.executable, *words, env=here, stderr=asyncio.subprocess.DEVNULL
        )
        pages: list[asyncio.subprocess.Process] = []
        try:
            async with AsyncClient(directory / "graderd.sock", name="benchmark", timeout_s=10.0) as client:
                await client.until(lambda status: status.soil.frames_per_s > 0.9 * RATE_HZ, 60.0, "pictures")
                await asyncio.sleep(SETTLE_S)
                found = {"no page": await measured(psutil.Process(daemon.pid), client, seconds)}
                asked = (sys.executable, "-m", "benchmarks.two_pages", "--page", str(port_n), token)
                for _ in range(PAGES_N):
                    pages.append(await asyncio.create_subprocess_exec(*asked, stdout=asyncio.subprocess.PIPE))
                came: list[int] = []
                counts = [asyncio.create_task(_count(process, came)) for process in pages]
                while len(came) < PAGES_N * PICTURES_HZ:  # noqa: ASYNC110  (the pages' own start)
                    await asyncio.sleep(SETTLE_S)
                before_n, began_s = len(came), time.monotonic()
                found["two pages"] = await measured(psutil.Process(daemon.pid), client, seconds)
                each_hz = (len(came) - before_n) / PAGES_N / (time.monotonic() - began_s)
                found["two pages"]["pictures_per_s"] = round(each_hz, 1)
                for process in pages:
                    process.kill()
                await asyncio.gather(*counts)
        finally:
            for process in (*pages, daemon, rig):
                if process.returncode is None:
                    process.kill()
                await process.wait()
    return found


async def _count(process: asyncio.subprocess.Process, came: list[int]) -> None:
    """Note a picture for each sign."""
    assert process.stdout is not None
    while said := await process.stdout.read(100):
        came += said


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each of the two measurements")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--page", nargs=2, metavar=("PORT", "TOKEN"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.page:
        asyncio.run(page(int(options.page[0]), options.page[1]))
    found = asyncio.run(run(options.seconds))
    busy = found["two pages"]
    whole = busy["daemon_percent"] + busy["worker_percent"]
    met: dict[str, Any] = {
        f"daemon and worker <= {CORE_PERCENT:g} %": whole <= CORE_PERCENT,
        f"tick p99 <= {LATE_MS:g} ms": busy["tick_p99_ms"] <= LATE_MS,
    }
    if options.json:
        print(json.dumps({"results": found, "met": met}))
    else:
        for name, figures in found.items():
            print(f"{name:<12}" + "  ".join(f"{key} {value:g}" for key, value in figures.items()))
        print("\n".join(f"{'met ' if good else 'MISSED'}  {bar}" for bar, good in met.items()))
    return 0 if all(met.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
