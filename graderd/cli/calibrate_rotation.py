"""``graderd calibrate rotation``: zero, sign and limits of the blade's angle, from where a person puts the blade.

By hand with the torque off, or by jogs. Nothing is written before all of it is known and agreed to.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from graderd import places
from graderd.cli.asking import agree, ask, one_of
from graderd.cli.console import CliError, client_of, example, print_text
from graderd.cli.move import move
from graderd.client import Client, LeaseLostError, RefusedError

WHERE = "calibrate rotation"
TIMEOUT_S = 30.0
STILL_S = 0.5
STILL_DEG = 0.2
PATIENCE_S = 10.0
POLL_S = 0.05
LEAST_TURN_DEG = 2.0
ROOM_DEG = 1.0
"""The servo's own limits lie so far outside the soft limits (``drivers/dynamixel/calibration.py``)."""
_JOG = re.compile(r"[+-]\d{1,2}(\.\d{1,3})?")
_CALIBRATION = ("zero_deg", "sign", "gear_ratio", "min_deg", "max_deg")


@dataclass(frozen=True, slots=True)
class Angles:
    """Angles of the blade under the running configuration, where the person put it.

    ``turned_deg``: after a turn that sent the end ``back`` ("left" or "right") to the back. ``ends_deg``: furthest
    with its left end to the back, and with its right end there; None to keep the limits.
    """

    square_deg: float
    turned_deg: float
    back: str
    ends_deg: tuple[float, float] | None


def solve(running: Mapping[str, float], angles: Angles) -> dict[str, float]:
    """The calibration under which the blade's angles are 0 where it is square, and positive counter-clockwise.

    Counter-clockwise, seen from above, the left end goes to the back.

    Raises:
        CliError: it contradicts itself, or would need the servo's other operating mode.
    """

    def shaft_deg(angle_deg: float) -> float:  # counted as the servo counts, in degrees of the blade
        return running["sign"] * (angle_deg + running["zero_deg"])

    way_deg = shaft_deg(angles.turned_deg) - shaft_deg(angles.square_deg)
    if abs(way_deg) < LEAST_TURN_DEG:
        cause = f"the blade turned by {way_deg:+.1f} deg only"
        raise CliError(WHERE, cause, "Turn it further; if it did turn, look at rotation.gear_ratio")
    sign = 1 if (way_deg > 0) == (angles.back == "left") else -1
    zero_deg = sign * shaft_deg(angles.square_deg)
    new = {"zero_deg": round(zero_deg, 3), "sign": sign, "min_deg": running["min_deg"], "max_deg": running["max_deg"]}
    if angles.ends_deg is not None:
        left_deg, right_deg = (sign * shaft_deg(end) - zero_deg for end in angles.ends_deg)
        # Never a hair further than where the blade has been.
        new |= {"min_deg": math.ceil(right_deg * 10.0) / 10.0, "max_deg": math.floor(left_deg * 10.0) / 10.0}
        if not new["min_deg"] < 0.0 < new["max_deg"]:
            cause = f"the ends are at {left_deg:+.1f} and {right_deg:+.1f} deg, not on either side of square"
            raise CliError(WHERE, cause, "Do it again: left end furthest back first, then the right end")
    if _needs_turns({**running, **new}) and not _needs_turns(running):
        raise CliError(
            WHERE,
            "between its limits the blade would pass the servo's own half turn, where its count jumps",
            "Mount the blade so that the servo is near its middle when the blade is square, or narrow the limits",
        )
    return new


def _needs_turns(calibration: Mapping[str, float]) -> bool:
    ends = (calibration["min_deg"] - ROOM_DEG, calibration["max_deg"] + ROOM_DEG)
    return any(abs(end + calibration["zero_deg"]) * calibration["gear_ratio"] > 180.0 for end in ends)


def register(group: typer.Typer) -> None:
    """Add the command to the group ``calibrate``."""

    @group.command(epilog=example("graderd calibrate rotation", "graderd calibrate rotation --keep-limits"))
    def rotation(
        context: typer.Context,
        keep_limits: Annotated[bool, typer.Option("--keep-limits", help="Find zero and sign alone.")] = False,
        config: Annotated[Path | None, typer.Option(help="Configuration to change, instead of the system's.")] = None,
    ) -> None:
        """Find the blade's zero, sign and limits: you put it there, graderd reads and writes.

        Disarmed, the blade is turned by hand, its torque off; in manual mode by jogs that you type (+5, -0.5), which
        stay within the present limits. First square to the way, then a bit aside, then to both ends. Nothing is written
        before you agree; the former file is kept as a dated backup. The machine's own configuration is root's: with
        sudo.
        """
        from graderd.cli.calibrate import load_config, may_write, write_calibration

        client, path = client_of(context), config or places.config()
        may_write(path)
        running = _running(client)
        ratio = getattr(load_config(path, must_exist=config is not None).rotation, "gear_ratio", None)
        if ratio != running["gear_ratio"]:
            cause = f"the daemon runs with gear_ratio {running['gear_ratio']:g}, and {path} has {ratio}"
            raise CliError(WHERE, cause, "Restart the daemon first")
        talk = _Talk(client)
        angles = talk.angles(keep_limits)
        new = solve(running, angles)
        rows = [f"  {name:<9} {running[name]:>8g} -> {value:>8g}" for name, value in new.items()]
        print_text("\n".join(["rotation", *rows]))
        agree("rotation.write", f"Write this into {path}?")
        if _running(client) != running:
            raise CliError(WHERE, "the daemon was restarted with another calibration", "Do it again")
        backup = write_calibration(path, {"rotation": new})
        kept = f"; the former file is {backup}" if backup else ""
        print_text(f"written to {path}{kept}\nrestart the daemon; with the blade square, graderd status shows 0")


