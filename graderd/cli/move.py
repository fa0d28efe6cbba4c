"""``graderd jog AXIS VALUE`` and ``graderd preset NAME``: move by hand while the command runs."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from graderd.cli.console import CliError, ExitCode, Json, client_of, example, print_json, print_table, print_text
from graderd.client import Client, ClientError
from graderd.core.axes import AXES, JOG_AXES, JogName

SETTLED_S = 0.3
HELD_S = 1.0
COMPLETION_S = 1.0
VALUE = re.compile(r"(?P<absolute>=)?(?P<sign>[+-])?(?P<number>\d{1,6}(\.\d{0,9})?|\.\d{1,9})\s*(?P<unit>[^\d\s.]*)")


@dataclass(frozen=True)
class JogValue:
    """What a value on the command line means."""

    value: float
    relative: bool


def register(app: typer.Typer) -> None:
    """Add the commands."""
    _jog(app)
    _preset(app)


def _jog(app: typer.Typer) -> None:

    @app.command(
        epilog=example(
            "graderd jog rotate +5deg      (5 degrees further counter-clockwise)",
            "graderd jog rotate =-30deg    (to -30 degrees)",
            "graderd jog height 40mm       (to 40 mm above the ground)",
            "graderd jog lift -20mm --hold-s 1",
        ),
        # A value such as -5deg is no option.
        context_settings={"ignore_unknown_options": True},
    )
    def jog(
        context: typer.Context,
        axis: Annotated[JogName, typer.Argument(help="What to move.")],
        value: Annotated[
            str,
            typer.Argument(
                help="With a sign: by so much. Without: to there. '=' before a sign: to there. The unit is deg for "
                "rotate, slope and pitch, mm for lift, tilt and height."
            ),
        ],
        hold_s: Annotated[
            float | None,
            typer.Option(min=0.0, max=60.0, help="Give up the lease after so many seconds instead of on arrival."),
        ] = None,
        timeout_s: Annotated[float, typer.Option(min=0.1, help="Fail if it has not arrived by then.")] = 60.0,
        json: Json = False,
    ) -> None:
        """Move one axis by hand, in manual mode.

        The blade holds when the command ends, however it ends.
        """
        wish = parse_value(axis, value)
        command = {"command": "jog", "axis": axis, "value": wish.value, "relative": wish.relative}
        move(client_of(context), command, JOG_AXES[axis].moves, hold_s, timeout_s, json)


def parse_value(axis: JogName, text: str) -> JogValue:
    """``+5deg``, ``-5deg``, ``30deg``, ``=-30deg``.

    Raises:
        CliError: not such a value, or not in the axis's unit.
    """
    unit = JOG_AXES[axis].unit
    match = VALUE.fullmatch(text.strip().replace("−", "-"))
    if match is None:
        raise CliError(
            f"jog {axis}", f"{text!r} is no value", f"write it like +5{unit}, -5{unit}, 30{unit} or =-30{unit}",
            ExitCode.USAGE,
        )  # fmt: skip
    given = {"°": "deg"}.get(match["unit"], match["unit"])
    if given != unit:
        why = f"its unit is {unit}, not {given}" if given else f"{text!r} has no unit"
        hint = f"write {match['absolute'] or ''}{match['sign'] or ''}{match['number']}{unit} if that is meant"
        raise CliError(f"jog {axis}", why, hint, ExitCode.USAGE)
    number = float(match["number"])
    return JogValue(-number if match["sign"] == "-" else number, match["sign"] is not None and not match["absolute"])


def move(
    client: Client,
    command: dict[str, Any],
    axes: tuple[str, ...],
    hold_s: float | None,
    timeout_s: float,
    as_json: bool,
) -> None:
    """Send a jog or preset and keep its lease until the axes have arrived, ``hold_s`` is over, or Ctrl-C.

    Raises:
        CliError: refused, lost or held on the way, or not arrived within ``timeout_s``.
        KeyboardInterrupt: Ctrl-C; the lease is given back.
    """
    name = command["command"]
    interrupted = False
    with client.lease(name) as lease:
        if name == "jog":
            lease.jog(command["axis"], command["value"], relative=command["relative"])
        else:
            lease.preset(command["name"])
        started_s = time.monotonic()
        arrival = Arrival(axes)
        try:
            for status in lease.raw_statuses():
                arrived = arrival.update(status)
                elapsed_s = time.monotonic() - started_s
                if elapsed_s >= hold_s if hold_s is not None else arrived:
                    break
                if arrival.held_by is not None:
                    fault = arrival.held_by
                    why = f"held on its way: {fault['detail'] or fault['reads']} ({arrival.where()})"
                    raise CliError(name, why, fault["remedy"])
                if elapsed_s >= timeout_s:
                    raise CliError(name, f"not there after {timeout_s:g} s: {arrival.where()}", "see graderd status")
        except KeyboardInterrupt:
            interrupted = True
    result = {
        "command": name,
        "arrived": arrival.arrived,
        "interrupted": interrupted,
        "seconds": round(time.monotonic() - started_s, 2),
        "measured": arrival.measured,
    }
    if as_json:
        print_json(result)
    else:
        print_text(f"{'arrived' if arrival.arrived else 'released'}: {arrival.where()}")
    if interrupted:
        raise KeyboardInterrupt  # what comes after it in a script must not go on to the next motion


class Arrival:
    """Whether the axes are where they were asked to go, and have been for ``SETTLED_S``.

    ``held_by``: the fault for which the daemon has held all of them for ``HELD_S``; None where there is none.
    """

    def __init__(self, axes: tuple[str, ...]) -> None:
        self._axes = axes
        self._there_since_s: float | None = None
        self._held_since_s: float | None = None
        self.arrived = False
        self.held_by: dict[str, Any] | None = None
        self.measured: dict[str, float | None] = {}
        self._texts: list[str] = []

    def update(self, status: dict[str, Any]) -> bool:
        """Take a status into account."""
        axes = [status["axes"][name] for name in self._axes if name in status["axes"]]
        self.measured = {axis["name"]: axis["measured"] for axis in axes}
        self._texts = [_axis_text(axis) for axis in axes]
        asked = [axis for axis in axes if axis["requested"] is not None]
        if not asked or not all(_there(axis) for axis in asked):
            self._there_since_s = None
        elif self._there_since_s is None:
            self._there_since_s = status["time_s"]
        self.arrived = self._there_since_s is not None and status["time_s"] - self._there_since_s >= SETTLED_S
        self._note_hold(status, bool(asked) and all(axis["limited"] is None for axis in asked))
        return self.arrived

    def _note_hold(self, status: dict[str, Any], held: bool) -> None:
        mine = [f for f in status["faults"] if f["present"] and f["name"].split(".")[0] in self._axes]
        if not held or not mine:
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = status["time_s"]
        enough = self._held_since_s is not None and status["time_s"] - self._held_since_s >= HELD_S
        self.held_by = mine[0] if enough else None

    def where(self) -> str:
        """Where the axes are, for people."""
        return ", ".join(self._texts) or "nothing measured"


def _there(axis: dict[str, Any]) -> bool:
    """Where it was asked to go, and at rest."""
    return bool(axis["arrived"] and not axis["moving"])


def _axis_text(axis: dict[str, Any]) -> str:
    if axis["measured"] is None:
        return f"{axis['name']} unknown"
    because = f" ({axis['limited_because']})" if axis["limited_because"] else ""
    return f"{axis['name']} {axis['measured']:z.1f} {axis['unit']}{because}"


def _poses(context: typer.Context, incomplete: str) -> list[str]:
    """For the shell's completion: those of the daemon that answers, quickly, or none."""
    try:
        named = context.find_root().params.get("socket")
        names = Client(named, timeout_s=COMPLETION_S).get("/v1/status")["presets"]
    except ClientError:
        return []
    return [name for name in names if name.startswith(incomplete)]


def _preset(app: typer.Typer) -> None:

    @app.command(epilog=example("graderd preset", "graderd preset transport"))
    def preset(
        context: typer.Context,
        name: Annotated[
            str | None,
            typer.Argument(help="The pose; without it, the poses are listed.", autocompletion=_poses),
        ] = None,
        timeout_s: Annotated[float, typer.Option(min=0.1, help="Fail if it has not arrived by then.")] = 120.0,
        json: Json = False,
    ) -> None:
        """Move to a named pose, in manual mode.

        The poses are the configuration's. The blade holds when the command ends.
        """
        client = client_of(context)
        names = client.get("/v1/status")["presets"]
        if name is None:
            if json:
                print_json({"presets": names})
            else:
                print_table("", ("preset",), [(known,) for known in names])
            return
        if name not in names:
            raise CliError("preset", f"there is no preset {name!r}", f"there are: {', '.join(names) or 'none'}")
        move(client, {"command": "preset", "name": name}, AXES, None, timeout_s, json)
