"""``python -m graderd.simulator.actuators``: the three actuators of the 1/4-scale machine, usable alone."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
from pathlib import Path

from graderd.drivers.j1939.python_can import can
from graderd.hal.errors import DeviceError, DeviceMissingError
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak

_EPILOG = """examples:
  python -m graderd.simulator.actuators --link /run/user/1000/can     an slcan adapter; open it with python-can's slcan
  python -m graderd.simulator.actuators --can vcan0                   three nodes on a virtual CAN interface
  echo '{"inject": "stuck", "address": 19}'                        on standard input: faults, one JSON object a line
"""


def main() -> int:
    """Run until interrupted; the exit status is 1 where the wire cannot be opened."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.simulator.actuators",
        description="Virtual Thomson Electraks on J1939: two HD (addresses 19 and 20) and one MD (27).",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    wire = parser.add_mutually_exclusive_group(required=True)
    wire.add_argument("--link", type=Path, help="symbolic link to create to an slcan pseudo-terminal")
    wire.add_argument("--can", metavar="CHANNEL", help="SocketCAN interface to join, for example vcan0")
    parser.add_argument("--seed", type=int, default=0, help="seed of noise and dead zones")
    parser.add_argument("--distinct-names", action="store_true", help="give each unit its own NAME (default: equal)")
    arguments = parser.parse_args()
    try:
        asyncio.run(_run(arguments))
    except DeviceError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


async def _run(arguments: argparse.Namespace) -> None:
    units = [
        VirtualElectrak("electrak_hd_b017", 19, 100.0, arguments.seed),
        VirtualElectrak("electrak_hd_b017", 20, 100.0, arguments.seed, identity=2 if arguments.distinct_names else 1),
        VirtualElectrak("electrak_md_a050", 27, 50.0, arguments.seed, identity=3 if arguments.distinct_names else 1),
    ]
    external: can.BusABC | None = None
    if arguments.can:
        try:
            external = can.Bus(interface="socketcan", channel=arguments.can)
        except (OSError, can.CanError) as error:
            remedy = "Create it: ip link add dev vcan0 type vcan && ip link set up vcan0"
            raise DeviceMissingError(f"CAN interface {arguments.can}", f"cannot be opened: {error}", remedy) from error
    bus = VirtualActuatorBus(units, link=arguments.link, bus=external)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    await bus.start()
    _watch_commands(loop, bus)
    sys.stdout.write(json.dumps({"event": "ready", "channel": str(arguments.link or arguments.can)}) + "\n")
    sys.stdout.flush()
    try:
        await stop.wait()
    finally:
        with contextlib.suppress(OSError, ValueError):
            loop.remove_reader(sys.stdin.fileno())
        await bus.close()
        if external is not None:
            external.shutdown()


def _watch_commands(loop: asyncio.AbstractEventLoop, bus: VirtualActuatorBus) -> None:
    def readable() -> None:
        line = sys.stdin.readline()
        if not line:
            loop.remove_reader(sys.stdin.fileno())
            return
        try:
            command = json.loads(line)
            if "inject" in command:
                bus.inject(command.pop("inject"), **command)
            elif "load_n" in command:
                for unit in bus.actuators:
                    if unit.address == command.get("address", unit.address):
                        unit.load_n = float(command["load_n"])
            elif command.get("clear"):
                bus.clear_faults()
        except (ValueError, TypeError, AttributeError) as error:
            sys.stderr.write(f"standard input: {error}\n")

    with contextlib.suppress(OSError, ValueError, PermissionError):  # a plain file or a closed stdin cannot be watched
        loop.add_reader(sys.stdin.fileno(), readable)


if __name__ == "__main__":
    sys.exit(main())
