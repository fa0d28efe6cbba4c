"""``graderd arm | disarm | stop | reset | auto | manual``: from one mode to the other."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer

from graderd.cli.console import CliError, Json, client_of, example, print_json, print_table, print_text
from graderd.client import Client, ClientError, RefusedError
from graderd.hal.text import printable

POLL_S = 0.05


def register(app: typer.Typer) -> None:
    """Add the commands."""

    @app.command(epilog=example("graderd arm && graderd auto"))
    def arm(context: typer.Context, json: Json = False) -> None:
        """Power the devices and hold.

        Lists what is met and what is not, and refuses while anything needed is not.
        """
        client = client_of(context)
        refusal: RefusedError | CliError | None = None
        try:
            send(client, "arm")
            status = _after_arming(client)
        except (RefusedError, CliError) as error:
            refusal, status = error, client.get("/v1/status")
        readiness = status["readiness"]
        if json:
            if refusal is None:
                print_json({"command": "arm", "mode": status["mode"], "readiness": readiness})
        else:
            _print_readiness(readiness)
        if refusal is not None:
            raise refusal
        if not json:
            print_text(f"armed: {status['mode']}")

    @app.command(epilog=example("graderd disarm"))
    def disarm(context: typer.Context, json: Json = False) -> None:
        """Hold, then take power away as configured."""
        _send(context, "disarm", json)

    @app.command(epilog=example("graderd stop --reason 'person near the blade'"))
    def stop(
        context: typer.Context,
        reason: Annotated[str, typer.Option(help="Kept as the reason of the stop.")] = "stop command",
        json: Json = False,
    ) -> None:
        """End motion at once.

        Wins over everything and stays until reset.
        """
        try:
            client = client_of(context)
            # As it came: the typed reply would load the models.
            _tell(client.post("/v1/stop", {"client": client.name, "reason": reason[:200]}), json)
        except ClientError as error:
            error.remedy = f"{error.remedy}. If the blade moves, use the emergency stop"
            raise

    @app.command(epilog=example("graderd reset && graderd arm"))
    def reset(context: typer.Context, json: Json = False) -> None:
        """Leave the latched stop for disarmed.

        It clears the stop that is latched when the command starts, and none that comes meanwhile.
        """
        client = client_of(context)
        _tell(send(client, "reset", stop_n=client.get("/v1/status")["stop_n"]), json)

    @app.command(epilog=example("graderd auto"))
    def auto(context: typer.Context, json: Json = False) -> None:
        """Let the rule turn the blade by what the camera sees."""
        _send(context, "auto", json)

    @app.command(epilog=example("graderd manual && graderd jog rotate +5deg"))
    def manual(context: typer.Context, json: Json = False) -> None:
        """Hold and take jogs."""
        _send(context, "manual", json)


def _send(context: typer.Context, command: str, as_json: bool) -> None:
    _tell(send(client_of(context), command), as_json)


def send(client: Client, command: str, **fields: Any) -> dict[str, Any]:
    """A command; its reply as it came."""
    reply: dict[str, Any] = client.post("/v1/commands", {"command": command, "client": client.name, **fields})
    return reply


def _tell(reply: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(reply)
    else:
        print_text(printable(reply["message"]))


def _after_arming(client: Client) -> dict[str, Any]:
    """Status once arming has ended: the daemon bounds how long that takes (``machine.arm_timeout_s``). Who gave up
    before it would leave a machine that becomes armed after a command that failed.

    Raises:
        CliError: it ended elsewhere than armed.
    """
    while True:
        status: dict[str, Any] = client.get("/v1/status")
        if status["mode"] in ("manual", "auto"):
            return status
        if not status["arming"]:
            raise CliError("arm", status["reason"], "see graderd status")
        time.sleep(POLL_S)


def _print_readiness(readiness: list[dict[str, Any]]) -> None:
    def verdict(requirement: dict[str, Any]) -> str:
        if requirement["met"]:
            return "met"
        return "UNMET" if requirement["mandatory"] else "unmet (may be)"

    rows = [(verdict(r), r["name"], r["reason"], r["remedy"]) for r in readiness]
    print_table("Readiness", ("", "requirement", "reason", "remedy"), rows)
