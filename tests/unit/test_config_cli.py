"""``graderd config``: a file made, changed, compared and put back; what `run` would refuse is not written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from graderd.cli.app import run_app
from graderd.config import Config, load


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    told: list[str] = []
    monkeypatch.setattr("graderd.cli.config.syslog.syslog", lambda _, text: told.append(text))
    return told


def asked(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, Any]:
    status = run_app(["config", *arguments, "--json"])
    return int(status), json.loads(capsys.readouterr().out)


def test_from_nothing_to_a_file_changed_and_put_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], logged: list[str]
) -> None:
    path = tmp_path / "etc" / "graderd.toml"
    assert asked(capsys, "init", str(path))[0] == 0
    before = path.read_text()
    assert "# " in before
    assert asked(capsys, "check", str(path)) == (0, {"valid": True, "problems": []})
    assert asked(capsys, "init", str(path))[0] == 1, "a file that is there is left as it is"
    status, told = asked(capsys, "set", "rotation.max_deg", "50", "--config", str(path))
    assert status == 0
    assert load(path).rotation.max_deg == 50.0
    assert Path(told["backup"]).read_text() == before
    assert path.read_text().count("#") >= before.count("#") - 2, "comments stay"
    _, differences = asked(capsys, "diff", str(path))
    assert {"key": "rotation.max_deg", "file": 50.0, "other": 60.0} in differences["differences"]
    assert asked(capsys, "restore", str(path), "--list")[1] == {"backups": [Path(told["backup"]).name]}
    assert asked(capsys, "restore", str(path))[0] == 0
    assert path.read_text() == before
    assert [line.split(" by ")[0] for line in logged] == ["config init", "config set", "config restore"]
    assert "rotation.max_deg = 50" in logged[1]


REFUSED = (
    ("rotation.max_deg", "fast", "rotation.max_deg"),
    ("rotation.mxa_deg", "5", "Did you mean rotation.max_deg?"),
    ("rotation.profile", "none_such", "none_such"),
    ("presets.far.rotation_deg", "90", "presets.far needs rotation at 90.0 deg, outside its -60 to 60 deg"),
    ("presets.high.height_mm", "900", "presets.high needs lift_left at 1000.0 mm"),
    ("presets.steep.pitch_deg", "80", "presets.steep needs tilt at"),
    ("api.socket_group", "no-such-group", "there is no group no-such-group"),
    ("api.tcp.host", "0.0.0.0", "without TLS anybody on the way reads the tokens"),
)


@pytest.mark.parametrize(("key", "value", "says"), REFUSED)
def test_what_would_not_run_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], logged: list[str], key: str, value: str, says: str
) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text("# mine\n")
    status, told = asked(capsys, "set", key, value, "--config", str(path))
    assert status == 2
    assert says in " ".join(told["problems"])
    assert path.read_text() == "# mine\n"
    assert [found.name for found in tmp_path.iterdir() if found.name.endswith(".bak")] == []
    assert logged == []


def test_the_built_in_poses_do_not_forbid_narrow_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text("[lift_left]\nmin_mm = 90\nmax_mm = 110\n")
    assert asked(capsys, "check", str(path))[0] == 0


def test_a_certificate_that_is_not_there_is_found_before_the_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(f'[api.tcp]\ncertificate_file = "{tmp_path}/none.pem"\nkey_file = "{tmp_path}/none.key"\n')
    status, told = asked(capsys, "check", str(path))
    assert status == 2
    assert "none.key" in told["problems"][0]


def test_the_schema_takes_what_the_models_give(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["config", "schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(schema)
    assert "rotation" in schema["properties"]
    assert Config().model_dump(mode="json")["rotation"]["min_deg"] == -60.0
