"""Which lift is the left one: asked of the person who looks, written where the answer says that they are swapped."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer

from graderd.core import commands as cmd
from harness.api_daemon import FakeDaemon, serving
from tests.unit.test_cli_modes import Capture, cli

ADDRESSES = {"lift_left": {"address_n": 19}, "lift_right": {"address_n": 20}}


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the person says, in order: True and False to consent, words to the question."""
    said: list[Any] = []
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: said.pop(0))
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: said.pop(0))
    monkeypatch.setattr(FakeDaemon, "config", lambda _: ADDRESSES)
    return said


def jogs(daemon: FakeDaemon) -> list[float]:
    return [command.value for command in daemon.seen if isinstance(command, cmd.Jog) and command.axis == "slope"]


@pytest.mark.live
async def test_left_is_left(tmp_path: Path, capsys: Capture, answers: list[Any]) -> None:
    async with serving(tmp_path) as (daemon, path):
        await cli(path, "arm")
        answers += [True, "up?", "left"]
        assert await cli(path, "calibrate", "lifts") == 0
        assert "left is left" in capsys.readouterr().out
        assert jogs(daemon) == [1.0, -1.0], "there and back"


@pytest.mark.live
async def test_swapped_ends_are_exchanged_in_the_configuration(
    tmp_path: Path, capsys: Capture, answers: list[Any]
) -> None:
    config = tmp_path / "graderd.toml"
    config.write_text('version = 2\n\n[lift_left]\naddress_n = 19 # "violet" not wired\n')
    async with serving(tmp_path) as (daemon, path):
        await cli(path, "arm")
        answers += [True, "right", True]
        assert await cli(path, "calibrate", "lifts", "--config", str(config), "--by-deg", "0.5") == 1
        assert jogs(daemon) == [0.5, -0.5]
    said = capsys.readouterr().out
    assert "the left one is at address 20, the right one at 19" in said
    written = tomllib.loads(config.read_text())
    assert (written["lift_left"]["address_n"], written["lift_right"]["address_n"]) == (20, 19)
    assert "violet" in config.read_text()
    assert len(list(tmp_path.glob("graderd.toml.*.bak"))) == 1


@pytest.mark.parametrize(
    ("said", "says"),
    [([True, "right", False], "cancelled; nothing was changed"), ([True, "neither"], "the blade did not move")],
)
@pytest.mark.live
async def test_nothing_is_written_without_consent_or_reason(
    tmp_path: Path, capsys: Capture, answers: list[Any], said: list[Any], says: str
) -> None:
    config = tmp_path / "graderd.toml"
    async with serving(tmp_path) as (daemon, path):
        await cli(path, "arm")
        answers += said
        assert await cli(path, "calibrate", "lifts", "--config", str(config)) == 1
        assert jogs(daemon) == [1.0, -1.0]
    assert says in capsys.readouterr().err
    assert not config.exists()


@pytest.mark.live
async def test_nothing_moves_without_consent(tmp_path: Path, answers: list[Any]) -> None:
    async with serving(tmp_path) as (daemon, path):
        await cli(path, "arm")
        answers += [False]
        assert await cli(path, "calibrate", "lifts") == 1
        assert jogs(daemon) == []
