"""``python -m graderd.cli.docs [FOLDER]``: writes docs/operators/{faults,cli,study}.md, the pages made from data."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from typer.main import get_command

from graderd.cli.app import make_cli
from graderd.cli.explain import lines
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, FaultRow, Reaction
from graderd.evaluation import study

HEADER = "<!-- Written by `python -m graderd.cli.docs`; change the source named below, not this page. -->\n"
PARTS = {
    "rotation": "Blade rotation (servo)",
    "servo_bus": "The servo's bus",
    "actuator": "Lift and tilt (actuators)",
    "can": "The CAN bus",
    "camera": "Camera and pictures",
    "daemon": "The daemon itself",
    "stop_input": "The stop input",
}
REACTIONS = {
    Reaction.WARN: "It is told; everything goes on.",
    Reaction.HOLD: "The axes named stay where they are while the fault lasts.",
    Reaction.RETREAT: "Automatic operation ends; the blade is held and the operator has it in manual.",
    Reaction.DISARM: "Everything holds, then power is taken away as configured.",
    Reaction.STOP: "Motion ends at once and stays ended until `graderd reset`.",
}
CLEARS = {
    Clear.WHEN_GONE: "by itself, as soon as the cause is gone",
    Clear.ON_REARM: "by the next `graderd arm` (after `graderd disarm`), if the cause is gone",
    Clear.ON_RESET: "by `graderd reset`, if the cause is gone",
    Clear.NEVER: "by restarting the daemon after repair",
}


def main() -> None:
    """Write the pages below the folder given, by default ``docs/operators``."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/operators")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / name).write_text(text, encoding="utf-8")
        typer.echo(f"{folder / name}: {len(text.splitlines())} lines")


def pages() -> dict[str, str]:
    """Name and text of each page."""
    return {
        "faults.md": faults_page(),
        "cli.md": cli_page(),
        "study.md": f"{HEADER}\n{study.page(study.evaluated())}",
    }


def faults_page() -> str:
    """The fault catalogue for operators."""
    parts = [
        HEADER + "\n# Faults\n",
        "What can go wrong, what the machine does about it, and what to do. Source: `graderd/core/faults/`. The "
        "same is printed by `graderd explain FAULT`, and the active faults stand in `graderd status`. In a fault's "
        "name, `actuator` is written for each of `lift_left`, `lift_right` and `tilt`.\n",
        "## What the machine does\n\nThe reactions in rising order; among several faults the highest counts. A "
        "condition that the catalogue does not know counts as *stop*.\n",
        *(f"- **{reaction.name.lower()}**: {text}" for reaction, text in REACTIONS.items()),
        "\n## What ends a fault\n",
        *(f"- *{clear.value}*: {text}." for clear, text in CLEARS.items()),
        "\n## All at a glance\n",
        "| fault | what the operator reads | reaction | counts after | ends |\n|---|---|---|---|---|",
        *(_overview(row) for row in CATALOGUE.values()),
    ]
    for part, title in PARTS.items():
        parts.append(f"\n## {title}\n")
        parts += [_detail(row) for row in CATALOGUE.values() if row.key.partition(".")[0] == part]
    return "\n".join(parts).rstrip() + "\n"


def _overview(row: FaultRow) -> str:
    after = "at once" if row.debounce_s == 0 else f"{row.debounce_s:g} s"
    ends = row.clear.value.partition(" (")[0]
    return f"| [{row.key}](#{_anchor(row.key)}) | {row.reads} | {row.reaction.name.lower()} | {after} | {ends} |"


def _detail(row: FaultRow) -> str:
    told = "\n".join(f"- {name}: {text}" for name, text in lines(row)[1:])
    return f"### {row.key}\n\n*{row.reads}*\n\n{told}\n"


def _anchor(heading: str) -> str:
    """The anchor that Markdown viewers make of a heading."""
    return heading.lower().replace(".", "").replace(" ", "-")


def cli_page() -> str:
    """Every command with its arguments, options and example, from the command line's own definition."""
    root: Any = get_command(make_cli())
    parts = [
        HEADER + "\n# The command line\n",
        "Source: `graderd/cli/`. `graderd COMMAND --help` prints the same.\n",
        "Exit status: 0 done, 1 refused, failed or nobody there, 2 bad usage or configuration, "
        "130 interrupted. An error is one line on stderr: "
        "`graderd: WHERE: why. What to do`. With `--json` it is printed on stdout as "
        '`{"error": ..., "where": ..., "remedy": ...}` as well.\n',
        _parameters(root),
    ]
    parts += [_command(path, command) for path, command in _walk("graderd", root)]
    return "\n".join(part for part in parts if part).rstrip() + "\n"


def _walk(path: str, group: Any) -> Iterator[tuple[str, Any]]:
    """All commands below a group, by their full path."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _walk(f"{path} {name}", command)
        else:
            yield f"{path} {name}", command


def _command(path: str, command: Any) -> str:
    usage = [f"{path} [OPTIONS]" if _options(command) else path]
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name = parameter.name.upper()
            usage.append(name if parameter.required else f"[{name}]")
    if command.context_settings.get("allow_extra_args"):
        usage.append("[ARGUMENTS]")
    example = "\n".join(line for line in (command.epilog or "").splitlines()[1:] if line.strip())
    return "\n".join(
        [
            f"\n## {path}\n",
            re.sub(r"(?<!\n)\n(?!\n)", " ", (command.help or "").strip()) + "\n",
            f"```\n{' '.join(usage)}\n```\n",
            _parameters(command),
            f"Example:\n\n```\n{example}\n```" if example else "",
        ]
    )


def _options(command: Any) -> list[Any]:
    skipped = ("help", "install_completion", "show_completion")
    return [p for p in command.params if p.param_type_name == "option" and p.name not in skipped]


def _parameters(command: Any) -> str:
    rows = [
        f"| `{parameter.name.upper()}` | {_help(parameter)} |"
        for parameter in command.params
        if parameter.param_type_name == "argument"
    ]
    rows += [f"| `{', '.join(option.opts)}` | {_help(option)} |" for option in _options(command)]
    return "\n".join(["| | |\n|---|---|", *rows, ""]) if rows else ""


def _help(parameter: Any) -> str:
    text = " ".join((parameter.help or "").split()).replace("|", "\\|")
    choices = parameter.type_descriptor.choices
    if choices:
        names = [str(getattr(choice, "value", choice)) for choice in choices]
        text += f" One of {', '.join(f'`{name}`' for name in names)}."
    shown = isinstance(parameter.default, str | int | float) and not isinstance(parameter.default, bool)
    return f"{text} Default: {parameter.default}." if shown and "Default" not in text else text


if __name__ == "__main__":
    main()
