"""A person sets a simulated grader up with ``graderd setup``: what the test checks and the documentation shows.

``python -m harness.set_up --cast docs/integrators/setup.cast --text docs/integrators/setup.txt`` records it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graderd.simulator.ask import turn_by_hand
from graderd.simulator.control_client import rig_request
from harness.bound import bound
from harness.person import Person

SLOW_S = 150.0
SQUARE_DEG = 3.0
HOME = "/home/kim"
COMMAND = "graderd setup --config grader.toml --rig-dir grader"


def environment(folder: Path) -> dict[str, str]:
    """A person's, who has no other daemon."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("GRADERD_", "XDG_RUNTIME"))}
    return {**kept, "XDG_RUNTIME_DIR": str(folder)}


def setup_command(config: str, rig_dir: str) -> list[str]:
    """As a person types it."""
    return [sys.executable, "-m", "graderd", "setup", "--config", config, "--rig-dir", rig_dir]


class Hands:
    """What the person does at the machine itself."""

    def __init__(self, control: Path) -> None:
        self._control = control

    def do(self, command: str, **fields: Any) -> None:
        rig_request(self._control, command, **fields)

    def turn(self, angle_deg: float) -> None:
        """Turn the blade by hand."""
        turn_by_hand(self._control, angle_deg)


def answer(person: Person, question: str, text: str = "") -> None:
    """Wait until the question waits for its answer, and give it; empty: Enter alone."""
    person.expect(question, SLOW_S)
    person.expect(": ", SLOW_S)
    person.type(text)


def wires(person: Person, hands: Hands) -> None:
    """Which adapter is the servo's: by its plug."""
    answer(person, "or 'unplug' to find it by its plug")
    person.expect("Pull the servo's adapter out")
    hands.do("servo_fault", name="unplug")
    person.expect("Plug it in again")
    hands.do("clear_faults", part="servo")
    for question in ("Which is the actuators' bus", "Which camera", "What stops the machine beside commands"):
        answer(person, question)


def devices(person: Person) -> None:
    """The servo, and the actuators."""
    answer(person, "Nothing moves. Go on?", "yes")
    answer(person, "Which servo turns the blade")
    for axis in ("lift_left", "lift_right", "tilt"):
        answer(person, f"Address of {axis}")


def rotation(person: Person, hands: Hands) -> None:
    """Zero, sign and limits: the blade is mounted so that the servo counts 3 degrees where it is square."""
    answer(person, "by turning the blade by hand?")
    answer(person, "clear of the ground?", "yes")
    for question, angle_deg in (
        ("square to the way", SQUARE_DEG),
        ("by 5 degrees or more", SQUARE_DEG + 10.0),
        ("which end", None),
        ("left end to the back", SQUARE_DEG + 55.0),
        ("right end to the back", SQUARE_DEG - 55.0),
    ):
        person.expect(question, SLOW_S)
        if angle_deg is not None:
            hands.turn(angle_deg)
        answer(person, "", "left" if angle_deg is None else "")
    answer(person, "Write this into", "yes")
    person.expect("written to")


def back_to_square(person: Person, hands: Hands) -> None:
    """With room to turn; the first Enter comes too early."""
    answer(person, "back to about square")
    person.expect("it stands at", SLOW_S)
    hands.turn(SQUARE_DEG)
    answer(person, "back to about square")


def stops(person: Person, hands: Hands) -> None:
    """The stop, three ways."""
    back_to_square(person, hands)
    person.expect("1 of 3", SLOW_S)
    answer(person, "Is it clear?", "yes")
    person.expect("2 of 3", SLOW_S)
    answer(person, "Is it clear?", "yes")
    person.expect("PRESS THE STOP INPUT'S BUTTON NOW", SLOW_S)
    time.sleep(0.5)
    hands.do("stop_loop", state="open")
    person.expect("Release it", SLOW_S)
    hands.do("stop_loop", state="closed")
    person.expect("3 of 3", SLOW_S)
    answer(person, "Is it clear?", "yes")
    answer(person, "Does the blade stand still?", "yes")
    person.expect("death: it turned", SLOW_S)


def lifts_and_camera(person: Person, hands: Hands) -> None:
    """Left and right, and where the camera sits."""
    hands.do("scene", zone="none")
    for question, text in (
        ("which lift is the left one now?", ""),
        ("above the ground. Is it clear?", "yes"),
        ("by 1 deg together. Is it clear?", "yes"),
        ("which end of the blade rose?", "left"),
        ("where the camera sits now?", ""),
        ("above the ground. Is it clear?", "yes"),
        ("Turn it now?", "yes"),
        ("Write to", "yes"),
        ("Your name", "Kim"),
    ):
        answer(person, question, text)


def whole(person: Person, hands: Hands) -> None:
    """From nothing to a signed record."""
    wires(person, hands)
    devices(person)
    rotation(person, hands)
    to_the_end(person, hands)


def to_the_end(person: Person, hands: Hands) -> None:
    """From the stop on."""
    stops(person, hands)
    lifts_and_camera(person, hands)
    person.expect("signed by Kim")
    person.expect("Ready. Start it with")


@contextmanager
def a_rig(folder: Path) -> Iterator[Hands]:
    """A simulated grader in ``folder/grader``."""
    rig = subprocess.Popen(bound(sys.executable, "-m", "graderd.simulator", "--dir", str(folder / "grader")))
    try:
        while not (folder / "grader" / "rig.json").exists():
            assert rig.poll() is None
            time.sleep(0.05)
        yield Hands(folder / "grader" / "control.sock")
    finally:
        rig.terminate()
        rig.wait()


def somebody(folder: Path) -> Person:
    """Who has just typed ``graderd setup`` in ``folder``."""
    return Person(setup_command("grader.toml", "grader"), environment(folder), cwd=folder)


def main() -> None:
    """Record it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cast", type=Path, required=True, help="asciinema recording")
    parser.add_argument("--text", type=Path, required=True, help="the same as plain text")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="machine-") as name, a_rig(Path(name)) as hands:
        with somebody(Path(name)) as person:
            whole(person, hands)
            person.end()
        given.cast.write_text(person.cast("graderd setup").replace(name, HOME), encoding="utf-8")
        told = f"$ {COMMAND}\n{person.shown.replace(name, HOME)}"
        given.text.write_text("\n".join(line.rstrip() for line in told.splitlines()) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
