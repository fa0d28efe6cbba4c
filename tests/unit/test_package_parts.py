"""Parts of the Debian package that can be judged without building it: notices, byte code, which devices it asks for."""

from __future__ import annotations

import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from graderd.config.migrate import CURRENT_VERSION
from hil.package import newer_format

PROJECT = Path(__file__).resolve().parents[2]
BYTECODE = PROJECT / "packaging" / "bytecode"
POSTINST = PROJECT / "packaging" / "debian" / "postinst"

# A script's module, outside every package.
copyright_file = runpy.run_path(str(PROJECT / "packaging" / "notices.py"))["copyright_file"]

APACHE = (
    "Apache License\nVersion 2.0, January 2004\n\nlong text\n\nEND OF TERMS AND CONDITIONS\n\nCopyright 2019 Somebody\n"
)


def wheel(folder: Path, name: str, metadata: str, licence: str = "") -> Path:
    """A wheel with one package, a module and a file that goes elsewhere."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}/__init__.py", "")
        archive.writestr(f"{name}_extra.py", "")
        archive.writestr(f"{name}-1.0.data/scripts/{name}", "")
        archive.writestr(f"{name}-1.0.dist-info/METADATA", f"Name: {name}\nVersion: 1.0\n{metadata}")
        if licence:
            archive.writestr(f"{name}-1.0.dist-info/licenses/LICENSE", licence)
    return path


def test_notices_name_files_holder_licence_and_text_of_each_dependency(tmp_path: Path) -> None:
    one = wheel(tmp_path, "one", "License-Expression: MIT\n", "Copyright (c) 2020 One Person\n\nMay be used.\n")
    other = wheel(tmp_path, "other", "License: Apache 2.0\n", APACHE)
    text = copyright_file({"3.11": [one, other]}, {one: "opt/graderd/lib/common", other: "opt/x"})
    stanzas = {part.splitlines()[0]: part for part in text.split("\n\n")}
    first = stanzas["Files: opt/graderd/lib/common/one-1.0.dist-info/*"]
    assert "\n opt/graderd/lib/common/one/*\n opt/graderd/lib/common/one_extra.py\n" in first
    assert "scripts" not in first
    assert "\nCopyright: Copyright (c) 2020 One Person\nLicense: MIT\n" in first
    assert "\n .\n May be used.\n" in first
    second = stanzas["Files: opt/x/other-1.0.dist-info/*"]
    assert "long text" not in second
    assert "/usr/share/common-licenses/Apache-2.0" in second
    assert "Copyright 2019 Somebody" in second
    for line in text.splitlines():
        assert re.match(r"[A-Z][A-Za-z-]+: | \S| {2,}\S|$", line), line


def test_a_dependency_that_says_nothing_of_its_licence_is_not_shipped(tmp_path: Path) -> None:
    nameless = wheel(tmp_path, "nameless", "")
    with pytest.raises(LookupError, match="names no licence"):
        copyright_file({"3.11": [nameless]}, {nameless: "opt"})


def tree(prefix: Path) -> Path:
    """A package with one module, of all Pythons, and one for this Python."""
    own = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for place in ("common/package", f"{own}/site-packages/package", "python3.99/site-packages/package"):
        (prefix / "lib" / place).mkdir(parents=True)
        (prefix / "lib" / place / "module.py").write_text("VALUE = 1\n", encoding="utf-8")
    return prefix


def bytecode(action: str, prefix: Path) -> int:
    return subprocess.run([sys.executable, "-I", BYTECODE, action, prefix], check=False).returncode


@pytest.mark.live
def test_byte_code_is_made_for_this_python_kept_and_taken_away(tmp_path: Path) -> None:
    prefix = tree(tmp_path)
    foreign = prefix / "lib/common/package/__pycache__/module.cpython-399.pyc"
    orphan = prefix / f"lib/common/package/__pycache__/gone.{sys.implementation.cache_tag}.pyc"
    foreign.parent.mkdir()
    foreign.touch()
    orphan.touch()
    assert bytecode("make", prefix) == 0
    made = sorted(prefix.rglob("*.pyc"))
    assert len(made) == 2
    assert not {foreign, orphan} & set(made)
    # Named as it will be installed, and not compared with its source at each start (flags 1: by hash, unchecked).
    assert b"/opt/graderd/lib/common/package/module.py" in made[0].read_bytes()
    assert made[0].read_bytes()[4:8] == b"\1\0\0\0"
    times = [path.stat().st_mtime_ns for path in made]
    assert bytecode("make", prefix) == 0
    assert [path.stat().st_mtime_ns for path in made] == times
    assert bytecode("remove", prefix) == 0
    assert not list(prefix.rglob("__pycache__"))


@pytest.mark.live
def test_byte_code_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    prefix = tree(tmp_path)
    (prefix / "lib/common/package/__pycache__").write_text("in the way", encoding="utf-8")
    assert bytecode("make", prefix) == 1


@pytest.mark.live
def test_installing_asks_anew_only_for_devices_the_rules_are_about(tmp_path: Path) -> None:
    """By the function of the script itself, with a udevadm that writes down what it is asked."""
    function = re.search(
        r"^trigger_our_devices\(\) \{\n.*?^\}\n", POSTINST.read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    assert function
    adapters = tmp_path / "adapters"
    adapters.write_text(
        "# names\n#servo COMMENTED\n\nblade FT1234\ncan-grader 003B0034  # its bus\nnameless\n", "utf-8"
    )
    script = f'set -eu\nudevadm() {{ printf "%s|" "$@"; echo; }}\n{function.group()}trigger_our_devices\n'
    done = subprocess.run(
        ["sh", "-c", script.replace("/etc/graderd/adapters", str(adapters))], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == [
        "trigger|--action=add|--subsystem-match=usb|--attr-match=product=*RealSense*|",
        "trigger|--action=add|--subsystem-match=net|--attr-match=type=280|",
        "trigger|--action=add|--subsystem-match=tty|--property-match=ID_MODEL_ID=6014|"
        "--property-match=ID_SERIAL_SHORT=FT1234|--property-match=ID_SERIAL_SHORT=003B0034|",
    ]


def test_the_newest_backup_that_this_version_can_use_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of several in one second, too, whose names are in no order as text."""
    for name, text in (
        ("", ""),
        ("-2", ""),
        ("-9", ""),
        ("-10", "[blade]\nlength_m = 1.1\n"),
        ("-11", "version = 99\n"),
    ):
        (tmp_path / f"graderd.toml.20260102-000000{name}.bak").write_text(text, encoding="utf-8")
    (tmp_path / "graderd.toml.20260101-235959.bak").touch()
    (tmp_path / "graderd.toml.9.bak").write_text("somebody's own", encoding="utf-8")
    asked = POSTINST.read_text(encoding="utf-8").split("usable_backup() {")[1].split("<<'END'\n")[1].split("END\n")[0]
    assert asked.count('"/etc/graderd/graderd.toml"') == 1
    exec(asked.replace('"/etc/graderd/graderd.toml"', repr(str(tmp_path / "graderd.toml"))), {})
    assert capsys.readouterr().out == f"{tmp_path}/graderd.toml.20260102-000000-10.bak\n"


@pytest.mark.live
def test_the_newer_package_of_the_hil_takes_this_ones_configuration(tmp_path: Path) -> None:
    """`make hil-package` upgrades to a version with a later format; what it changes for that must still be there."""
    shutil.copytree(PROJECT / "graderd" / "config", tmp_path / "graderd" / "config")
    newer_format(tmp_path / "graderd" / "config")
    config = tmp_path / "graderd.toml"
    config.write_text(f"version = {CURRENT_VERSION}\n[yard]\nzero_deg = 7.25\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", NEWER_MIGRATES, tmp_path / "graderd" / "config", config], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert f"version = {CURRENT_VERSION + 1}\n" in config.read_text(encoding="utf-8")
    assert "[rotation]\nzero_deg = 7.25\n" in config.read_text(encoding="utf-8")


NEWER_MIGRATES = """
import sys
from pathlib import Path
import graderd
sys.modules.pop("graderd.config", None)
graderd.__path__.insert(0, str(Path(sys.argv[1]).parent))
from graderd.config.migrate import migrate_file
migrate_file(Path(sys.argv[2]))
"""
