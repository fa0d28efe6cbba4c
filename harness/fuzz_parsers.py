"""Damage for everything that reads text from outside: ``python -m harness.fuzz_parsers [--strings N] [--seed N]``.

Targets: configuration files and their migration, frame sets (manifest and camera file), names of firmware profiles,
messages of the perception child, the state file, commands of clients and of the rig's. Each gets valid texts with bytes
flipped, cut, doubled, inserted and values made absurd. Counted are exceptions other than the documented ones, and the
most memory one text made a parser take. Packets have ``fuzz_dynamixel``, CAN frames and HTTP requests their tests.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit
from pydantic import TypeAdapter, ValidationError

from graderd.config import Config, ConfigError, load
from graderd.config.migrate import STEPS, migrate_text, rename
from graderd.core.blade import BladeGeometry
from graderd.core.commands import AnyCommand, Command
from graderd.core.soil import SoilObservation, Zone
from graderd.drivers.dynamixel.table import ControlTable
from graderd.drivers.electrak.profile import load_profile
from graderd.firmware_profiles import UnknownProfileError
from graderd.hal.camera import Frame
from graderd.hal.errors import DeviceError, WrongDeviceError
from graderd.perception.frame_set import Entry, FrameSet, FrameSetWriter
from graderd.perception.settings import CameraCalibration
from graderd.runtime.perception_protocol import FromChild, Observed
from graderd.runtime.state_file import StateFile
from graderd.simulator.control_server import COMMAND as RIG_COMMAND

ABSURD = (b"1e999", b"-1", b"nan", b"9" * 400, b"null", b"[]", b"{}", b"true", b"''", b"0x10", b"1979-05-27", b"\xff")
MOST_BYTES = 64 << 20
CLIENT_COMMAND: TypeAdapter[Command] = TypeAdapter(AnyCommand)


@dataclass(frozen=True)
class Target:
    """A parser: valid texts to damage, and the exceptions it documents."""

    corpus: tuple[bytes, ...]
    parse: Callable[[bytes], object]
    documented: tuple[type[Exception], ...]


def _toml(config: Config) -> bytes:
    return tomlkit.dumps(config.model_dump(mode="json", exclude_none=True)).encode()


def _in_file(path: Path, parse: Callable[[], object]) -> Callable[[bytes], object]:
    def run(data: bytes) -> object:
        path.write_bytes(data)
        return parse()

    return run


def _state(directory: Path, data: bytes) -> None:
    (directory / "last_stop.json").write_bytes(data)
    file = StateFile(str(directory))
    if file.load() is None and not file.problem:
        raise AssertionError("a file that says nothing must be told")


def targets(directory: Path) -> dict[str, Target]:
    """Everything that is fuzzed; files go below ``directory``."""
    frame_set = directory / "set"
    writer = FrameSetWriter(frame_set, CameraCalibration(), BladeGeometry(), ())
    for number in ("001", "002"):
        picture = np.zeros((8, 8, 3), np.uint8)
        writer.add(Entry(number, Zone.LEFT, 12.5, 1.0, 2.0, 3.0), Frame(picture, None, None, None, 0.0))
    manifest, described = (frame_set / "manifest.csv").read_bytes(), (frame_set / "camera.json").read_bytes()
    seen = Observed.of(SoilObservation(1.0, Zone.LEFT, 0.5, "why", 0.9, 0.1, 0.0))
    config_text, old = _toml(Config()), b'version = 0\n[servo]\nport = "x"\n[actuators.left]\naddress_n = 5\n'
    steps = {
        **STEPS,
        0: lambda document: rename(document, "servo", "rotation") + rename(document, "actuators.left", "lift"),
    }
    config_path = directory / "g.toml"
    return {
        "config": Target((config_text,), _in_file(config_path, lambda: load(config_path)), (ConfigError,)),
        "migration": Target(
            (config_text, old),
            lambda data: migrate_text(data.decode("utf-8", "replace"), steps),
            (ConfigError,),
        ),
        "manifest": Target(
            (manifest,), _in_file(frame_set / "manifest.csv", lambda: FrameSet(frame_set)), (DeviceError,)
        ),
        "camera file": Target(
            (described,), _in_file(frame_set / "camera.json", lambda: FrameSet(frame_set)), (DeviceError,)
        ),
        "profile name": Target(
            (b"electrak_hd_b017", b"electrak_md_a050"),
            lambda data: (_profile(data.decode("latin-1")), load_profile(data.decode("latin-1"))),
            (DeviceError,),
        ),
        "child": Target(
            (
                seen.model_dump_json().encode(),
                b'{"kind": "opened", "description": "x", "settings_read_back": {"gain": 1.0}, "not_kept": []}',
                b'{"kind": "problem", "condition": "stale", "message": "x"}',
            ),
            _child,
            (ValueError,),
        ),
        "state file": Target(
            (b'{"reason": "stop", "wall_time": "2026-01-01T00:00:00+00:00"}',), lambda data: _state(directory, data), ()
        ),
        "client command": Target(
            (
                b'{"command": "jog", "axis": "rotate", "value": 5.0, "relative": true, "client": "c"}',
                b'{"command": "preset", "name": "center"}',
                b'{"command": "stop", "reason": "x"}',
            ),
            CLIENT_COMMAND.validate_json,
            (ValidationError,),
        ),
        "rig command": Target(
            (
                b'{"cmd": "servo_fault", "name": "drop", "params": {"rate": 0.5}}',
                b'{"cmd": "scene", "zone": "left", "seed": 5}',
                b'{"cmd": "can_frame", "can_id": 5, "data_hex": "00ff"}',
            ),
            RIG_COMMAND.validate_json,
            (ValidationError,),
        ),
    }


def _profile(name: str) -> object:
    try:
        return ControlTable.load(name)
    except (UnknownProfileError, WrongDeviceError):
        return None  # not a profile, or one of another kind of device


def _child(data: bytes) -> object:
    message = FromChild.validate_json(data)
    return message.unpack() if isinstance(message, Observed) else message


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four kinds of damage."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.randrange(1, 60))
        match rng.randrange(6):
            case 0:
                data = data[:at] + bytes((rng.randrange(256),)) + data[at + 1 :]
            case 1:
                data = data[:at] + data[end:]
            case 2:
                data = data[:end] + data[at:end] * rng.choice((1, 2, 200)) + data[end:]
            case 3:
                data = data[:at] + rng.choice(ABSURD) + data[end:]
            case 4:
                data = data[:at] + rng.choice((b"[" * 3000, b"{" * 3000, b'"', b"\n[x]\n", b"\x00", b"=")) + data[at:]
            case _:
                data = data[:at]
    return data


def fuzz(name: str, target: Target, strings_n: int, rng: random.Random) -> dict[str, object]:
    """Feed one target; what escaped, what was accepted and the most memory taken."""
    escaped: list[str] = []
    accepted_n, most_bytes = 0, 0
    tracemalloc.start()
    try:
        for _ in range(strings_n):
            data = damaged(rng.choice(target.corpus), rng)
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            try:
                target.parse(data)
                accepted_n += 1
            except target.documented:
                pass
            except Exception as error:
                escaped.append(f"{type(error).__name__}: {str(error)[:80]} for {data[:60]!r}")
            most_bytes = max(most_bytes, tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    return {
        "target": name,
        "strings_n": strings_n,
        "accepted_n": accepted_n,
        "escaped_n": len(escaped),
        "first_escaped": escaped[:3],
        "most_mb": round(most_bytes / 1e6, 2),
    }


def main() -> int:
    """Command line; status 1 where anything escaped or took too much memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--strings", type=int, default=2000, metavar="N", help="for each target")
    parser.add_argument("--seed", type=int, default=None)
    options = parser.parse_args()
    seed = time.time_ns() if options.seed is None else options.seed
    bad_n = 0
    with tempfile.TemporaryDirectory() as directory:
        for name, target in targets(Path(directory)).items():
            found = fuzz(name, target, options.strings, random.Random(f"{seed} {name}"))
            bad_n += bool(found["escaped_n"]) or float(str(found["most_mb"])) * 1e6 > MOST_BYTES
            print(json.dumps(found, ensure_ascii=False))
    print(f"seed {seed}: {'all well' if not bad_n else f'{bad_n} targets failed'}")
    return 1 if bad_n else 0


if __name__ == "__main__":
    raise SystemExit(main())
