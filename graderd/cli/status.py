"""``graderd status``: everything at one moment, or as it changes."""

from __future__ import annotations

import shutil
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd.cli.console import (
    Json,
    Row,
    client_of,
    example,
    for_people,
    plain_table,
    print_json,
    print_rich,
    print_text,
)
from graderd.client import Client
from graderd.hal.text import printable
from graderd.view import LEAST_COLUMNS_N, LEAST_LINES_N, STYLES, lines, profile

if TYPE_CHECKING:
    from rich.console import RenderableType

THERMAL_SHOWN = 0.05
THIRDS = ("left", "center", "right")
Section = tuple[str, Row, list[Row]]


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example("graderd status", "graderd status --watch", "graderd status --json | jq .axes.rotation")
    )
    def status(
        context: typer.Context,
        watch: Annotated[bool, typer.Option("--watch", help="Go on showing it until Ctrl-C.")] = False,
        json: Json = False,
    ) -> None:
        """Show mode, axes, soil, faults, readiness and health.

        A terminal gets what fits it, faults first; a pipe gets everything.
        """
        client = client_of(context)
        if watch:
            _watch(client, json)
            return
        state = client.get("/v1/status")
        if json:
            print_json(state)
        elif for_people():
            print_rich(_on_terminal(state))
        else:
            print_text("\n".join(plain_table(*section) for section in sections(state)))


def _watch(client: Client, as_json: bool) -> None:
    """A live table on a terminal, else one line or object per change of second."""
    try:
        if as_json or not for_people():
            with client.raw_statuses(10.0 if as_json else 1.0) as states:
                for state in states:
                    if as_json:
                        print_json(state)
                    else:
                        print_text(summary(state))
            return
        from rich.live import Live

        with client.raw_statuses(10.0) as states, Live(auto_refresh=False, screen=True) as live:
            for state in states:
                live.update(_on_terminal(state), refresh=True)
    except KeyboardInterrupt:
        return


def _on_terminal(state: dict[str, Any]) -> RenderableType:
    """What fits; a line stays for the shell's next prompt."""
    from rich.text import Text

    columns_n, lines_n = shutil.get_terminal_size()
    shown = lines(state, max(columns_n, LEAST_COLUMNS_N), max(lines_n, LEAST_LINES_N) - 1)
    return Text("\n").join(Text(line.text, STYLES[line.kind], no_wrap=True) for line in shown)


def summary(state: dict[str, Any]) -> str:
    """One line: mode, reason, angle, soil, faults."""
    rotation = state["axes"].get("rotation", {})
    faults = ", ".join(fault["name"] for fault in state["faults"]) or "none"
    return printable(
        f"{time.strftime('%H:%M:%S')} {state['mode']} ({state['reason']}) soil {state['soil']['zone']} "
        f"rotation {_number(rotation.get('requested'), 'deg')} -> {_number(rotation.get('measured'), 'deg')} "
        f"faults {faults}"
    )


def sections(state: dict[str, Any]) -> list[Section]:
    """The status as titled tables; empty ones are left out."""
    where = "simulated" if state["simulated"] else "machine"
    lease = state["lease"]
    overview = [
        ("mode", f"{state['mode']}{' (arming)' if state['arming'] else ''}: {state['reason']}"),
        *(("holding", reason) for reason in state["holding"]),
        *([("last stop", state["last_stop"])] if state["last_stop"] else []),
        *([("moved by", f"{lease['client']} for {lease['remaining_s']:.1f} s more")] if lease else []),
        ("soil", _soil(state["soil"])),
        *((name, text) for name, text in _told_apart(state["soil"])),
        ("decision", _decision(state["decision"])),
        ("vehicle", _vehicle(state["vehicle"])),
        ("blade", _attitude(state["attitude"])),
        ("camera", _camera(state["camera"])),
        *([("camera set", as_set)] if (as_set := _as_set(state["camera"]["settings_read_back"])) else []),
        ("tick", _tick(state["tick"])),
    ]
    found: list[Section] = [(f"graderd {state['version']} ({where})", ("", ""), [tuple(row) for row in overview])]
    header = ("axis", "state", "requested", "limited", "sent", "measured", "age", "current", "temp.", "notes")
    found.append(("Axes", header, [_axis(axis) for axis in state["axes"].values()]))
    faults: list[Row] = [
        (f["name"], f["reaction"], f["reads"], f["detail"], f["remedy"], f"clears {f['clears']}")
        for f in state["faults"]
    ]
    if faults:
        found.append(("Faults", ("fault", "reaction", "what", "detail", "what to do", ""), faults))
    for title, mandatory in (("Not ready to arm", True), ("Missing; arming goes without", False)):
        unmet: list[Row] = [
            (r["name"], r["reason"], r["remedy"])
            for r in state["readiness"]
            if not r["met"] and r["mandatory"] is mandatory
        ]
        if unmet:
            found.append((title, ("requirement", "reason", "remedy"), unmet))
    return found


