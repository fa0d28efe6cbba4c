"""A configuration file is rewritten whole or not at all, whatever fails, races or waits in its directory."""

from __future__ import annotations

import difflib
import errno
import os
import re
import resource
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from graderd.config import ConfigError, load
from graderd.config import rewrite as module
from graderd.config.migrate import CURRENT_VERSION
from graderd.config.rewrite import BACKUPS_N, check_rights, merged, rewrite
from graderd.config.template import template

OLD = f"# mine\nversion = {CURRENT_VERSION}\n[blade]\nlength_m = 1.0 # measured\n"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    folder = tmp_path / "etc"
    folder.mkdir()
    path = folder / "graderd.toml"
    path.write_text(OLD)
    path.chmod(0o640)
    return path


def longer(text: str) -> str:
    return merged(text, {"blade": {"length_m": 1.25}})


def backups(path: Path) -> list[str]:
    return sorted(found.name for found in path.parent.glob(f"{path.name}.*.bak"))


def test_a_change_keeps_comments_mode_and_the_former_file(config: Path) -> None:
    os.utime(config, (1e9, 1e9))
    backup = rewrite(config, longer)
    assert backup is not None
    assert re.fullmatch(r"graderd\.toml\.\d{8}-\d{6}\.bak", backup.name)
    assert backup.read_text() == OLD
    assert backup.stat().st_mtime == 1e9
    assert load(config).blade.length_m == 1.25
    assert config.read_text() == OLD.replace("1.0", "1.25")
    assert {path.stat().st_mode & 0o7777 for path in (config, backup)} == {0o640}
    assert sorted(os.listdir(config.parent)) == [config.name, backup.name]


