"""``graderd setup`` on a simulated grader: from nothing to an automatic pass, by a person who edits no file."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from graderd.client import Client, ClientError
from graderd.commissioning import Commissioning
from graderd.config import load
from graderd.config.rewrite import merged
from graderd.config.template import template
from graderd.core.status import Status
from graderd.simulator.control_client import rig_request
from harness.bound import bound
from harness.person import Person
from harness.set_up import (
    SLOW_S,
    SQUARE_DEG,
    a_rig,
    answer,
    back_to_square,
    devices,
    environment,
    rotation,
    somebody,
    to_the_end,
    wires,
)
from tests.machine import PATIENT, PICTURES

PATIENCE = {
    "recording": {"directory": ""},
    "stop_input": {"stale_s": 1.0},
    "camera": {**tomllib.loads(PICTURES)["camera"], "stale_s": 3.0, "restart_s": 20.0},
    "perception": {"decision": {"max_frame_age_s": 1.0}},
    "rule": {"vote_max_age_s": 5.0},
}

pytestmark = [pytest.mark.whole_machine, pytest.mark.slow, pytest.mark.timeout(500)]


def truth(folder: Path) -> dict[str, Any]:
    return rig_request(folder / "grader" / "control.sock", "state")


def daemons(folder: Path) -> list[int]:
    """Processes of daemons that run with this folder's configuration."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes().decode("utf-8", "replace")
        except OSError:
            continue
        if str(folder / "grader.toml") in command and "\0run\0" in command:
            found.append(int(process.name))
    return found


def test_from_nothing_to_an_automatic_pass(tmp_path: Path) -> None:
    """Left twice on the way and taken up again; nothing moves without a clear yes.

    The file to begin with is that of ``graderd config init``, with patience for a busy machine and fewer pictures, and
    nothing else.
    """
    (tmp_path / "grader.toml").write_text(merged(template(), {**PATIENCE, **tomllib.loads(PATIENT)}))
    with a_rig(tmp_path) as hands:
        with somebody(tmp_path) as person:
            wires(person, hands)
            person.expect("Nothing moves. Go on?")
            person.interrupt()
            assert person.end() == -signal.SIGINT, "130, as a shell says it"
        assert daemons(tmp_path) == []
        began = (tmp_path / "grader.toml").read_text()
        assert "# serial port, or a udev symlink to it\nport = " in began, "written where it is explained"

        with somebody(tmp_path) as person:
            person.expect("1 of 7")
            person.expect("  done 20")  # what was done is not asked again
            devices(person)
            rotation(person, hands)
            back_to_square(person, hands)
            person.expect("1 of 3", SLOW_S)
            _enter_is_no_yes(person, tmp_path)
        _a_file_without_consents_gives_none(tmp_path)

        hands.turn(SQUARE_DEG + 50.0)
        with somebody(tmp_path) as person:
            to_the_end(person, hands)
            assert person.end() == 0
        assert daemons(tmp_path) == []

        config = load(tmp_path / "grader.toml")
        record = json.loads((tmp_path / "commissioning.json").read_text())
        assert record["signed"]["by"] == "Kim"
        assert record["config_sha256"] == config.sha256()
        assert Commissioning(tmp_path / "commissioning.json").is_as_signed()
        stops = record["steps"]["stop"]["found"]["stops"]
        assert [stop["way"] for stop in stops] == ["command", "switch", "death"]
        assert all(0.0 <= stop["further_deg"] <= stop["most_deg"] for stop in stops)
        assert "stop_input.open" in stops[1]["reason"]
        assert "stopped by itself" in stops[2]["reason"], "by its watchdog"
        assert config.rotation.model_dump()["zero_deg"] == pytest.approx(SQUARE_DEG, abs=0.2)

        _automatic_pass(tmp_path)


def _automatic_pass(folder: Path) -> None:
    """``graderd run`` with what setup wrote, arm, auto, soil on the left: the blade turns as the rule says."""
    socket = folder / "graderd.sock"
    daemon = subprocess.Popen(
        bound(sys.executable, "-m", "graderd", "--socket", str(socket), "run", "--config", str(folder / "grader.toml")),
        env=environment(folder),
    )
    try:
        client = Client(socket, name="test", timeout_s=10.0)

        def until(reached: Callable[[Status], bool], what: str) -> Status:
            return client.until(reached, SLOW_S, what)

        def ready(status: Status) -> bool:
            if status.mode == "stopped":  # a busy machine reads its stop loop late: at its start that is a stop
                with suppress(ClientError):
                    client.reset()
            return status.soil.frames_per_s > 0 and all(need.met for need in status.readiness if need.mandatory)

        until(ready, "ready")
        client.command("arm")
        until(lambda s: s.mode == "manual", "armed")
        rig_request(folder / "grader" / "control.sock", "scene", zone="left")
        client.command("auto")
        goal_deg = load(folder / "grader.toml").rule.left_deg
        decided = until(lambda s: s.decision.zone is not None, "a decision")
        assert str(decided.decision.zone) == "left"
        until(lambda s: abs((s.axes["rotation"].measured or 0.0) - goal_deg) < 1.0, "the blade turned")
        assert truth(folder)["blade_deg"] == pytest.approx(goal_deg + SQUARE_DEG, abs=1.5)
        client.command("disarm")
    finally:
        daemon.terminate()
        daemon.wait()


def _enter_is_no_yes(person: Person, folder: Path) -> None:
    before_deg = truth(folder)["blade_deg"]
    answer(person, "Is it clear?", "maybe")
    answer(person, "Is it clear?", "")
    person.expect("stop.command: cancelled; nothing was changed")
    assert person.end() == 1
    assert truth(folder)["blade_deg"] == before_deg
    assert daemons(folder) == []


def _a_file_without_consents_gives_none(folder: Path) -> None:
    before_deg = truth(folder)["blade_deg"]
    (folder / "answers").write_text("# none of the consents\nsigned_by = Kim\n")
    command = [sys.executable, "-m", "graderd", "setup", "--config", "grader.toml", "--rig-dir", "grader"]
    done = subprocess.run(
        [*command, "--answers", "answers"],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        check=False,
        timeout=SLOW_S,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["graderd: stop.command: cancelled; nothing was changed. Do it again"]
    assert truth(folder)["blade_deg"] == before_deg
