"""``python -m graderd.simulator.servo``: virtual servos on a pty for any Dynamixel software, until Ctrl-C.

Lines on standard input make things go wrong while it runs; ``help`` lists them.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import selectors
import signal
import stat
import sys
from pathlib import Path
from typing import Any, TextIO

from graderd.simulator.servo.bus import VirtualServoBus, realtime_timers
from graderd.simulator.servo.faults import FAULTS, parse
from graderd.simulator.servo.servo import VirtualServo

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


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    args = _parser().parse_args(arguments)
    try:
        servos = [VirtualServo(servo_id, args.profile, args.seed) for servo_id in args.id or [1]]
        rates = servos[0].table.profile["bus"]["baud_n"]
        if args.baud is not None and args.baud not in rates:
            raise ValueError(f"--baud {args.baud} is none of {', '.join(map(str, rates))}")
        for servo in servos:
            if args.baud is not None:
                servo.memory["baud_rate"] = rates.index(args.baud)
            if args.return_delay_us is not None:
                servo.memory["return_delay_time"] = round(args.return_delay_us / 2)
            servo.shaft_deg = args.shaft_deg
        bus = VirtualServoBus(
            servos,
            args.link,
            wire_time=args.wire_time,
            strict_baud=args.strict_baud,
            byte_gap_s=0.0015 if args.strict_gap else 0.1,
            answer_crc_errors=args.answer_crc_errors,
            linger_s=0.0015 if args.wire_time else 0.0,
            seed=args.seed,
        )
        faults = [parse(text) for text in args.fault]
    except (ValueError, LookupError) as e:
        sys.stderr.write(f"virtual servo: {e}\n")
        return 2
    if args.wire_time:
        realtime_timers()
    # select() waits with microseconds where epoll, asyncio's default, counts whole milliseconds.
    loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(_serve(bus, faults))
    return 0


async def _serve(bus: VirtualServoBus, faults: list[tuple[str, dict[str, float]]]) -> None:
    done = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, done.set)
    await bus.start()
    try:
        for name, params in faults:
            bus.inject(name, **params)
        ids = ", ".join(str(s.servo_id) for s in bus.servos)
        sys.stdout.write(f"{bus.servos[0].table.title}, id {ids}, {bus.baud_n} bit/s, at {bus.link}\n")
        sys.stdout.flush()
        console = Console(bus, sys.stdin.fileno(), sys.stdout)
        console.start()
        await done.wait()
        console.stop()
    finally:
        with contextlib.suppress(OSError):
            await bus.close()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m graderd.simulator.servo",
        description="Virtual Dynamixel servos on a pseudo-terminal: Protocol 2.0, the whole control table, motion.",
        epilog="example: python -m graderd.simulator.servo --id 1 --baud 57600 --link ./servo --fault drop:rate=0.2"
        f" - faults: {', '.join(FAULTS)}",
    )
    parser.add_argument("--link", type=Path, required=True, help="symlink to create; open it as the serial port")
    parser.add_argument("--id", type=int, action="append", help="servo id (repeat for several; default 1)")
    parser.add_argument("--baud", type=int, help="bits per second (default: the factory's 57600)")
    parser.add_argument("--profile", default="ph54_200_s500", help="control table (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="for noise and random faults")
    parser.add_argument("--shaft-deg", type=float, default=0.0, help="angle at the start")
    parser.add_argument("--return-delay-us", type=int, help="default: the factory's 500")
    parser.add_argument("--wire-time", action="store_true", help="answer as late as a real wire would")
    parser.add_argument("--strict-baud", action="store_true", help="hear only clients at the right baud rate")
    parser.add_argument("--strict-gap", action="store_true", help="drop packets with pauses above 1.5 ms")
    parser.add_argument("--answer-crc-errors", action="store_true", help="CRC Error status instead of silence")
    parser.add_argument("--fault", action="append", default=[], metavar="NAME[:KEY=VALUE,…]", help="start with it")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
