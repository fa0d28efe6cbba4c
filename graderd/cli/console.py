"""How commands speak: text for people, one JSON object for programs, one line on stderr where something failed; and
how one gives way to a program of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from graderd import places
from graderd.client import Client
from graderd.hal.text import printable, terminal_safe_json

if TYPE_CHECKING:
    from rich.console import RenderableType

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
Row = Sequence[str]


class ExitCode(IntEnum):
    """What the command's exit status says."""

    OK = 0
    FAILED = 1
    USAGE = 2


class CliError(Exception):
    """A command ends with this one line and exit code."""

    def __init__(self, where: str, cause: str, remedy: str = "", exit_code: ExitCode = ExitCode.FAILED) -> None:
        super().__init__(where, cause, remedy)
        self.where = where
        self.cause = cause
        self.remedy = remedy
        self.exit_code = exit_code


DEFAULT_CONFIG: Final = f"Default: {places.CONFIG}; where there is none, your own in ~/.config/graderd."


def client_of(context: typer.Context) -> Client:
    """A client of the daemon that the global options name."""
    options = context.find_root().obj
    return Client(options if isinstance(options, Path) else None)


def error_line(where: str, cause: str, remedy: str = "") -> str:
    """``graderd: WHERE: why. What to do``, in one line whatever the parts contain."""
    head = f"graderd: {where}: {cause}" if where else f"graderd: {cause}"
    if remedy and not remedy.startswith("graderd "):
        remedy = remedy[0].upper() + remedy[1:]
    return printable(" ".join((f"{head.rstrip('.')}. {remedy}" if remedy else head).split()))


def print_error(where: str, cause: str, remedy: str, as_json: bool) -> None:
    """The line on stderr; with ``--json`` the same as an object on stdout."""
    typer.echo(error_line(where, cause, remedy), err=True)
    if as_json:
        print_json({"error": cause, "where": where, "remedy": remedy})


def print_json(value: Any) -> None:
    """One JSON object on one line, flushed: a program may be reading line by line."""
    sys.stdout.write(terminal_safe_json(json.dumps(value, ensure_ascii=False, allow_nan=False)) + "\n")
    sys.stdout.flush()


def print_text(text: str) -> None:
    """Lines for people. Nothing in them commands the terminal; a part that is somebody else's word, and must not begin
    a line of its own, goes through :func:`printable` before it comes here."""
    typer.echo("\n".join(printable(line) for line in text.split("\n")))


def for_people() -> bool:
    """Whether a person looks at a terminal (colours, tables), or a pipe wants plain lines."""
    return sys.stdout.isatty()


def print_table(title: str, header: Row, rows: Sequence[Row]) -> None:
    """A table: ruled and coloured on a terminal, else aligned columns."""
    if for_people():
        print_rich(rich_table(title, header, rows))
        return
    print_text(plain_table(title, header, rows))


def print_rich(*things: RenderableType) -> None:
    """Render on the terminal."""
    from rich.console import Console

    Console().print(*things)


def rich_table(title: str, header: Row, rows: Sequence[Row]) -> RenderableType:
    """The table for a terminal. Cells are texts, never markup: they may carry a device's own words."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    for name in header:
        table.add_column(name)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def plain_table(title: str, header: Row, rows: Sequence[Row]) -> str:
    """The table as aligned text."""
    cells = [tuple(printable(cell) for cell in row) for row in rows]
    lines = [tuple(header), *cells] if any(header) else cells
    widths = [max((len(line[column]) for line in lines), default=0) for column in range(len(header))]
    body = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([title, *(f"  {line}" for line in body)] if title else body)


def example(*lines: str) -> str:
    """Examples for a command's help, one a line; blank lines keep the help from joining them."""
    return "\n\n".join(["Example:" if len(lines) == 1 else "Examples:", *lines])


_PACKAGE = Path(__file__).parents[1]
TAKES_ANYTHING = {"allow_extra_args": True, "ignore_unknown_options": True, "allow_interspersed_args": False}


def hand_over(module: str, arguments: list[str]) -> None:
    """Become ``python -m module``: signals and the exit status are its own from here on.

    Raises:
        CliError: this installation has no such module.
    """
    place = _PACKAGE.joinpath(*module.split(".")[1:])  # looked up as a file: finding a module would import its room
    if not (place.with_suffix(".py").is_file() or (place / "__main__.py").is_file()):
        raise CliError(module, "this installation does not contain it", "install the whole of graderd")
    if arguments[:1] == ["--"]:
        arguments = arguments[1:]
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-P", "-m", module, *arguments])


def decode_through(client: Client, bus: str, module: str, options: list[str]) -> None:
    """Pipe what the daemon hears and sends on ``bus`` to ``module`` as standard input, until the daemon, the decoder's
    reader or the user ends it."""
    command = [sys.executable, "-P", "-m", module, "-", *options]
    with (
        client.bus_text(bus) as texts,
        subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0) as decoder,
    ):
        assert decoder.stdin is not None
        try:
            for text in texts:
                if decoder.poll() is not None:
                    return
                if text.startswith("#"):
                    typer.echo(printable(text.partition("\n")[0]), err=True)
                decoder.stdin.write(text.encode())
        except (BrokenPipeError, KeyboardInterrupt):
            return  # nobody reads on: that is how a live view ends
        finally:
            decoder.terminate()
