"""``graderd explain FAULT``: what a fault means and what to do. Needs no daemon."""

from __future__ import annotations

import difflib
from typing import Annotated, Any

import typer

from graderd.cli.console import CliError, Json, example, print_json, print_table
from graderd.core.axes import ACTUATORS
from graderd.core.faults.catalogue import CATALOGUE, find_rows
from graderd.core.faults.monitor import FaultRow


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd explain rotation.no_reply", "graderd explain overload"))
    def explain(
        fault: Annotated[
            str | None,
            typer.Argument(
                help="A fault, a condition or a device; without it, all are listed.",
                autocompletion=lambda incomplete: [name for name in CATALOGUE if name.startswith(incomplete)],
            ),
        ] = None,
        json: Json = False,
    ) -> None:
        """Print what a fault means and what to do.

        Also its likely cause, what the machine does, and what ends it.
        """
        rows = tuple(CATALOGUE.values()) if fault is None else find_rows(fault.strip().lower())
        if not rows and fault is not None:
            raise CliError(f"explain {fault}", "there is no such fault", _nearest(fault))
        if json:
            print_json({"faults": [as_dict(row) for row in rows]})
        elif fault is None:
            print_table("", ("fault", "reaction", "what"), [(r.key, r.reaction.name.lower(), r.reads) for r in rows])
        else:
            for row in rows:
                print_table(row.key, ("", ""), [(name, text) for name, text in lines(row)])


def lines(row: FaultRow) -> list[tuple[str, str]]:
    """A row in words: what is asked, and the answer."""
    return [
        ("what", row.reads),
        ("likely cause", row.cause),
        ("what to do", row.remedy),
        ("the machine", f"{row.reaction.name.lower()}: {reaction_text(row)}"),
        ("counts after", "at once" if row.debounce_s == 0 else f"{row.debounce_s:g} s"),
        ("ends", str(row.clear)),
    ]


def reaction_text(row: FaultRow) -> str:
    """What the machine does, with the axes that stay."""
    match row.reaction.name:
        case "WARN":
            return "goes on, and tells"
        case "HOLD":
            return f"{axes_text(row)} stays where it is while the fault lasts"
        case "RETREAT":
            held = f"; {axes_text(row)} stays while the fault lasts" if row.axes else ""
            return f"automatic operation ends, the blade is held and the operator has it in manual{held}"
        case "DISARM":
            return "everything holds, then power is taken away as configured"
        case _:
            return "motion ends at once and stays ended until reset"


def axes_text(row: FaultRow) -> str:
    """The axes of a row, for people."""
    if row.axes == frozenset({"own"}):
        return "its own axis (both lifts for a lift)"
    return " and ".join(sorted(row.axes)) or "no axis"


def as_dict(row: FaultRow) -> dict[str, Any]:
    """A row as JSON."""
    return {
        "fault": row.key,
        "reads": row.reads,
        "cause": row.cause,
        "remedy": row.remedy,
        "reaction": row.reaction.name.lower(),
        "debounce_s": row.debounce_s,
        "clears": str(row.clear),
        "axes": sorted(row.axes),
    }


def _nearest(fault: str) -> str:
    names = [
        *CATALOGUE,
        *(f"{a}.{key.partition('.')[2]}" for a in ACTUATORS for key in CATALOGUE if key.startswith("actuator.")),
        *(key.partition(".")[2] for key in CATALOGUE),
    ]
    near = difflib.get_close_matches(fault, names, n=1, cutoff=0.4)
    return f"Did you mean {near[0]}? 'graderd explain' lists all" if near else "'graderd explain' lists all"
