"""The command line's root: global options, all commands, and how errors and exit codes come out."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.main
from typer import Abort, TyperException

from graderd.cli import (
    calibrate,
    can,
    classify,
    config,
    doctor,
    evaluate,
    explain,
    label,
    modes,
    move,
    processes,
    profile,
    record,
    replay,
    report,
    rotation,
    setup,
    status,
    study,
    token,
    watch,
)
from graderd.cli.console import CliError, ExitCode, print_error, print_text
from graderd.client import ClientError
from graderd.hal.errors import DeviceError

INTERRUPTED = 130
"""What typer makes of Ctrl-C."""
COMMANDS = (
    setup,
    processes,
    status,
    watch,
    modes,
    move,
    explain,
    config,
    rotation,
    profile,
    record,
    replay,
    report,
    can,
    classify,
    label,
    evaluate,
    study,
    calibrate,
    token,
    doctor,
)


def make_cli() -> typer.Typer:
    """The whole command line."""
    app = typer.Typer(
        name="graderd",
        help="Runs a motor grader's blade by what a camera sees.",
        epilog="Exit status: 0 done, 1 refused, failed or nobody there, 2 bad usage or configuration; "
        "after Ctrl-C it ends by SIGINT (130 in a shell), once the blade holds.",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
    )

    @app.callback(invoke_without_command=True)
    def root(
        context: typer.Context,
        socket: Annotated[
            Path | None,
            typer.Option(
                help="The daemon's socket. Default: $GRADERD_SOCKET, else what the configuration says, else "
                "/run/graderd/graderd.sock, else $XDG_RUNTIME_DIR/graderd/graderd.sock (without it ~/.local/state).",
            ),
        ] = None,
        version: Annotated[
            bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
        ] = False,
    ) -> None:
        del version
        context.obj = socket
        if context.invoked_subcommand is None:
            print_text(context.get_help())
            raise typer.Exit(ExitCode.USAGE)

    for command in COMMANDS:
        command.register(app)
    return app


def run_app(arguments: list[str]) -> int:
    """Run the command line with ``arguments`` and return the exit status.

    Raises:
        KeyboardInterrupt: Ctrl-C.
        OSError: there is nowhere to print to.
    """
    as_json = "--json" in arguments
    try:
        result = _parser()(arguments, prog_name="graderd", standalone_mode=False)
    except CliError as error:
        print_error(error.where, error.cause, error.remedy, as_json)
        return error.exit_code
    except ClientError as error:
        print_error(error.where, error.cause, error.remedy, as_json)
        return ExitCode.FAILED
    except DeviceError as error:
        print_error(error.where, error.cause, error.remedy, as_json)
        return ExitCode.FAILED
    except TyperException as error:
        context = getattr(error, "ctx", None)
        path = context.command_path if context is not None else "graderd"
        where = path.removeprefix("graderd").strip()
        if error.format_message():  # a group without a command has printed its help instead
            print_error(where, error.format_message(), f"See '{path} --help'", as_json)
        if _command(arguments) == "guard":
            return processes.guard_all_the_same(arguments)
        return ExitCode.USAGE if error.exit_code == ExitCode.USAGE else ExitCode.FAILED
    except Abort:
        return ExitCode.FAILED
    except BrokenPipeError:
        return ExitCode.FAILED
    except OSError as error:  # a file or directory that is not there, or that this user may not use
        if error.filename is None:  # nowhere to print to
            raise
        remedy = (
            "Run it as a user who may use it" if isinstance(error, PermissionError) else "Look at it, or name another"
        )
        print_error(str(error.filename), error.strerror or str(error), remedy, as_json)
        return ExitCode.FAILED
    if result == INTERRUPTED:
        raise KeyboardInterrupt
    return result if isinstance(result, int) else ExitCode.OK


@cache
def _parser() -> Any:
    """Read from the signatures of all commands, once in a process."""
    return typer.main.get_command(make_cli())


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print_text(f"graderd {version('graderd')}")
        raise typer.Exit


def _command(arguments: list[str]) -> str:
    """The first word that is neither an option nor the socket's name."""
    words = iter(arguments)
    for word in words:
        if word == "--socket":
            next(words, None)
        elif not word.startswith("-"):
            return word
    return ""
