"""``python -m graderd.simulator --dir DIR``: run the virtual grader."""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import signal
import sys
from pathlib import Path

from graderd.hal.errors import DeviceError
from graderd.simulator.process import Rig


def main(arguments: list[str] | None = None) -> int:
    """Run the rig until it is told to quit (control socket, SIGINT or SIGTERM)."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.simulator",
        description="The virtual grader: soil, blade, camera, a servo on a pseudo-terminal and actuators on CAN.",
        epilog="Example: python -m graderd.simulator --dir /run/user/1000/rig --seed 7",
    )
    parser.add_argument("--dir", type=Path, required=True, help="folder for the links, sockets and rig.json")
    parser.add_argument(
        "--can", metavar="INTERFACE:CHANNEL", help="join this bus (socketcan:vcan0) instead of an slcan pty"
    )
    parser.add_argument("--seed", type=int, default=0, help="of textures and noise (default 0)")
    parser.add_argument(
        "--linger-s",
        type=float,
        metavar="S",
        help="quit so many seconds after standard input ended: the program that started the rig is gone",
    )
    options = parser.parse_args(arguments)
    if options.can is not None and ":" not in options.can:
        parser.error(f"--can {options.can}: give the interface too, as in socketcan:{options.can}")
    if not 0 <= options.seed < 2**32:
        parser.error(f"--seed {options.seed}: must be from 0 to 4294967295")
    try:
        asyncio.run(_run(options.dir, options.can, options.seed, options.linger_s))
    except DeviceError as error:
        sys.stderr.write(f"rig: {error}\n")
        return 1
    return 0


async def _run(directory: Path, can_channel: str | None, seed: int, linger_s: float | None) -> None:
    rig = Rig(directory, can_channel=can_channel, seed=seed)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, rig.stop)
    if linger_s is not None:
        _stop_after_input(loop, rig, linger_s)
    # What was imported stays for good: a full collection that looked at it would hold up both wires.
    gc.collect()
    gc.freeze()
    await rig.run()


def _stop_after_input(loop: asyncio.AbstractEventLoop, rig: Rig, linger_s: float) -> None:
    """Nobody writes to the pipe: that it becomes readable means that its other end is gone."""

    def ended() -> None:
        if not os.read(sys.stdin.fileno(), 4096):
            loop.remove_reader(sys.stdin.fileno())
            loop.call_later(linger_s, rig.stop)

    loop.add_reader(sys.stdin.fileno(), ended)


if __name__ == "__main__":
    raise SystemExit(main())
