"""``python -m drivers.rig --dir DIR``: run the virtual grader."""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
from pathlib import Path

from drivers.rig.server import Rig
from graderd.hal.errors import DeviceError


def main(arguments: list[str] | None = None) -> int:
    """Run the rig until it is told to quit (control socket, SIGINT or SIGTERM)."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.rig",
        description="The virtual grader: soil, blade, camera, a servo on a pseudo-terminal and actuators on CAN.",
        epilog="Example: python -m drivers.rig --dir /run/user/1000/rig --seed 7",
    )
    parser.add_argument("--dir", type=Path, required=True, help="folder for the links, sockets and rig.json")
    parser.add_argument(
        "--can", metavar="INTERFACE:CHANNEL", help="join this bus (socketcan:vcan0) instead of an slcan pty"
    )
    parser.add_argument("--seed", type=int, default=0, help="of textures and noise (default 0)")
    options = parser.parse_args(arguments)
    if options.can is not None and ":" not in options.can:
        parser.error(f"--can {options.can}: give the interface too, as in socketcan:{options.can}")
    if not 0 <= options.seed < 2**32:
        parser.error(f"--seed {options.seed}: must be from 0 to 4294967295")
    try:
        asyncio.run(_run(options.dir, options.can, options.seed))
    except DeviceError as error:
        sys.stderr.write(f"rig: {error}\n")
        return 1
    return 0


async def _run(directory: Path, can_channel: str | None, seed: int) -> None:
    rig = Rig(directory, can_channel=can_channel, seed=seed)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, rig.stop)
    await rig.run()


if __name__ == "__main__":
    raise SystemExit(main())
