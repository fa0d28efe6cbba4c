"""``graderd profile verify | import``: the device against its profile, and a profile for another servo."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from graderd import places
from graderd.cli.console import ExitCode, Json, client_of, example, hand_over, print_json, print_table, print_text

SERVICE_S = 30.0
_IMPORT = "graderd.drivers.dynamixel.model_file"


class Device(StrEnum):
    """Devices whose registers can be read."""

    ROTATION = "rotation"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    profile = typer.Typer(help="Profiles: what graderd knows of a model of device.", no_args_is_help=True)
    app.add_typer(profile, name="profile")

    @profile.callback()
    def group() -> None:
        """Profiles: what graderd knows of a model of device."""

    @profile.command(epilog=example("graderd profile verify rotation"))
    def verify(
        context: typer.Context,
        device: Annotated[Device, typer.Argument(help="Which device.")],
        json: Json = False,
    ) -> None:
        """Print every difference of a device from its profile.

        Moves nothing, and works while the device is refused for what it finds. The exit status is 1 where something is
        wrong; a setting that is merely not the factory's ("default") is shown and is not.
        """
        answer = client_of(context).service(f"{device.value}.verify_profile", SERVICE_S)
        differences = answer.get("differences", [])
        if json:
            print_json(answer)
        elif differences:
            header = tuple(differences[0])
            rows = [tuple(str(difference.get(name, "")) for name in header) for difference in differences]
            print_table(f"{device.value} differs from its profile", header, rows)
        else:
            print_text(f"{device.value}: as its profile says")
        wrong = any(difference["kind"] != "default" for difference in differences)
        raise typer.Exit(ExitCode.FAILED if wrong else ExitCode.OK)

    @profile.command(
        "import",
        epilog=example("sudo graderd profile import PH42-020-S300-R", "graderd profile import pm54.model --to ."),
    )
    def import_(
        model: Annotated[
            str, typer.Argument(metavar="MODEL", help="Name of a servo, or path of a .model file of the Dynamixel SDK.")
        ],
        to: Annotated[
            Path, typer.Option(metavar="FILE", help="The new profile, or the folder for it.")
        ] = places.CONFIG.parent,
        json: Json = False,
    ) -> None:
        """Make a profile for another servo of the PH54's family from the control tables of the Dynamixel SDK.

        Those are PH42-020-S300-R, PH54-100-S500-R, PM42-010-S260-R, PM54-040-S250-R and PM54-060-S250-R. Every
        register, unit and sign is compared with the PH54's; a servo of another family is refused. Name the new file as
        rotation.profile in the configuration.
        """
        hand_over(_IMPORT, [model, "--to", str(to), *["--json"] * json])
