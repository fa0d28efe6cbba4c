"""``graderd can database``: a DBC or KCD file of the configured actuators, for other CAN tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from graderd.config import ConfigError, load
from graderd.drivers.electrak.codec import machine_database
from graderd.hal.settings import ElectrakSettings


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where the configuration cannot be read, or names no actuator on the bus."""
    parser = argparse.ArgumentParser(
        prog="graderd can database",
        description="Print a DBC (or KCD) file of the machine's actuators as they are configured.",
        epilog="examples: graderd can database > machine.dbc | graderd can database --kcd > machine.kcd",
    )
    parser.add_argument("--config", type=Path, help="the configuration; without it the one that graderd would take")
    parser.add_argument("--kcd", action="store_true", help="Kayak's format instead of DBC")
    arguments = parser.parse_args(argv)
    try:
        config = load(arguments.config)
    except ConfigError as error:
        sys.stderr.writelines(f"graderd: {problem}\n" for problem in error.problems)
        return 1
    electraks = {name: axis for name, axis in config.actuators().items() if isinstance(axis, ElectrakSettings)}
    if not electraks:
        sys.stderr.write("graderd: can database: no Electrak is configured; other drivers' messages are not known\n")
        return 1
    database = machine_database(electraks, config.can.source_address_n)
    sys.stdout.write(database.as_kcd_string() if arguments.kcd else database.as_dbc_string())
    return 0


if __name__ == "__main__":
    sys.exit(main())
