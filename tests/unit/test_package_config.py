"""The configuration a package installs, and what becomes of an older one at an upgrade."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from graderd.config import Config, ConfigError, load, parse
from graderd.config.migrate import CURRENT_VERSION, Document, migrate_file, migrate_text, rename
from graderd.config.template import template
from graderd.core.axes import ACTUATORS
from graderd.hal.settings import ElectrakSettings, Ph54Settings

PROJECT = Path(__file__).resolve().parents[2]

OLD = """\
# the yard's grader
version = 0

[servo]
zero_deg = 12.5  # measured 2026-10-02

[actuators.left]
address_n = 21
"""


def to_1(document: Document) -> list[str]:
    """A step as a later version would bring one."""
    return rename(document, "servo", "rotation") + rename(document, "actuators.left", "lift_left")


STEPS = {0: to_1, 1: lambda _: []}


def test_migration_keeps_values_and_comments_and_leaves_a_backup(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(OLD, encoding="utf-8")
    path.chmod(0o660)
    backup, changes = migrate_file(path, STEPS)
    assert backup is not None
    assert backup.read_text(encoding="utf-8") == OLD
    assert changes == ["servo is now rotation", "actuators.left is now lift_left"]
    text = path.read_text(encoding="utf-8")
    assert "# the yard's grader" in text
    assert "# measured 2026-10-02" in text
    assert path.stat().st_mode & 0o777 == 0o660
    config = load(path)
    assert config.version == CURRENT_VERSION
    assert isinstance(config.rotation, Ph54Settings)
    assert config.rotation.zero_deg == 12.5
    assert isinstance(config.lift_left, ElectrakSettings)
    assert config.lift_left.address_n == 21


def test_a_present_file_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(f"version={CURRENT_VERSION}   # odd spacing stays\n", encoding="utf-8")
    before = path.stat()
    assert migrate_file(path, STEPS) == (None, [])
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert [entry.name for entry in tmp_path.iterdir()] == ["graderd.toml"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("version = 99\n", "newer graderd"),
        ("version = 0\n[servo]\nzero_dge = 1\n", "zero_deg"),
        ("[[[", "not valid TOML"),
    ],
)
def test_what_cannot_be_migrated_is_left_as_it_was(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=says):
        migrate_file(path, STEPS)
    assert path.read_text(encoding="utf-8") == text
    assert [entry.name for entry in tmp_path.iterdir()] == ["graderd.toml"]


def test_steps_run_in_order_up_to_the_present_version() -> None:
    steps = {5: lambda d: rename(d, "a.x", "b.x"), 6: lambda d: rename(d, "b.x", "b.y_deg")}
    text, changes = migrate_text("version = 5\n[a]\nx = 3\n", steps, current=7)
    assert tomllib.loads(text) == {"version": 7, "b": {"y_deg": 3}}
    assert changes == ["a.x is now b.x", "b.x is now b.y_deg"]


def test_the_installed_file_names_every_key_and_gives_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text(template(), encoding="utf-8")
    config = load(path)
    assert config.recording.directory == "/var/lib/graderd/recordings"
    assert config.model_copy(update={"recording": Config().recording}) == Config()
    text = path.read_text(encoding="utf-8")
    for key in ("zero_deg", "usb_serial_number", "source_address_n", "serial_number", "stop_pgn_n", "socket_group"):
        assert key in text


def test_version_1_told_a_limit_in_several_places_and_the_narrowest_counts() -> None:
    text, changes = migrate_text(
        """# the yard
[gate]
rotation_max_deg = 45.0  # the fender
rotation_speed_deg_per_s = 20.0
lift_max_mm = 200.0
rotation_min_height_mm = 10.0

[rotation]
max_deg = 70.0
velocity_deg_per_s = 15.0
acceleration_deg_per_s2 = 40.0

[lift_right]
max_mm = 180.0

[control]
rotation_max_age_s = 0.3
actuator_tolerance_mm = 2.0
"""
    )
    config = parse(tomllib.loads(text))
    figures = config.figures()
    assert (figures["rotation"].high, figures["rotation"].speed, figures["rotation"].acceleration) == (45.0, 15.0, 40.0)
    assert (figures["lift_left"].high, figures["lift_right"].high) == (200.0, 180.0)
    assert figures["rotation"].max_age_s == 0.3
    assert {figures[axis].tolerance for axis in ACTUATORS} == {2.0}
    assert config.gate.rotation_min_height_mm == 10.0
    assert text.startswith("# the yard")
    assert "[control]" not in text
    assert any("gate.rotation_max_deg and rotation.max_deg: now rotation.max_deg = 45" in change for change in changes)


def test_a_limit_that_the_gates_default_narrowed_stays_narrow() -> None:
    text, _ = migrate_text("version = 1\n[rotation]\nmin_deg = -80.0\n")
    assert parse(tomllib.loads(text)).figures()["rotation"].low == -60.0
    text, changes = migrate_text("[recording]\nrate_hz = 10.0\nmax_mb = 100.0\n")
    assert "rate_hz" not in text
    assert "max_mb = 100.0" in text
    assert changes == ["recording.rate_hz is gone: every tick is recorded"]
    assert migrate_text("[rotation]\nmin_deg = -80.0\n") == ("[rotation]\nmin_deg = -80.0\n", [])
