"""``graderd calibrate lifts``: is the left lift the left one? Nothing on the bus can tell; the person who looks can.

The two lifts are alike, and so are their messages. With left and right swapped every slope is the other way round, and
is reported as if it were right.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from graderd import places
from graderd.cli.asking import agree, ask, one_of
from graderd.cli.console import CliError, ExitCode, client_of, example, print_text
from graderd.cli.move import move
from graderd.client import Client
from graderd.core.axes import LIFTS

TIMEOUT_S = 30.0


class End(StrEnum):
    """What the person saw rise."""

    LEFT = "left"
    RIGHT = "right"
    NEITHER = "neither"


def register(group: typer.Typer) -> None:
    """Add the command to the group ``calibrate``."""

    @group.command(epilog=example("graderd calibrate lifts", "graderd calibrate lifts --by-deg 0.5"))
    def lifts(
        context: typer.Context,
        by_deg: Annotated[float, typer.Option(min=0.3, max=2.0, help="How far to tilt the blade sideways.")] = 1.0,
        config: Annotated[Path | None, typer.Option(help="Configuration to change, instead of the system's.")] = None,
    ) -> None:
        """Raise the left end a little, lower the right one, and ask which end rose.

        In manual mode, the blade clear of the ground. Afterwards the blade is moved back. Where the ends turn out to be
        swapped, the two addresses are exchanged in the configuration, if you agree; the former file is kept as a dated
        backup. The exit status is 1 where they are swapped or did not move.
        """
        client = client_of(context)
        agree(
            "lifts.clear",
            f"The left end of the blade will rise, the right one sink, by {by_deg:g} deg together. Is it clear?",
        )
        _tilt(client, by_deg)
        try:
            seen = _ask()
        finally:
            _tilt(client, -by_deg)
        match seen:
            case End.LEFT:
                print_text("lifts: left is left")
                return
            case End.NEITHER:
                cause = "the blade did not move, though both actuators said so"
                raise CliError("lifts", cause, "Are these the actuators of this machine? Look at 'graderd can dump'")
            case End.RIGHT:
                _exchange(client, config)
        raise typer.Exit(ExitCode.FAILED)


def _tilt(client: Client, by_deg: float) -> None:
    command = {"command": "jog", "axis": "slope", "value": by_deg, "relative": True}
    move(client, command, LIFTS, None, TIMEOUT_S, as_json=False)


def _ask() -> End:
    question = "Seen by who sits on the machine: which end of the blade rose? left, right or neither"
    return End(ask("lifts.rose", question, one_of(*End)))


def _exchange(client: Client, config: Path | None) -> None:
    from graderd.cli.calibrate import write_calibration

    path = config or places.config()
    running: dict[str, Any] = client.config()
    left_n, right_n = (running.get(name, {}).get("address_n") for name in LIFTS)
    if left_n is None or right_n is None:
        raise CliError("lifts", "left and right are swapped", "Exchange them in the settings of their driver")
    print_text(f"Left and right are swapped: the left one is at address {right_n}, the right one at {left_n}")
    agree("lifts.write", f"Write this into {path}?")
    changes = {"lift_left": {"address_n": right_n}, "lift_right": {"address_n": left_n}}
    backup = write_calibration(path, changes)
    kept = f"; the former file is {backup}" if backup else ""
    print_text(f"written to {path}{kept}\nrestart the daemon, then do this again")
