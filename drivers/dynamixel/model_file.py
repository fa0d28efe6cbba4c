"""``python -m graderd.drivers.dynamixel.model_file MODEL``: a firmware profile from a table of the Dynamixel SDK.

The ``.model`` files that dynamixel-sdk ships (and Dynamixel Wizard) give addresses, sizes and names, the counts of a
turn, the unit of velocities and the signs of four registers. Access, the other units and signs, ranges and bits are
those of the family's profile that graderd has, whose every register must be there and agree; what tells one servo of
the family from another stands in ``firmware_profiles/p_series.toml``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import tomlkit

from graderd import firmware_profiles
from graderd.drivers.dynamixel.table import ControlTable, Register
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceMissingError,
    DeviceRefusedError,
    ProtocolError,
    WrongDeviceError,
)

_FAMILY: Final = "p_series"
_SDK: Final = "dynamixel_easy_sdk"
_ALIASES: Final = frozenset(f"Indirect {what} {way}" for what in ("Address", "Data") for way in ("Write", "Read"))
"""Second names that the SDK has for registers it names once already."""
_UNSTATED: Final = frozenset({"raw", ""})
_RAD_PER_S: Final = math.tau / 60.0
"""One revolution a minute."""


@dataclass(frozen=True, slots=True)
class ModelFile:
    """What a ``.model`` file says. ``units``: register's label to scale, unit and whether it is signed."""

    name: str
    half_turn_counts: int
    units: dict[str, tuple[float, str, bool]]
    registers: dict[str, tuple[int, int]]

    @classmethod
    def parse(cls, name: str, text: str) -> ModelFile:
        """Read the three tab-separated sections.

        Raises:
            ProtocolError: it is no such file; the message names the line.
        """
        section, types = "", {}
        units: dict[str, tuple[float, str, bool]] = {}
        registers: dict[str, tuple[int, int]] = {}
        header = False
        for number, line in enumerate(text.splitlines(), 1):
            if not line.strip():
                continue
            if line.startswith("["):
                section, header = line.strip(), True
                continue
            if header:  # the columns' names
                header = False
                continue
            cells = line.rstrip().split("\t")
            try:
                if section == "[type info]":
                    types[cells[0]] = float(cells[1])
                elif section == "[unit info]":
                    units[cells[0]] = float(cells[1]), cells[2], cells[3] == "signed"
                elif section == "[control table]":
                    registers[cells[2]] = int(cells[0]), int(cells[1])
                else:
                    raise ValueError
            except (IndexError, ValueError):
                raise ProtocolError(name, f"line {number} is none of a .model file: {line[:40]!r}") from None
        if not registers or "value_of_max_radian_position" not in types:
            raise ProtocolError(name, "is no .model file of a servo: it has no table, or no counts of a turn")
        return cls(name, round(types["value_of_max_radian_position"]), units, registers)


