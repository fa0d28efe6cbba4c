"""The guard acts on what the daemon last ran with, and on any command line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from graderd import places
from graderd.cli.app import run_app
from graderd.config import Config, load, parse
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import Ph54Settings
from graderd.runtime.app import guard
from graderd.runtime.app.last_run import FILE, is_of, recall, remember


@pytest.fixture
def acted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Config]:
    """The configurations the guard acted on, instead of their wires."""
    found: list[Config] = []

    def note(config: Config) -> int:
        found.append(config)
        return 0

    monkeypatch.setattr(guard, "make_safe", note)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    return found


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "graderd.toml"
    path.write_text('[rotation]\nport = "/dev/one"\n')
    return path


def port_of(config: Config) -> str:
    assert isinstance(config.rotation, Ph54Settings)
    return config.rotation.port


def port(path: Path) -> str:
    return port_of(guard.config_to_act_on(path))


def test_everything_a_configuration_says_survives(file: Path, acted: list[Config]) -> None:
    config = parse({"api": {"tcp": {"port_n": 8080}}, "presets": {"a": {"rotation_deg": 3.0}}, "rule": {"left_deg": 9}})
    remember(config, file)
    last = recall("")
    assert last is not None
    assert last.config == config
    assert is_of(last, file)
    assert not is_of(last, None)


@pytest.mark.parametrize("damage", ["[[[", '[rotation]\nprot = "/dev/one"\n', None])
def test_the_last_run_stands_in_for_a_file_that_cannot_be_used(
    file: Path, acted: list[Config], damage: str | None
) -> None:
    remember(load(file), file)
    if damage is None:
        file.unlink()
    else:
        file.write_text(damage)
    assert port(file) == "/dev/one"


def test_the_wires_in_use_count_not_the_ones_written_since(file: Path, acted: list[Config]) -> None:
    remember(load(file), file)
    file.write_text('[rotation]\nport = "/dev/two"\n')
    assert port(file) == "/dev/one"


def test_another_file_is_another_machine(file: Path, acted: list[Config], tmp_path: Path) -> None:
    remember(load(file), file)
    other = tmp_path / "other.toml"
    other.write_text('[rotation]\nport = "/dev/two"\n')
    assert port(other) == "/dev/two"


def test_a_relative_name_is_the_same_file(file: Path, acted: list[Config], monkeypatch: pytest.MonkeyPatch) -> None:
    remember(load(file), file)
    monkeypatch.chdir(file.parent)
    file.write_text("")
    assert port(Path(file.name)) == "/dev/one"


def test_a_simulated_machine_that_is_gone_is_left(file: Path, acted: list[Config], tmp_path: Path) -> None:
    pty = tmp_path / "servo"
    pty.touch()
    ran = load(file)
    rotation = ran.rotation.model_copy(update={"port": str(pty)})
    remember(ran.model_copy(update={"simulated": True, "rotation": rotation}), file)
    assert port(file) == str(pty)
    pty.unlink()
    assert port(file) == "/dev/one"


@pytest.mark.parametrize("content", ["", "{}", "{]", '{"source": "/x", "config": {"version": 99}}'])
def test_a_record_that_is_not_usable_leaves_the_file_or_the_defaults(
    file: Path, acted: list[Config], tmp_path: Path, content: str
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / FILE).write_text(content)
    assert port(file) == "/dev/one"
    file.unlink()
    assert guard.config_to_act_on(file) == Config()


def test_what_cannot_be_written_down_leaves_nothing_wrong(
    file: Path, acted: list[Config], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    remember(load(file), file)
    file.write_text('[rotation]\nport = "/dev/two"\n')
    (tmp_path / "state" / "last_run.new").mkdir()
    remember(load(file), file)
    assert "cannot be written" in caplog.text
    assert recall("") is None


def test_without_systemd_the_configured_directory_is_used(
    file: Path, acted: list[Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setattr(places, "STATE", tmp_path / "nowhere")
    remember(load(file), file)
    assert recall("") is None
    file.write_text(f'[state]\ndirectory = "{tmp_path}/kept"\n')
    remember(load(file), file)
    file.write_text(f'[state]\ndirectory = "{tmp_path}/kept"\n[rotation]\nport = "/dev/two"\n')
    assert port(file) == port_of(Config())


@pytest.mark.parametrize(
    "line",
    [
        ["guard", "--config={}", "--no-such-option"],
        ["guard", "--jsn", "--config", "{}"],
        ["guard", "what", "--config", "{}"],
        ["--no-such-option", "guard", "--config", "{}"],
        ["--socket", "/run/x", "guard", "--config", "{}", "-q"],
        ["guard", "--config", "{}", "--config"],
    ],
)
def test_a_mistake_on_the_command_line_does_not_stop_the_guard(
    file: Path, acted: list[Config], line: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app([word.format(file) for word in line]) == 0
    assert [port_of(config) for config in acted] == ["/dev/one"]
    assert "graderd: " in capsys.readouterr().err


@pytest.mark.parametrize("line", [["guard", "--help"], ["status", "--nonsense", "guard"], ["--socket", "guard", "x"]])
def test_nothing_else_wakes_it(acted: list[Config], line: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    run_app(line)
    assert acted == []


def test_a_failure_nobody_thought_of_leaves_the_other_wire(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "graderd.guard")

    def broken(*_: object) -> None:
        raise RuntimeError("a mistake of ours")

    driver = SimpleNamespace(safe_off=lambda *_: "torque off")
    monkeypatch.setattr(guard, "actuator_of", broken)
    monkeypatch.setattr(guard, "rotator_of", lambda settings: (driver, settings))
    assert guard.make_safe(Config()) == 1
    assert "guard: rotation: torque off" in caplog.text
    assert '{"failed": ["lift_left, lift_right, tilt"]}' in caplog.text


def _drivers(monkeypatch: pytest.MonkeyPatch, rotation: Callable[[], str], actuators: Callable[[], str]) -> None:
    drivers = [SimpleNamespace(safe_off=lambda *_, told=told: told()) for told in (rotation, actuators)]
    monkeypatch.setattr(guard, "rotator_of", lambda settings: (drivers[0], settings))
    monkeypatch.setattr(guard, "actuator_of", lambda _, settings: (drivers[1], settings))


def test_no_wire_waits_for_anothers_adapter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each ends when the other has begun: one after the other, neither would end."""
    rotation_began, actuators_began = threading.Event(), threading.Event()

    def rotation() -> str:
        rotation_began.set()
        assert actuators_began.wait(5.0), "it waited for the rotation"
        return "torque off"

    def actuators() -> str:
        actuators_began.set()
        assert rotation_began.wait(5.0), "it waited for the actuators"
        return "motion disabled"

    _drivers(monkeypatch, rotation, actuators)
    assert guard.make_safe(Config()) == 0


def test_two_drivers_on_an_adapter_that_takes_one_at_a_time_are_both_told(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, refused = threading.Event(), threading.Event()

    def actuators() -> str:
        taken.set()
        assert refused.wait(5.0)
        return "motion disabled"

    def rotation() -> str:
        assert taken.wait(5.0)
        if refused.is_set():
            return "valve blocked"
        refused.set()
        raise DeviceMissingError("adapter", "another program has it open")

    _drivers(monkeypatch, rotation, actuators)
    assert guard.make_safe(Config()) == 0
