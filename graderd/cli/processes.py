"""Commands that become a process of their own: ``graderd run``, ``guard``, ``rig`` and ``demo``."""

from __future__ import annotations

import itertools
import logging
import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from graderd.cli.console import (
    DEFAULT_CONFIG,
    TAKES_ANYTHING,
    CliError,
    ExitCode,
    Json,
    client_of,
    example,
    hand_over,
    print_json,
)
from graderd.client import Client


class LogLevel(StrEnum):
    """Least level of the daemon's own log entries."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    _run(app)
    _guard(app)
    _rig(app)
    _demo(app)


def _run(app: typer.Typer) -> None:

    @app.command(epilog=example("graderd run --config /etc/graderd/graderd.toml", "graderd run --sim"))
    def run(
        context: typer.Context,
        config: Annotated[Path | None, typer.Option(help=f"Configuration file. {DEFAULT_CONFIG}")] = None,
        sim: Annotated[bool, typer.Option("--sim", help="Start a simulated grader and run on that.")] = False,
        rig_dir: Annotated[
            Path | None, typer.Option(help="Run on the simulated grader that serves this directory.")
        ] = None,
        log_level: Annotated[
            LogLevel, typer.Option(help="The least important entries that are logged.", case_sensitive=False)
        ] = LogLevel.INFO,
        json: Json = False,
    ) -> None:
        """Run the daemon until SIGINT or SIGTERM.

        It starts disarmed. With --json it logs one object a line. It serves the socket that --socket or $GRADERD_SOCKET
        names, else the configuration's; where neither names one and /run/graderd is not yours, one of your own, which
        the other commands find by themselves.
        """
        if sim and rig_dir is not None:
            raise CliError("run", "--sim and --rig-dir exclude each other", "give one of the two", ExitCode.USAGE)
        from graderd.runtime.app import run_daemon

        level = logging.getLevelNamesMapping()[log_level.upper()]
        named = context.find_root().obj or os.environ.get("GRADERD_SOCKET") or None
        raise typer.Exit(run_daemon(config, sim, rig_dir, json, level, Path(named) if named else None))


def _guard(app: typer.Typer) -> None:

    @app.command(epilog=example("graderd guard --config /etc/graderd/graderd.toml"))
    def guard(
        config: Annotated[Path | None, typer.Option(help=f"Configuration file. {DEFAULT_CONFIG}")] = None,
        json: Json = False,
    ) -> None:
        """Make the machine safe without a daemon.

        Sends motion-disable to the actuators and makes the servo safe. systemd runs it whenever the daemon has
        ended, whatever it ended of. It acts on what the daemon last ran with, also where the file has changed since or
        cannot be read, and on a command line with a mistake in it.
        """
        raise typer.Exit(_make_safe(config, json))


def guard_all_the_same(arguments: list[str]) -> int:
    """``graderd guard`` from a command line that is not right: what can be found in it counts, the rest is left."""
    given = [value for name, value in itertools.pairwise([*arguments, ""]) if name == "--config"]
    given += [argument.removeprefix("--config=") for argument in arguments if argument.startswith("--config=")]
    path = next((Path(value) for value in given if value and not value.startswith("-")), None)
    return _make_safe(path, "--json" in arguments)


def _make_safe(config: Path | None, as_json: bool) -> int:
    from graderd.runtime.app import run_guard
    from graderd.runtime.app.journal import set_up_logging

    set_up_logging(as_json=False)
    status = run_guard(config)
    if as_json:
        print_json({"safe": status == 0})
    return status


def _rig(app: typer.Typer) -> None:

    @app.command(
        context_settings=TAKES_ANYTHING,
        epilog=example(
            "graderd rig --dir grader --seed 1",
            "graderd rig dataset --out frames --scenes 300 --seed 7",
            "graderd rig experiment --out experiment",
            "graderd rig scene left              (lays soil before the blade of a running simulated grader)",
            "graderd rig drive --distance-m 3",
            "graderd rig press --dir grader      (the button of its stop loop; 'release' lets go)",
            "graderd rig -- --help          (all its options)",
        ),
    )
    def rig(context: typer.Context) -> None:
        """Run the simulated grader, or write a data set with it.

        Soil, blade, camera, virtual servo and virtual actuators in a process of their own, which announces itself in
        rig.json in its directory (a JSON object). 'dataset' writes a set of labelled frames instead; 'experiment'
        drives passes over soil left, center, right and even at three angles with its own daemon and measures them.
        'scene',
        'drive', 'halt', 'turn', 'press', 'release', 'unplug' and 'plug' do at the rig of the daemon that runs, or at
        that of --dir, what a person does at a machine. Further arguments are the rig's own.
        """
        arguments = context.args
        if arguments[:1] and arguments[0] in ("dataset", "experiment"):
            hand_over(f"graderd.simulator.{arguments[0]}", arguments[1:])
        elif arguments[:1] and arguments[0] in AT_THE_RIG:
            directory, rest = _directory(arguments[1:])
            control = str(directory / "control.sock") if directory else _control_of(client_of(context))
            hand_over("graderd.simulator.ask", [control, arguments[0], *rest])
        else:
            hand_over("graderd.simulator", arguments)


AT_THE_RIG = ("scene", "drive", "halt", "turn", "press", "release", "unplug", "plug")


def _directory(arguments: list[str]) -> tuple[Path | None, list[str]]:
    """``--dir DIR`` taken out of a rig's arguments."""
    if "--dir" not in arguments[:-1]:
        return None, arguments
    at = arguments.index("--dir")
    return Path(arguments[at + 1]), arguments[:at] + arguments[at + 2 :]


def _control_of(client: Client) -> str:
    """The control socket of the rig that the daemon runs on."""
    config = client.config()
    if not config["simulated"] or config["vehicle"]["source"] != "simulated":
        raise CliError("rig", "the daemon runs on no simulated grader", "start one: graderd run --sim")
    return str(config["vehicle"]["path"])


def _demo(app: typer.Typer) -> None:

    @app.command(epilog=example("graderd demo", "graderd demo --json"))
    def demo(json: Json = False) -> None:
        """Show the whole loop on a simulated grader.

        It is armed and drives over soil left, center, right and even; the command ends by itself.
        """
        hand_over("graderd.simulator.demo", ["--json"] if json else [])