def _axis(axis: dict[str, Any]) -> Row:
    unit = axis["unit"]
    notes = [axis["limited_because"], *(axis["flags"] or ())]
    if axis["moving"]:
        notes.append("moving")
    if (axis["thermal_load"] or 0.0) >= THERMAL_SHOWN:
        notes.append(f"thermal load {axis['thermal_load']:.0%}")
    return (
        axis["name"],
        axis["lifecycle"],
        _number(axis["requested"], unit),
        _number(axis["limited"], unit),
        _number(axis["sent"], unit),
        _number(axis["measured"], unit),
        _number(axis["measured_age_s"], "s", 2),
        _number(axis["current_a"], "A"),
        _number(axis["temperature_c"], "°C", 0),
        ", ".join(note for note in notes if note),
    )


def _soil(soil: dict[str, Any]) -> str:
    thirds = [f"{third} {soil[f'share_{third}']:.0%}" for third in THIRDS if soil[f"share_{third}"] is not None]
    sure = f"{soil['confidence']:.0%} sure"
    said = [sure, *([", ".join(thirds)] if thirds else []), _number(soil["age_s"], "s old", 2), soil["reason"]]
    return f"{soil['zone']} ({'; '.join(said)})"


def _told_apart(soil: dict[str, Any]) -> list[Row]:
    """What lies ahead and what the blade carries, where the method can tell."""
    if soil["ahead"] is None or soil["carried"] is None:
        return []
    ahead = soil["ahead"]
    return [
        ("ahead", f"{ahead['zone']} ({ahead['confidence']:.0%} sure; {_litres(ahead)}; {ahead['reason']})"),
        ("carried", _litres(soil["carried"])),
        *([("profile", profile(soil["profile_mm"]))] if soil["profile_mm"] is not None else []),
    ]


def _litres(thirds: dict[str, Any]) -> str:
    return f"left {thirds['left_l']:.1f}, center {thirds['center_l']:.1f}, right {thirds['right_l']:.1f} l"


def _decision(decision: dict[str, Any]) -> str:
    if decision["zone"] is None:
        return decision["reason"] or "none yet"
    return f"{_number(decision['angle_deg'], 'deg')}: {decision['reason']}"


def _vehicle(vehicle: dict[str, Any]) -> str:
    if vehicle["speed_m_per_s"] is None:
        return "does not say how it drives; a decision is kept by time"
    return f"{_number(vehicle['speed_m_per_s'], 'm/s', 2)} ({_number(vehicle['age_s'], 's old', 2)})"


def _attitude(attitude: dict[str, Any]) -> str:
    return (
        f"height {_number(attitude['height_mm'], 'mm', 0)}, slope {_number(attitude['slope_deg'], 'deg')}, "
        f"pitch {_number(attitude['pitch_deg'], 'deg')}"
    )


def _camera(camera: dict[str, Any]) -> str:
    restarts = f", restarted {camera['restarts_n']} times" if camera["restarts_n"] else ""
    return f"{camera['lifecycle']} {camera['description']}{restarts}".strip()


def _as_set(read_back: dict[str, float]) -> str:
    """What the camera itself says it is set to, colour and depth sensor."""
    return ", ".join(f"{name} {value:g}" for name, value in read_back.items())


def _tick(tick: dict[str, Any]) -> str:
    return f"{tick['rate_hz']:.0f} Hz, p99 {tick['lateness_p99_ms']:.1f} ms late, {tick['overruns_n']} overruns"


def _number(value: float | None, unit: str, digits: int = 1) -> str:
    return "-" if value is None else f"{value:z.{digits}f} {unit}"
