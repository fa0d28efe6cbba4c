"""``graderd profile verify DEVICE``: the device against its profile."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from graderd.cli.console import ExitCode, Json, client_of, example, print_json, print_table, print_text

SERVICE_S = 30.0


class Device(StrEnum):
    """Devices whose registers can be read."""

    ROTATION = "rotation"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    profile = typer.Typer(help="Compare devices with their profiles.", no_args_is_help=True)
    app.add_typer(profile, name="profile")

    @profile.callback()
    def group() -> None:
        """Compare devices with their profiles."""

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
