"""Zero, sign and limits of the rotation from where a person puts the blade, by hand or by jogs."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from graderd.cli.calibrate_rotation import Angles, solve
from graderd.cli.console import CliError
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.core.status import Status
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.settings import Ph54Settings
from harness.api_daemon import FakeDaemon, serving
from tests.unit.test_cli_modes import Capture, cli

TABLE = ControlTable.load("ph54_200_s500")
RUNNING = {"zero_deg": 2.0, "sign": 1, "gear_ratio": 1.0, "min_deg": -60.0, "max_deg": 60.0}


@given(
    st.floats(-50.0, 50.0), st.sampled_from([1, -1]), st.floats(-20.0, 20.0), st.sampled_from([1, -1]),
    st.floats(0.5, 2.0), st.floats(-45.0, 45.0).filter(lambda way: abs(way) > 2.5),
)  # fmt: skip
def test_whatever_was_wrong_before_the_servos_angle_is_the_blades_afterwards(
    true_zero: float, true_sign: int, zero: float, sign: int, ratio: float, turn: float
) -> None:
    """The driver's own conversion, with what was found, gives the true angle everywhere the blade was."""
    given_settings = Ph54Settings(zero_deg=zero, sign=sign, gear_ratio=ratio, min_deg=-60.0, max_deg=60.0)
    truth = Calibration.of(Ph54Settings(zero_deg=true_zero, sign=true_sign, gear_ratio=ratio), TABLE)
    shown = Calibration.of(given_settings, TABLE)
    running = {"zero_deg": zero, "sign": float(sign), "gear_ratio": ratio, "min_deg": -60.0, "max_deg": 60.0}

    def seen(true_deg: float) -> float:
        return shown.blade_deg(truth.counts(true_deg))

    angles = Angles(seen(0.0), seen(turn), "left" if turn > 0 else "right", (seen(31.04), seen(-27.06)))
    if max(abs(31.0 + 1.0 + true_zero), abs(true_zero - 28.0)) * ratio > 179.0:
        return  # the servo's half turn lies between the limits
    new = solve(running, angles)
    found = Calibration.of(Ph54Settings(**{**running, **new, "gear_ratio": ratio, "sign": int(new["sign"])}), TABLE)
    for true_deg in (0.0, turn, 31.0, -27.0):
        assert found.blade_deg(truth.counts(true_deg)) == pytest.approx(true_deg, abs=0.002)
    assert (new["min_deg"], new["max_deg"]) == (-27.0, 31.0), "never a hair further than it was"


@pytest.mark.parametrize(
    ("angles", "says"),
    [
        (Angles(0.0, 1.5, "left", None), "turned by"),
        (Angles(0.0, 10.0, "left", (-20.0, 20.0)), "not on either side"),
        (Angles(0.0, 10.0, "left", (20.0, 5.0)), "not on either side"),
        (Angles(150.0, 160.0, "left", None), "half turn"),
    ],
)
def test_what_contradicts_itself_is_not_written(angles: Angles, says: str) -> None:
    with pytest.raises(CliError, match=says):
        solve(RUNNING, angles)


