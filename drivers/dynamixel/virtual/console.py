"""Lines on standard input of the virtual servo: faults, load, cable, a look at the shaft. One JSON line back each."""

from __future__ import annotations

import asyncio
import json
import os
import stat
from typing import Any, TextIO

from drivers.dynamixel.virtual.bus import VirtualServoBus
from drivers.dynamixel.virtual.faults import FAULTS, parse

_HELP = "status | load torque_nm=N | clear | replug | a fault with its parameters, for example: drop rate=0.2"


class Console:
    """Reads commands from ``fd`` on the running event loop and answers on ``out``."""

    def __init__(self, bus: VirtualServoBus, fd: int, out: TextIO) -> None:
        self._bus = bus
        self._fd = fd
        self._out = out
        self._pending = b""
        self._running = False

    def start(self) -> None:
        """Begin to listen, where standard input is something to listen to (a terminal or a pipe)."""
        mode = os.fstat(self._fd).st_mode
        if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or os.isatty(self._fd):
            asyncio.get_running_loop().add_reader(self._fd, self._on_readable)
            self._running = True

    def stop(self) -> None:
        """Listen no more; idempotent."""
        if self._running:
            asyncio.get_running_loop().remove_reader(self._fd)
            self._running = False

    def _on_readable(self) -> None:
        data = os.read(self._fd, 4096)
        if not data:
            self.stop()
            return
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            if line.strip():
                self._out.write(json.dumps(self._obey(line.decode(errors="replace"))) + "\n")
                self._out.flush()

    def _obey(self, line: str) -> dict[str, Any]:
        try:
            name, params = parse(line)
            if name == "help":
                return {"help": _HELP, "faults": {n: {"text": k.text, **k.params} for n, k in FAULTS.items()}}
            if name == "clear" or name == "replug":
                self._bus.clear_faults()
            elif name == "load":
                self._bus.servos[0].load_torque_nm = params["torque_nm"]
            elif name != "status":
                self._bus.inject(name, **params)
        except (ValueError, KeyError, TypeError) as e:
            return {"error": str(e)}
        return self._status()

    def _status(self) -> dict[str, Any]:
        return {
            "link": str(self._bus.link) if self._bus.plugged_in else None,
            "requests_n": self._bus.requests_n,
            "servos": [
                {
                    "id": s.servo_id,
                    "shaft_deg": round(s.shaft_deg, 4),
                    "velocity_deg_per_s": round(s.shaft_velocity_deg_per_s, 3),
                    "torque_on": s.torque_enabled,
                    "watchdog_tripped": s.tripped,
                    "hardware_error": s.memory["hardware_error_status"],
                }
                for s in self._bus.servos
            ],
        }