def test_no_change_writes_nothing(config: Path) -> None:
    before = config.stat()
    assert rewrite(config, lambda text: text) is None
    assert (config.stat().st_ino, config.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert os.listdir(config.parent) == [config.name]


def test_line_ends_of_windows_stay(config: Path) -> None:
    config.write_bytes(OLD.replace("\n", "\r\n").encode())
    rewrite(config, lambda text: merged(text, {"tilt": {"max_mm": 90.0}}))
    raw = config.read_bytes()
    assert raw.count(b"\r\n") == raw.count(b"\n") > 5
    assert load(config).tilt.max_mm == 90.0


@pytest.mark.parametrize("step", ["open", "fchown", "fchmod", "write", "fsync", "utime", "replace"])
@pytest.mark.parametrize("turn", [1, 2])
def test_whatever_fails_leaves_the_old_file_and_nothing_else(
    config: Path, step: str, turn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full at any system call, in the temporary file or in the backup."""
    real: Callable[..., object] = getattr(os, step)
    calls = 0

    def full(*arguments: object, **options: object) -> object:
        nonlocal calls
        creates = step != "open" or (isinstance(arguments[1], int) and arguments[1] & os.O_EXCL)
        calls += bool(creates)
        if creates and calls == turn:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*arguments, **options)

    with monkeypatch.context() as patch:
        if step == "fchown":  # asked for only where the owner differs
            patch.setattr(module, "_own", lambda file, was, _path: os.fchown(file, was.st_uid, was.st_gid))
        patch.setattr(os, step, full)
        if turn == 2 and step in ("utime", "replace"):
            rewrite(config, longer)  # once only
            return
        with pytest.raises(ConfigError) as caught:
            rewrite(config, longer)
    assert caught.value.problems == [
        f"{config}: cannot be written (No space left on device); it is as it was. Make room on its file system"
    ]
    assert config.read_text() == OLD
    assert os.listdir(config.parent) == [config.name]


WRITER = """
import sys
from pathlib import Path
from graderd.config.rewrite import merged, rewrite
from graderd.config import ConfigError
def more(text):
    import tomllib
    n = tomllib.loads(text)["recording"]["max_mb"]
    return merged(text, {"recording": {"max_mb": n + 1}})
print("ready", flush=True)
sys.stdin.readline()
for _ in range(int(sys.argv[2])):
    try:
        rewrite(Path(sys.argv[1]), more)
    except ConfigError as error:
        sys.exit(str(error))
"""


def writer(path: Path, times_n: int, before: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), str(times_n)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=before,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.live
def test_two_writers_wait_for_each_other(config: Path) -> None:
    config.write_text("[recording]\nmax_mb = 100\n")
    writers = [writer(config, 20) for _ in range(2)]
    for process in writers:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    for process in writers:
        assert process.communicate() == ("", "")
        assert process.returncode == 0
    assert load(config).recording.max_mb == 140
    assert len(backups(config)) == BACKUPS_N
    assert sorted(os.listdir(config.parent)) == [config.name, *backups(config)]


@pytest.mark.live
def test_a_disk_that_is_really_full(config: Path) -> None:
    """The kernel's own refusal in the middle of a write: this process may write no file longer than 30 bytes."""
    config.write_text("[recording]\nmax_mb = 100\n# " + 60 * "x")

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (30, 30))

    process = writer(config, 1, limit)
    _, said = process.communicate("go\n")
    assert "it is as it was. Make room on its file system" in said
    assert "Traceback" not in said
    assert load(config).recording.max_mb == 100
    assert os.listdir(config.parent) == [config.name]


@pytest.mark.live
def test_a_writer_that_never_ends_is_told_and_a_reader_holds_nobody_up(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOCK_WAIT_S", 0.1)
    holder = (
        "import fcntl,os,sys; f=os.open(sys.argv[1], int(sys.argv[2]));"
        "fcntl.{}; print(1, flush=True); sys.stdin.readline()"
    )
    for flags, lock in ((os.O_RDWR, "lockf(f, fcntl.LOCK_EX)"), (os.O_RDONLY, "flock(f, fcntl.LOCK_EX)")):
        command = [sys.executable, "-c", holder.format(lock), str(config), str(flags)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            other.stdout.readline()
            if flags == os.O_RDWR:
                with pytest.raises(ConfigError, match="another program has been changing it"):
                    rewrite(config, longer)
                assert config.read_text() == OLD
            else:
                assert rewrite(config, longer) is not None
            other.communicate("\n")


def test_two_in_one_second_keep_both_backups_and_the_oldest_go(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, _tz: object = None) -> datetime:  # type: ignore[override]
            return datetime(2026, 11, 28, 14, 30, tzinfo=UTC)

    monkeypatch.setattr(module, "datetime", Clock)
    (config.parent / "graderd.toml.bak").write_text("somebody's own copy")
    (config.parent / "graderd.toml.20200101-000000.bak").write_text("the oldest")
    for length_m in range(1, BACKUPS_N + 3):
        rewrite(config, lambda text, length_m=length_m: merged(text, {"blade": {"length_m": 1 + length_m / 100}}))  # type: ignore[misc]
    stem = "graderd.toml.20261128-143000"
    assert backups(config) == sorted(f"{stem}-{number}.bak" for number in range(3, BACKUPS_N + 3))
    assert "length_m = 1.02 " in (config.parent / f"{stem}-3.bak").read_text()
    assert "length_m = 1.11 " in (config.parent / f"{stem}-12.bak").read_text()
    assert (config.parent / "graderd.toml.bak").exists()


def test_a_linked_configuration_has_its_target_changed(config: Path, tmp_path: Path) -> None:
    link = tmp_path / "graderd.toml"
    link.symlink_to("etc/graderd.toml")
    backup = rewrite(link, longer)
    assert link.is_symlink()
    assert load(config).blade.length_m == 1.25
    assert backup is not None
    assert backup.parent.samefile(config.parent)


def test_planted_names_are_neither_followed_nor_written(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits under the names of the temporary file and of the backup leads elsewhere."""
    victim = config.parent.parent / "victim"
    victim.write_text("precious")
    monkeypatch.setattr("graderd.config.rewrite.secrets.token_hex", lambda _: "01234567")
    now = datetime.now(UTC).timestamp()
    names = [f"graderd.toml.{datetime.fromtimestamp(now + s, UTC):%Y%m%d-%H%M%S}.bak" for s in range(5)]
    for name in (".graderd.toml.01234567.new", ".graderd.toml.new", *names):
        (config.parent / name).symlink_to(victim)
    backup = rewrite(config, longer)
    assert victim.read_text() == "precious"
    assert backup is not None
    assert backup.name.endswith("-2.bak")
    assert not backup.is_symlink()
    assert not config.is_symlink()
    assert load(config).blade.length_m == 1.25


def test_a_foreign_link_is_not_followed(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "graderd.toml"
    link.symlink_to(config)
    owner = os.geteuid()
    if owner == 0:
        os.chown(link, 65534, 65534, follow_symlinks=False)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(ConfigError, match="not followed"):
        rewrite(link, longer)
    assert config.read_text() == OLD


def test_an_editor_that_saved_meanwhile_loses_nothing(config: Path) -> None:
    def slow(text: str) -> str:
        new = config.with_name("editor")
        new.write_text(OLD + "# edited\n")
        new.replace(config)
        return longer(text)

    with pytest.raises(ConfigError, match="at the same moment"):
        rewrite(config, slow)
    assert config.read_text() == OLD + "# edited\n"
    assert os.listdir(config.parent) == [config.name]


def test_what_a_crashed_writer_left_goes(config: Path) -> None:
    (config.parent / ".graderd.toml.deadbeef.new").write_text("half")
    rewrite(config, longer)
    assert sorted(os.listdir(config.parent)) == [config.name, *backups(config)]


def test_a_new_file_may_be_read_by_whom_its_directory_is_for(tmp_path: Path) -> None:
    folder = tmp_path / "etc"
    folder.mkdir()
    folder.chmod(0o750)
    path = folder / "graderd.toml"
    with pytest.raises(ConfigError, match="No such file"):
        rewrite(path, longer)
    old = os.umask(0o077)
    try:
        check_rights(path)
        assert os.listdir(folder) == []
        assert rewrite(path, longer, create=True) is None
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o640
    assert load(path).blade.length_m == 1.25
    assert os.listdir(folder) == [path.name]


def test_a_new_text_that_is_no_configuration_is_not_written(config: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="length_m"):
        rewrite(config, lambda text: merged(text, {"blade": {"length_m": -1.0}}))
    with pytest.raises(ConfigError, match=re.escape(str(config))):
        rewrite(config, lambda text: merged(text + "[", {}))
    with pytest.raises(ConfigError, match="valid TOML"):
        rewrite(config, lambda _: "[")
    absent = tmp_path / "absent.toml"
    with pytest.raises(ConfigError):
        rewrite(absent, lambda _: "[", create=True)
    assert config.read_text() == OLD
    assert os.listdir(config.parent) == [config.name]
    assert not absent.exists()


def test_checking_rights_changes_nothing(config: Path) -> None:
    before = config.stat()
    check_rights(config)
    after = config.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert os.listdir(config.parent) == [config.name]


@pytest.mark.parametrize("kind", ["directory", "fifo"])
def test_what_is_no_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "graderd.toml"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(ConfigError, match=r"no regular file|Is a directory"):
        rewrite(path, longer)


def test_a_key_takes_the_line_where_it_stood_as_a_comment() -> None:
    """Beneath its own explanation, not beneath what explains the next table; what has no such line comes below the
    table's header, and nothing else changes."""
    before = template()
    changes = {"simulated": True, "rotation": {"port": "/dev/servo"}, "camera": {"exposure_us": 80.0}}
    after = merged(before, changes).splitlines()
    removed, added = (
        [line[2:] for line in difflib.ndiff(before.splitlines(), after) if line.startswith(mark)]
        for mark in ("- ", "+ ")
    )
    assert removed == ["#simulated = false", "# exposure_us: not set", '#port = "/dev/graderd/servo"']
    assert added == ["simulated = true", "exposure_us = 80.0", 'port = "/dev/servo"']
    assert after[after.index('port = "/dev/servo"') - 1] == "# serial port, or a udev symlink to it"
    assert merged("[tilt]\nmin_mm = 4.0\n\n# of the rule\n[rule]\n", {"tilt": {"max_mm": 90.0}}) == (
        "[tilt]\nmax_mm = 90.0\nmin_mm = 4.0\n\n# of the rule\n[rule]\n"
    )


def test_a_table_comes_where_it_stood_as_a_comment_or_beside_its_like() -> None:
    """Never between another table's explanation and its header."""
    before = template()
    after = merged(before, {"api": {"tcp": {"port_n": 8000, "host": "::1"}}})
    removed, added = (
        [line[2:] for line in difflib.ndiff(before.splitlines(), after.splitlines()) if line.startswith(mark)]
        for mark in ("- ", "+ ")
    )
    assert removed == ["#[api.tcp]", '#host = "127.0.0.1"', "#port_n = 8431"]
    assert added == ["[api.tcp]", 'host = "::1"', "port_n = 8000"]

    changes = {"api": {"tcp": {"port_n": 8000, "host": "::1"}}}
    short = "[api]\n#socket = 'x'\n\n# what is\n# recorded\n[recording]\n"
    assert merged(short, changes) == (
        "[api]\n#socket = 'x'\n\n[api.tcp]\nhost = \"::1\"\nport_n = 8000\n\n# what is\n# recorded\n[recording]\n"
    )
    for text in ("", "[api]\n", "[api]\ntcp = { port_n = 1 }\n", "[api]\ntcp.port_n = 1\n", "[api.limits]\n"):
        assert tomllib.loads(merged(text, changes))["api"]["tcp"] == {"port_n": 8000, "host": "::1"}, text


def test_the_explanation_of_a_table_is_whole() -> None:
    """A sentence and more, as the models have it: none ends in its middle."""
    lines = template().splitlines()
    ends = [lines[at - 1] for at, line in enumerate(lines) if re.fullmatch(r"#?\[[\w.]+\]", line)]
    assert len(ends) > 20
    assert [line for line in ends if not (line.startswith("# ") and line.endswith("."))] == []


def test_where_there_is_no_file_yet_the_line_says_how_to_begin(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "graderd.toml"
    with pytest.raises(ConfigError, match=f"graderd config init {path}"):
        rewrite(path, longer)
    with pytest.raises(ConfigError, match=f"graderd config init {path}"):
        check_rights(path)