class Person:
    """Answers in order; before an answer the blade may be turned, or something else be done."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.daemon: FakeDaemon | None = None
        self.says: list[tuple[float | Callable[[FakeDaemon], None] | None, str]] = []
        self.agrees: list[bool] = []
        self.config = {"rotation": dict(RUNNING)}
        monkeypatch.setattr(typer, "confirm", lambda *_, **__: self.agrees.pop(0))
        monkeypatch.setattr(typer, "prompt", self._answer)
        monkeypatch.setattr(FakeDaemon, "config", lambda _: self.config)

    def _answer(self, *_: Any, **__: Any) -> str:
        do, answer = self.says.pop(0)
        assert self.daemon is not None
        if callable(do):
            do(self.daemon)
        elif do is not None:
            self.daemon.positions["rotation"] = do
        return answer


@pytest.fixture
def person(monkeypatch: pytest.MonkeyPatch) -> Person:
    return Person(monkeypatch)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "graderd.toml"
    path.write_text('version = 2\n\n[rotation]\nzero_deg = 2.0 # "by eye"\n')
    return path


def jogs(daemon: FakeDaemon) -> list[float]:
    return [c.value for c in daemon.seen if isinstance(c, cmd.Jog)]


@pytest.mark.live
async def test_by_hand_everything_is_found_and_written_with_a_backup(
    tmp_path: Path, config: Path, capsys: Capture, person: Person
) -> None:
    person.agrees = [True, True]
    person.says = [(8.0, ""), (-2.0, ""), (None, "eh"), (None, "left"), (-37.07, ""), (None, "+5"), (48.03, "")]
    async with serving(tmp_path) as (person.daemon, path):
        assert await cli(path, "calibrate", "rotation", "--config", str(config)) == 0
        assert person.daemon.seen == [], "nothing was commanded"
    written = tomllib.loads(config.read_text())["rotation"]
    # The servo counts clockwise: its zero is where the running configuration shows -2, square is 8.
    assert written == {"zero_deg": -10.0, "sign": -1, "min_deg": -40.0, "max_deg": 45.0}
    assert "by eye" in config.read_text()
    assert len(list(tmp_path.glob("graderd.toml.*.bak"))) == 1
    said = capsys.readouterr().out
    assert "turn it by hand" in said, "a jog typed while disarmed"
    assert "sign             1 ->       -1" in said


@pytest.mark.live
async def test_by_jogs_one_after_the_other_until_it_stands_there(
    tmp_path: Path, config: Path, capsys: Capture, person: Person
) -> None:
    person.agrees = [True, True]
    person.says = [(None, "+5"), (None, "5"), (None, "-2"), (None, ""), (None, "+99"), (None, "+6"), (None, "")]
    person.says += [(None, "Left")]
    async with serving(tmp_path) as (person.daemon, path):
        await cli(path, "arm")
        assert await cli(path, "calibrate", "rotation", "--keep-limits", "--config", str(config)) == 0
        assert jogs(person.daemon) == [5.0, -2.0, 99.0, 6.0]
    assert tomllib.loads(config.read_text())["rotation"] == {
        "zero_deg": 5.0, "sign": 1, "min_deg": -60.0, "max_deg": 60.0,
    }  # fmt: skip
    assert "beyond the limit" in capsys.readouterr().out


def _arm(daemon: FakeDaemon) -> None:
    daemon.stop(cmd.Arm(client="somebody else"))  # type: ignore[arg-type]  # any command, in a tick of its own


def _sway(daemon: FakeDaemon) -> None:
    def swaying() -> Status:
        daemon.positions["rotation"] += 1.0
        return plain()

    plain, daemon.status = daemon.status, swaying  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("says", "told"),
    [
        ([(_arm, "")], "became manual meanwhile"),
        ([(0.0, ""), (1.0, ""), (None, "left")], "turned by +1.0 deg only"),
        ([(0.0, ""), (9.0, ""), (None, "left")], "cancelled"),
        ([(lambda d: setattr(d, "positions", {**d.positions, "rotation": None}), "")], "is not known"),
        ([(_sway, "")], "does not stand still"),
    ],
)
@pytest.mark.live
async def test_nothing_is_written_where_it_is_in_doubt(
    tmp_path: Path, config: Path, capsys: Capture, person: Person, monkeypatch: pytest.MonkeyPatch,
    says: list[Any], told: str,
) -> None:  # fmt: skip
    monkeypatch.setattr("graderd.cli.calibrate_rotation.PATIENCE_S", 1.0)
    before = config.read_text()
    person.agrees, person.says = [True, False], says
    async with serving(tmp_path) as (person.daemon, path):
        assert await cli(path, "calibrate", "rotation", "--keep-limits", "--config", str(config)) == 1
    assert told in capsys.readouterr().err
    assert config.read_text() == before


@pytest.mark.live
async def test_it_says_at_once_what_it_cannot_do(tmp_path: Path, config: Path, capsys: Capture, person: Person) -> None:
    async def refused(*options: str) -> str:
        assert await cli(path, "calibrate", "rotation", *(options or ("--config", str(config)))) == 1
        told = capsys.readouterr().err
        assert told.count("\n") == 1
        return told

    async with serving(tmp_path) as (daemon, path):
        person.daemon = daemon
        person.agrees = [False]
        assert "cancelled" in await refused()
        daemon.torque_on = True
        await daemon.until(lambda: daemon.status().axes["rotation"].torque_on is True)
        assert "its torque is on" in await refused()
        await cli(path, "stop")
        assert "graderd is stopped" in await refused()
        assert daemon.state.mode is Mode.STOPPED
        person.config["rotation"]["gear_ratio"] = 2.0
        assert "runs with gear_ratio 2" in await refused()
        person.config["rotation"].pop("sign")
        assert "has no zero and sign" in await refused()
        config.parent.joinpath("a-folder").mkdir()
        assert "a-folder" in await refused("--config", str(tmp_path / "a-folder"))
    assert person.says == []


@pytest.mark.live
async def test_a_stop_ends_the_talk(tmp_path: Path, config: Path, capsys: Capture, person: Person) -> None:
    before = config.read_text()

    def stop(daemon: FakeDaemon) -> None:
        daemon.stop(cmd.Stop(client="somebody else", reason="a person"))

    person.agrees, person.says = [True], [(stop, "+5")]
    async with serving(tmp_path) as (person.daemon, path):
        await cli(path, "arm")
        capsys.readouterr()
        status = await cli(path, "calibrate", "rotation", "--config", str(config))
    assert status == 1
    assert "became stopped meanwhile" in capsys.readouterr().err
    assert config.read_text() == before


@pytest.mark.live
async def test_a_daemon_restarted_with_another_calibration_meanwhile(
    tmp_path: Path, config: Path, capsys: Capture, person: Person
) -> None:
    before = config.read_text()
    person.agrees = [True, True]
    person.says = [(0.0, ""), (9.0, ""), (lambda _: person.config["rotation"].update(zero_deg=7.0), "left")]
    async with serving(tmp_path) as (person.daemon, path):
        assert await cli(path, "calibrate", "rotation", "--keep-limits", "--config", str(config)) == 1
    assert "restarted with another calibration" in capsys.readouterr().err
    assert config.read_text() == before