def find(model: str) -> ModelFile:
    """The ``.model`` file of that name in the SDK, or at that path.

    Raises:
        DeviceMissingError: there is none; the message names what there is.
        ProtocolError: as :meth:`ModelFile.parse`.
    """
    path = Path(model)
    if path.suffix != ".model":
        try:
            folder = Path(str(files(_SDK))) / "control_table"
        except ModuleNotFoundError:
            raise DeviceMissingError(
                model, "dynamixel-sdk is not installed", "Install it, or give the path of a .model file"
            ) from None
        path = folder / f"{model.lower().replace('-', '_').removesuffix('_r')}.model"
    try:
        return ModelFile.parse(path.stem, path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        cause = error.strerror if isinstance(error, OSError) else "is no text"
        remedy = f"There are {', '.join(models())}"
        raise DeviceMissingError(str(path), cause or "cannot be read", remedy) from None


def models() -> tuple[str, ...]:
    """Names of the servos that can be imported."""
    family = firmware_profiles.load(_FAMILY)
    return tuple(sorted((*family["model"], family["like"])))


def profile_of(model: ModelFile) -> dict[str, Any]:
    """The firmware profile of a servo of the family.

    Raises:
        WrongDeviceError: its registers, units or signs are not the family's, or its ratings are not known.
    """
    family = firmware_profiles.load(_FAMILY)
    profile = firmware_profiles.load(family["like"])
    table = ControlTable(profile)
    _compare(model, table)
    if model.name != profile["name"]:
        _take(profile, family["model"].get(model.name), model)
    turn = profile["motion"]["pulses_per_turn"]
    if turn // 2 != model.half_turn_counts:
        raise WrongDeviceError(model.name, f"half a turn is {model.half_turn_counts} counts, {turn // 2} was expected")
    return profile


def _compare(model: ModelFile, table: ControlTable) -> None:
    """Every register at its place, every unit and sign as in the family's profile."""
    ours = {r.label: r for r in table.registers}
    wrong = [
        f"{label} is at {address} with {size} bytes, not at {ours[label].address} with {ours[label].size}"
        if label in ours
        else f"{label} ({address}) is unknown"
        for label, (address, size) in model.registers.items()
        if label not in _ALIASES and (label not in ours or (ours[label].address, ours[label].size) != (address, size))
    ]
    named = frozenset(model.registers)
    wrong += [
        f"{r.label} is missing"
        for r in table.registers
        if r.label not in named and not r.label.startswith(("Indirect ", "External Port "))
    ]
    if wrong:
        more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        cause = f"its control table is not the P series': {'; '.join(wrong[:3])}{more}"
        raise WrongDeviceError(model.name, cause, f"graderd drives {', '.join(models())}")
    for label, (scale, unit, signed) in model.units.items():
        if (difference := _difference(ours[label], scale, unit, signed)) is not None:
            raise WrongDeviceError(model.name, f"{label} {difference}", "Is this file from the SDK as it is?")


def _difference(register: Register, scale: float, unit: str, signed: bool) -> str | None:
    if signed != register.signed:
        return f"is {'' if signed else 'un'}signed there, and not here"
    if unit in _UNSTATED:
        return None
    ours = register.scale * _RAD_PER_S if register.unit == "rev/min" else register.scale
    if unit != {"rev/min": "rad/s"}.get(register.unit, register.unit) or not math.isclose(ours, scale, rel_tol=1e-6):
        return f"counts {scale:g} {unit} there, {ours:g} here"
    return None


def _take(profile: dict[str, Any], own: dict[str, Any] | None, model: ModelFile) -> None:
    """Put in what is the model's own; what a limit register bounds follows it."""
    if own is None:
        cause = "its ratings and limits are not known to graderd"
        raise WrongDeviceError(model.name, cause, f"Known are {', '.join(models())}")
    template = {row["name"]: dict(row) for row in profile["table"]["register"]}
    half = model.half_turn_counts
    profile |= {"name": model.name, "title": own["title"], "model_number": own["model_number"]}
    profile["motion"] |= own["motion"]
    profile["rating"] |= own["rating"]
    changes = {**own["register"], "model_number": {"default": own["model_number"]}}
    for end in ("min_position_limit", "max_position_limit"):
        changes[end] = {**changes[end], "min": -half, "max": half}
    rows = {row["name"]: row for row in profile["table"]["register"]}
    for name, fields in changes.items():
        rows[name].update(fields)
    for name, row in rows.items():
        if (limit := row.get("limit")) in rows:
            top, former = rows[limit], template[limit]["default"]
            row.update(max=top["max"], min=-top["max"] if row.get("signed") else 0)
            row["default"] = top["default"] if template[name]["default"] == former else row["default"]
    own_words = {*own["disputed"], "min_position_limit", "max_position_limit", "moving_threshold"}
    source = "editions of the model's e-manual page"
    profile["disagreement"] = [d for d in profile["disagreement"] if d["register"] not in own_words] + [
        {"register": name, "field": "default", "values": values, "sources": source}
        for name, values in own["disputed"].items()
    ]
    for end, sign in (("min_position_limit", -1), ("max_position_limit", 1)):
        values = [rows[end]["default"], sign * half]
        profile["disagreement"].append(
            {"register": end, "field": "default", "values": values, "sources": "e-manual default against half a turn"}
        )


def text_of(profile: dict[str, Any], model: ModelFile) -> str:
    """The profile as a file, a register a line."""
    document = tomlkit.document()
    for line in (
        f"{profile['title']}: control table and ratings.",
        "",
        f"Written by 'graderd profile import' from {model.name}.model of the Dynamixel SDK. Access, units, signs and",
        "bits are those of the PH54's profile, ratings and limits of the ROBOTIS e-manual (p_series.toml).",
    ):
        document.add(tomlkit.comment(line))
    for key, value in profile.items():
        if key != "table":
            document[key] = value
            continue
        rows = tomlkit.array()
        for row in value["register"]:
            inline = tomlkit.inline_table()
            inline.update(row)
            rows.append(inline)
        document[key] = {"register": rows.multiline(True)}
    return tomlkit.dumps(document)


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where there is no such model, it is no servo of the family, or the file cannot be written."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.drivers.dynamixel.model_file",
        description="Write a firmware profile from a control table of the Dynamixel SDK.",
        epilog="example: model_file ph42_020_s300 --to ph42_020_s300.toml",
    )
    parser.add_argument("model", help="name, such as PH42-020-S300-R, or the path of a .model file")
    help_ = "the new profile, or the folder for it (default: this one)"
    parser.add_argument("--to", type=Path, default=Path(), metavar="FILE", help=help_)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text")
    arguments = parser.parse_args(argv)
    try:
        model = find(arguments.model)
        text = text_of(profile_of(model), model)
        path = _write(text, arguments.to / f"{model.name}.toml" if arguments.to.is_dir() else arguments.to)
    except DeviceError as error:
        sys.stderr.write(f"graderd: {error}\n")
        return 1
    if arguments.json:
        sys.stdout.write(json.dumps({"written": str(path.resolve()), "model": model.name}) + "\n")
        return 0
    sys.stdout.write(f'written to {path}; in the configuration: [rotation] profile = "{path.resolve()}"\n')
    return 0


def _write(text: str, path: Path) -> Path:
    remedy = "Name another with --to"
    if path.suffix != ".toml":
        raise CommandRangeError(str(path), "is no folder, and no name that ends with .toml", remedy)
    try:
        with path.open("x", encoding="utf-8") as out:
            out.write(text)
    except FileExistsError:
        raise DeviceRefusedError(str(path), "is there already", remedy) from None
    except OSError as error:
        raise DeviceRefusedError(str(path), f"cannot be written ({error.strerror})", remedy) from None
    return path


if __name__ == "__main__":
    sys.exit(main())