def _running(client: Client) -> dict[str, float]:
    rotation = client.config().get("rotation", {})
    if any(name not in rotation for name in _CALIBRATION):
        cause = "the driver of the rotation has no zero and sign of graderd's"
        raise CliError(WHERE, cause, "Calibrate it as its own manual says")
    return {name: float(rotation[name]) for name in _CALIBRATION}


class _Talk:
    """With the person, in one mode from the first reading to the last: nobody else may arm or disarm meanwhile."""

    def __init__(self, client: Client) -> None:
        self._client = client
        status = client.get("/v1/status")
        self._mode = status["mode"]
        if self._mode not in ("disarmed", "manual"):
            cause = f"graderd is {self._mode}"
            raise CliError(WHERE, cause, "Disarm to turn the blade by hand, or go to manual to jog it")
        if self._mode == "disarmed" and status["axes"]["rotation"]["torque_on"]:
            cause = "the blade cannot be turned by hand, its torque is on"
            raise CliError(WHERE, cause, "Arm and jog it, or set rotation.torque_at_disarm to off")

    def angles(self, keep_limits: bool) -> Angles:
        """Ask for the blade in each place, and read its angle there."""
        how = "by hand" if self._mode == "disarmed" else "by jogs"
        agree(
            "rotation.clear",
            f"The blade will be turned {how}. Is everybody clear of it, and the blade clear of the ground?",
        )
        square_deg = self._place("square", "Turn the blade square to the way the machine drives")
        turned_deg = self._place("aside", "Turn it by 5 degrees or more, either way")
        back = _which_end()
        if keep_limits:
            return Angles(square_deg, turned_deg, back, None)
        left_deg = self._place("left_back", "Turn it as far as it may ever go with its left end to the back")
        right_deg = self._place("right_back", "Turn it as far as it may ever go with its right end to the back")
        return Angles(square_deg, turned_deg, back, (left_deg, right_deg))

    def _place(self, key: str, what: str) -> float:
        jogs = ", or a jog such as +5 or -0.5" if self._mode == "manual" else ""
        while True:
            answer = ask(f"rotation.{key}", f"{what}. Press Enter when it stands there{jogs}", str)
            if not answer:
                angle_deg = self._still_deg()
                print_text(f"read: {angle_deg:+.2f} deg")
                return angle_deg
            if self._mode == "manual" and _JOG.fullmatch(answer):
                self._jog(float(answer))
            else:
                print_text("graderd is disarmed: turn it by hand" if not jogs else "that is no jog: +5, -0.5, +10.25")

    def _jog(self, by_deg: float) -> None:
        command = {"command": "jog", "axis": "rotate", "value": by_deg, "relative": True}
        try:
            move(self._client, command, ("rotation",), None, TIMEOUT_S, as_json=False)
        except LeaseLostError:
            raise
        except (CliError, RefusedError) as error:  # where it stands, it stands: the talk goes on
            self._status()
            print_text(" ".join(f"{error.cause}. {error.remedy}".split()))

    def _status(self) -> dict[str, Any]:
        """Of a daemon that still is in the mode in which it was begun.

        Raises:
            CliError: it is not.
        """
        status: dict[str, Any] = self._client.get("/v1/status")
        if status["mode"] != self._mode:
            cause = f"graderd became {status['mode']} meanwhile ({status['reason']}); nothing was changed"
            raise CliError(WHERE, cause, "Do it again when that is put right and nobody else uses it")
        return status

    def _still_deg(self) -> float:
        """The angle of a blade that stands.

        Raises:
            CliError: the mode changed, the angle is not known, or it does not stand still.
        """
        give_up_s = time.monotonic() + PATIENCE_S
        since_s, first_deg = 0.0, math.nan
        while time.monotonic() < give_up_s:
            status = self._status()
            angle_deg = status["axes"]["rotation"]["measured"]
            if angle_deg is None or not abs(angle_deg - first_deg) <= STILL_DEG:
                since_s, first_deg = status["time_s"], math.nan if angle_deg is None else angle_deg
            elif status["time_s"] - since_s >= STILL_S:
                return float(angle_deg)
            time.sleep(POLL_S)
        cause = "the blade's angle is not known" if math.isnan(first_deg) else "the blade does not stand still"
        raise CliError(WHERE, f"{cause}; nothing was changed", "See graderd status")


def _which_end() -> str:
    question = "Seen by who sits on the machine: which end of the blade went to the back? left or right"
    return ask("rotation.back", question, one_of("left", "right"))
