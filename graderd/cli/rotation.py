"""``graderd rotation reboot | scan | confirm-turns | step | dump``: the servo that turns the blade."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from graderd.cli.console import (
    CliError,
    ExitCode,
    Json,
    client_of,
    decode_through,
    example,
    for_people,
    hand_over,
    print_json,
    print_table,
    print_text,
)
from graderd.client import Client

SERVICE_S = 120.0
_DUMP = "graderd.drivers.dynamixel.dump"
Yes = Annotated[
    bool, typer.Option("--yes", help="You have looked: nobody is near the blade, and it may move or lose its power.")
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    rotation = typer.Typer(help="Services of the blade's servo, and its wire.", no_args_is_help=True)
    app.add_typer(rotation, name="rotation")

    @rotation.command(epilog=example("graderd rotation reboot --yes"))
    def reboot(context: typer.Context, yes: Yes = False, json: Json = False) -> None:
        """Reboot the servo, which clears its alerts.

        Disarmed only; the blade has no torque for a moment.
        """
        need_consent("rotation reboot", "the blade loses its torque for a moment", yes)
        answer = client_of(context).service("rotation.reboot", SERVICE_S, consent=True)
        if json:
            print_json(answer)
        else:
            print_text("the servo has restarted; arm when its alerts are gone")

    @rotation.command(epilog=example("graderd rotation scan --yes"))
    def scan(context: typer.Context, yes: Yes = False, json: Json = False) -> None:
        """Find every servo on the wire: its baud rate, id, model and firmware.

        Disarmed only. Nothing but pings is sent; the servo in use is lost for ten seconds and found again.
        """
        need_consent("rotation scan", "the servo is not watched for ten seconds", yes)
        answer = client_of(context).service("rotation.scan", SERVICE_S, consent=True)
        servos = answer.get("servos", [])
        if json:
            print_json(answer)
        elif servos:
            header = tuple(servos[0])
            print_table("Servos", header, [tuple(str(servo[name]) for name in header) for servo in servos])
        else:
            print_text("no servo answers at any baud rate: check the 24 V supply and the RS-485 cable")

    @rotation.command(epilog=example("graderd rotation confirm-turns --yes"))
    def confirm_turns(context: typer.Context, yes: Yes = False, json: Json = False) -> None:
        """Say that the angle shown is the blade's, after whole turns were lost.

        Look at the blade and compare it with the angle of 'graderd status' first. Disarmed only.
        """
        need_consent("rotation confirm-turns", "the angle shown is taken for the blade's", yes)
        answer = client_of(context).service("rotation.confirm_turns", SERVICE_S, consent=True)
        if json:
            print_json(answer)
        else:
            print_text("taken; arm when the area around the blade is clear")

    @rotation.command(epilog=example("graderd rotation step --by-deg 10 --report step.html --yes"))
    def step(
        context: typer.Context,
        by_deg: Annotated[float, typer.Option(min=-45.0, max=45.0, help="Size of the step.")] = 10.0,
        report: Annotated[Path | None, typer.Option(help="Write the report page (HTML) here.")] = None,
        yes: Yes = False,
        json: Json = False,
    ) -> None:
        """Turn the blade by a step and back, and report.

        Rise, overshoot, settling and play, with the settings used. Disarmed only.
        """
        if report is not None and not os.access(report if report.exists() else report.parent, os.W_OK):
            raise CliError(str(report), "cannot be written", "choose another --report; nothing has moved")
        need_consent("rotation step", f"the blade turns by {by_deg:+g} degrees and back", yes)
        answer = client_of(context).maneuver("rotation.step_response", SERVICE_S, consent=True, step_deg=by_deg)
        page = answer.pop("report_html", None)
        if report is not None:
            _write(report, page)
        if json:
            print_json(answer)
        else:
            _print_answer(answer)
            if report is not None:
                print_text(f"report: {report}")

    @rotation.command(
        epilog=example(
            "graderd rotation dump                (the running daemon's wire)",
            "graderd rotation dump --raw > servo.log",
            "graderd rotation dump servo.log --json",
        )
    )
    def dump(
        context: typer.Context,
        source: Annotated[str, typer.Argument(help="File that --raw wrote. Default: the running daemon's wire.")] = "",
        raw: Annotated[bool, typer.Option("--raw", help="Print the bytes as they come, one piece a line.")] = False,
        profile: Annotated[
            str, typer.Option(help="Firmware profile whose registers are named. Default: the daemon's.")
        ] = "",
        json: Json = False,
    ) -> None:
        """Print the servo's wire decoded, both directions, live or from a file.

        One line a packet: seconds of the daemon's clock, direction (tx is sent by the daemon), id, instruction, bytes
        of the control table, registers. What is damaged is told as such. With --json one object a packet.
        """
        options = ["--json"] * json
        if source:
            hand_over(_DUMP, [source, *options, *(["--profile", profile] if profile else [])])
            return
        client = client_of(context)
        if raw:
            _print_raw(client)
            return
        profile = profile or client.config()["rotation"].get("profile", "")
        decode_through(client, "servo", _DUMP, [*options, *(["--profile", profile] if profile else [])])


def need_consent(where: str, what: str, yes: bool) -> None:
    """Ask the person at the terminal, unless ``--yes`` was given.

    Raises:
        CliError: no, or nobody to ask.
    """
    if yes:
        return
    if not for_people():
        raise CliError(where, f"{what}, and nobody is there to agree", "repeat with --yes", ExitCode.USAGE)
    if not typer.confirm(f"{what.capitalize()}. Is nobody near it?"):
        raise CliError(where, "not agreed; nothing was done")


def _print_raw(client: Client) -> None:
    with client.bus_text("servo") as texts, contextlib.suppress(KeyboardInterrupt):
        for text in texts:
            print_text(text.rstrip("\n"))


def _write(report: Path, page: Any) -> None:
    if not isinstance(page, str):
        raise CliError("rotation step", "the daemon gave no report page", "see its log")
    try:
        report.write_text(page, encoding="utf-8")
    except OSError as error:
        raise CliError(str(report), f"cannot be written: {error.strerror}", "choose another --report") from error


def _print_answer(answer: dict[str, Any]) -> None:
    """Single values in one table, each list of records in a table of its own."""
    lists = {name: value for name, value in answer.items() if isinstance(value, list) and value}
    rows = [(name, _text(value)) for name, value in answer.items() if name not in lists]
    for name, records in lists.items():
        header = tuple(records[0])
        print_table(name, header, [tuple(_text(record.get(column)) for column in header) for record in records])
    print_table("Step response", ("", ""), rows)


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(entry)}" for name, entry in value.items())
    return f"{value:.3g}" if isinstance(value, float) else str(value)
