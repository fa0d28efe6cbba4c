"""``python -m drivers.dynamixel.virtual``: virtual servos on a pty for any Dynamixel software, until Ctrl-C.

Lines on standard input make things go wrong while it runs; ``help`` lists them.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import selectors
import signal
import sys
from pathlib import Path

from drivers.dynamixel.virtual.bus import VirtualServoBus
from drivers.dynamixel.virtual.console import Console
from drivers.dynamixel.virtual.faults import FAULTS, parse
from drivers.dynamixel.virtual.servo import VirtualServo
from drivers.dynamixel.virtual.timing import realtime_timers


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
        prog="python -m drivers.dynamixel.virtual",
        description="Virtual Dynamixel servos on a pseudo-terminal: Protocol 2.0, the whole control table, motion.",
        epilog="example: python -m drivers.dynamixel.virtual --id 1 --baud 57600 --link ./servo --fault drop:rate=0.2"
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
