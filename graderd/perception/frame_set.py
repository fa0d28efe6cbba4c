"""Frame sets: colour with depth as a folder of ordinary files, to hand frames from one place to another.

::

    NNN.color.jpg | NNN.color.png     8-bit colour
    NNN.depth.png                     16-bit, millimetres along the optical axis (Z, not range), 0 = no value
    manifest.csv                      one line a frame, in order
    camera.json                       lens and pose of each stream in the vehicle frame, and the blade

``manifest.csv`` begins with the columns ``id,label,blade_angle_deg,vol_left_l,vol_center_l,vol_right_l``; ``id`` is the
NNN of the file names; ``label`` is left, center, right, even, none or unknown, or empty; volumes may be empty. The
columns ``blade_height_mm,blade_slope_deg,blade_pitch_deg``, which may be missing or empty, give the blade's attitude as
its lifts and its tilt measured it. Further columns are carried through. ``camera.json``: pixel centres at integers;
``rotation_vehicle_from_optical`` row-major,
its columns the optical axes (X right, Y down, Z along the view) in the vehicle frame (x forward, y left, z up, metres,
origin at the blade's rotation axis on the ground); ``p_vehicle = rotation @ p_optical + position_m``. The block
``depth`` and the ``*.depth.png`` may be missing.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationError

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Mounting, Zone
from graderd.hal.camera import ColorImage, DepthImage, EndOfFrames, Frame, Intrinsics, StreamPose
from graderd.hal.errors import DeviceMissingError, LifecycleError, ProtocolError
from graderd.hal.settings import CameraSettings
from graderd.perception.settings import CameraCalibration, StreamCalibration

MANIFEST = "manifest.csv"
CAMERA = "camera.json"
COLUMNS = ("id", "label", "blade_angle_deg", "vol_left_l", "vol_center_l", "vol_right_l")
ATTITUDE_COLUMNS = ("blade_height_mm", "blade_slope_deg", "blade_pitch_deg")
MAX_ROTATION_ERROR = 1e-3


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the manifest: litres are None where unknown, ``label`` None where there is none."""

    id: str
    label: Zone | None
    blade_angle_deg: float
    vol_left_l: float | None = None
    vol_center_l: float | None = None
    vol_right_l: float | None = None
    attitude: MeasuredAttitude = UNMEASURED
    extra: dict[str, str] = field(default_factory=dict)


def is_frame_set(folder: Path) -> bool:
    """Whether a path is a folder with a manifest."""
    return (folder / MANIFEST).is_file()


class FrameSet:
    """A frame set on disk, opened for reading: manifest and camera data are checked at once, pictures when asked for.

    Raises:
        DeviceMissingError: the folder, its manifest or its camera data are missing.
        ProtocolError: something in them is wrong; the message names file and line.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not folder.is_dir():
            raise DeviceMissingError(str(folder), "no such folder")
        self.entries = _read_manifest(folder / MANIFEST)
        self.calibration, self.blade, self.has_depth = _read_camera(folder / CAMERA)

    def frame(self, entry: Entry, number: int = -1) -> Frame:
        """Load one frame; ``metadata["blade_angle_deg"]`` carries the manifest's angle."""
        color = self._color(entry)
        depth = self._depth(entry)
        lens = self.calibration.color.intrinsics()
        if (lens.width, lens.height) != (color.shape[1], color.shape[0]):
            raise ProtocolError(
                str(self.folder / f"{entry.id}.color.*"),
                f"is {color.shape[1]}x{color.shape[0]}, {CAMERA} says {lens.width}x{lens.height}",
            )
        lens_d = self.calibration.depth.intrinsics() if depth is not None else None
        if depth is not None and lens_d and (lens_d.width, lens_d.height) != (depth.shape[1], depth.shape[0]):
            raise ProtocolError(
                str(self.folder / f"{entry.id}.depth.png"),
                f"is {depth.shape[1]}x{depth.shape[0]}, {CAMERA} says {lens_d.width}x{lens_d.height}",
            )
        metadata = {"blade_angle_deg": entry.blade_angle_deg}
        depth_number = number if depth is not None else -1
        return Frame(color, depth, lens, lens_d, time.monotonic(), number, depth_number, entry.id, metadata)

    def frames(self) -> Iterator[tuple[Entry, Frame]]:
        """Every entry with its frame, in the manifest's order."""
        for number, entry in enumerate(self.entries, start=1):
            yield entry, self.frame(entry, number)

    def _color(self, entry: Entry) -> ColorImage:
        for suffix in ("png", "jpg", "jpeg"):
            path = self.folder / f"{entry.id}.color.{suffix}"
            if path.is_file():
                picture = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_COLOR)
                if picture is None:
                    raise ProtocolError(str(path), "not a readable picture")
                return np.asarray(picture, dtype=np.uint8)
        raise DeviceMissingError(str(self.folder / f"{entry.id}.color.png"), f"named in {MANIFEST}, but not there")

    def _depth(self, entry: Entry) -> DepthImage | None:
        path = self.folder / f"{entry.id}.depth.png"
        if not path.is_file():
            if self.has_depth:
                raise DeviceMissingError(str(path), f"{CAMERA} has a depth stream, but the picture is not there")
            return None
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.dtype != np.uint16 or picture.ndim != 2:
            raise ProtocolError(str(path), "not a 16-bit grey PNG", "Depth is millimetres along the optical axis")
        return np.asarray(picture, dtype=np.uint16)


def _read_manifest(path: Path) -> list[Entry]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error})") from error
    reader = csv.DictReader(text.splitlines())
    names = reader.fieldnames or []
    missing = [name for name in ("id", "blade_angle_deg") if name not in names]
    if missing:
        raise ProtocolError(f"{path}:1", f"column {', '.join(missing)} is missing", f"It begins {','.join(COLUMNS)}")
    entries: list[Entry] = []
    seen: set[str] = set()
    for row in reader:
        where = f"{path}:{reader.line_num}"
        if None in row or None in row.values():
            raise ProtocolError(where, f"has another number of columns than the heading's {len(names)}")
        entries.append(_entry(row, where))
        if entries[-1].id in seen:
            raise ProtocolError(where, f"id {entries[-1].id} is there twice")
        seen.add(entries[-1].id)
    if not entries:
        raise ProtocolError(str(path), "lists no frames")
    return entries


def _entry(row: Mapping[str, str], where: str) -> Entry:
    name = row["id"].strip()
    if not name or "/" in name or name in (".", ".."):
        raise ProtocolError(where, f"id {name!r} is not a file name's beginning")
    label: Zone | None = None
    if text := (row.get("label") or "").strip().lower():
        try:
            label = Zone(text)
        except ValueError as error:
            raise ProtocolError(where, f"label {text!r}", f"One of {', '.join(Zone)}, or empty") from error
    angle = _number(row, "blade_angle_deg", where)
    if angle is None:
        raise ProtocolError(where, "blade_angle_deg is empty")
    left, center, right = (_number(row, column, where) for column in COLUMNS[3:])
    extra = {key: value for key, value in row.items() if key not in (*COLUMNS, *ATTITUDE_COLUMNS)}
    attitude = MeasuredAttitude(*(_number(row, column, where) for column in ATTITUDE_COLUMNS))
    return Entry(name, label, angle, left, center, right, attitude, extra)


def _number(row: Mapping[str, str], column: str, where: str) -> float | None:
    text = (row.get(column) or "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise ProtocolError(where, f"{column} is {text!r}, not a number") from error
    if not math.isfinite(value):
        raise ProtocolError(where, f"{column} is {text}, not a finite number")
    return value


def _read_camera(path: Path) -> tuple[CameraCalibration, BladeGeometry, bool]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        line = getattr(error, "lineno", 1)
        raise ProtocolError(f"{path}:{line}", f"not JSON ({error})") from error
    if not isinstance(data, dict) or "color" not in data:
        raise ProtocolError(str(path), "the block 'color' is missing")
    blocks = {name: _stream(data[name], f"{path} {name}") for name in ("color", "depth") if data.get(name)}
    mounting: Mounting = (
        "facing_blade_from_front" if blocks["color"][1].rotation[0][2] < 0 else "facing_blade_from_behind"
    )
    try:
        streams = {name: StreamCalibration.from_pose(lens, pose, mounting) for name, (lens, pose) in blocks.items()}
    except (ValidationError, OverflowError, ZeroDivisionError) as error:
        raise ProtocolError(str(path), f"describes no camera ({str(error).splitlines()[0]})") from error
    given = data.get("blade", {})
    if not isinstance(given, dict):
        raise ProtocolError(f"{path} blade", "is no block of keys and values")
    blade = {key: value for key, value in given.items() if key in BladeGeometry.model_fields}
    try:
        return CameraCalibration(mounting=mounting, **streams), BladeGeometry(**blade), "depth" in blocks
    except ValidationError as error:
        raise ProtocolError(f"{path} blade", error.errors()[0]["msg"]) from error


def _stream(block: dict[str, Any], where: str) -> tuple[Intrinsics, StreamPose]:
    try:
        coeffs = [float(value) for value in block.get("coeffs", [0, 0, 0, 0, 0])]
        lens = Intrinsics(
            int(block["width"]),
            int(block["height"]),
            float(block["fx"]),
            float(block["fy"]),
            float(block["cx"]),
            float(block["cy"]),
            (coeffs[0], coeffs[1], coeffs[2], coeffs[3], coeffs[4]),
        )
        rows = [[float(value) for value in row] for row in block["rotation_vehicle_from_optical"]]
        x, y, z = (float(value) for value in block["position_m"])
        scale_m = float(block.get("scale_m", 0.001))
    except KeyError as error:
        raise ProtocolError(where, f"{error.args[0]} is missing") from error
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise ProtocolError(where, f"not as documented ({error})") from error
    if scale_m != 0.001:
        raise ProtocolError(where, "scale_m is not 0.001", "Depth pictures of a frame set are millimetres")
    square = [len(row) for row in rows] == [3, 3, 3] and bool(np.isfinite(rows).all())
    rotation = np.asarray(rows if square else np.zeros((3, 3)))
    is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() < MAX_ROTATION_ERROR
    if not is_rotation or np.linalg.det(rotation) < 0:
        raise ProtocolError(where, "rotation_vehicle_from_optical is not a rotation matrix (3 rows of 3)")
    triple = tuple((row[0], row[1], row[2]) for row in rows)
    return lens, StreamPose((x, y, z), (triple[0], triple[1], triple[2]))


def camera_json(calibration: CameraCalibration, blade: BladeGeometry, with_depth: bool = True) -> dict[str, Any]:
    """The content of ``camera.json`` for a calibration."""
    blocks: dict[str, Any] = {}
    for name in ("color", "depth") if with_depth else ("color",):
        stream: StreamCalibration = getattr(calibration, name)
        pose = stream.pose(calibration.mounting)
        blocks[name] = {
            "width": stream.width_px,
            "height": stream.height_px,
            "fx": stream.fx_px,
            "fy": stream.fy_px,
            "cx": stream.cx_px,
            "cy": stream.cy_px,
            "coeffs": list(stream.distortion_n),
            "position_m": list(pose.position_m),
            "rotation_vehicle_from_optical": [list(row) for row in pose.rotation],
        }
    if with_depth:
        blocks["depth"]["scale_m"] = 0.001
    return {**blocks, "blade": blade.model_dump()}


def with_lens_of(frame: Frame, calibration: CameraCalibration) -> CameraCalibration:
    """The calibration's poses with the lens data the frame came with, where it has them."""

    def lens(stream: StreamCalibration, told: Intrinsics | None) -> StreamCalibration:
        if told is None:
            return stream
        changes = {
            "width_px": told.width,
            "height_px": told.height,
            "fx_px": told.fx,
            "fy_px": told.fy,
            "cx_px": told.cx,
            "cy_px": told.cy,
            "distortion_n": told.coeffs,
        }
        return stream.model_copy(update=changes)

    changes = {
        "color": lens(calibration.color, frame.color_intrinsics),
        "depth": lens(calibration.depth, frame.depth_intrinsics),
    }
    return calibration.model_copy(update=changes)


class FrameSetWriter:
    """Writes a frame set as the frames come: a stopped run leaves a valid set behind."""

    def __init__(
        self,
        folder: Path,
        calibration: CameraCalibration,
        blade: BladeGeometry,
        extra_columns: tuple[str, ...] = (),
        *,
        with_depth: bool = True,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._extra = extra_columns
        self._camera = camera_json(calibration, blade, with_depth)
        (folder / CAMERA).write_text(json.dumps(self._camera, indent=1) + "\n", encoding="utf-8")
        with (folder / MANIFEST).open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow((*COLUMNS, *ATTITUDE_COLUMNS, *extra_columns))

    def add(self, entry: Entry, frame: Frame) -> None:
        """Write one frame's pictures (PNG) and its line."""
        cv2.imwrite(str(self._folder / f"{entry.id}.color.png"), frame.color_bgr)
        if frame.depth_mm is not None:
            cv2.imwrite(str(self._folder / f"{entry.id}.depth.png"), frame.depth_mm)
        volumes = (entry.vol_left_l, entry.vol_center_l, entry.vol_right_l)
        row = [entry.id, entry.label or "", f"{entry.blade_angle_deg:.3f}"]
        row += ["" if volume is None else f"{volume:.3f}" for volume in volumes]
        attitude = (entry.attitude.height_mm, entry.attitude.slope_deg, entry.attitude.pitch_deg)
        row += ["" if value is None else f"{value:.2f}" for value in attitude]
        row += [entry.extra.get(column, "") for column in self._extra]
        with (self._folder / MANIFEST).open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow(row)


def write_label(folder: Path, id_: str, label: Zone | None) -> None:
    """Put a frame's label into the manifest, or take it away; everything else in it stays. Whole or not at all.

    Raises:
        OSError: it cannot be written.
        KeyError: no frame of that id.
    """
    path = folder / MANIFEST
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.DictReader(file)
        names, lines = list(reader.fieldnames or ()), list(reader)
    if "label" not in names:
        names.insert(1, "label")
    by_id = {line["id"].strip(): line for line in lines}
    by_id[id_]["label"] = label or ""
    new = path.with_suffix(".new")
    with new.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(lines)
    new.replace(path)


class FrameSetCamera:
    """A frame set as a camera: each frame once (or over and over), paced at ``rate_hz`` or as fast as read."""

    def __init__(self, settings: CameraSettings, real_time: bool = True) -> None:
        self._path = Path(settings.path)
        self._repeat = settings.repeat
        self._period_s = 1.0 / settings.rate_hz if real_time else 0.0
        self._due_s = 0.0
        self._frames: Iterator[tuple[Entry, Frame]] | None = None
        self.set: FrameSet | None = None
        self.entry: Entry | None = None

    @property
    def description(self) -> str:
        """The path."""
        return f"frame set {self._path}"

    def open(self) -> None:
        """Check manifest and camera data."""
        self.set = FrameSet(self._path)
        self._frames = self.set.frames()
        self._due_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:  # noqa: ARG002  (the contract's; a file is always there)
        """The next frame; ``entry`` is its line of the manifest.

        Raises:
            EndOfFrames: there is no further one.
            DeviceMissingError, ProtocolError: a file of the set is missing or damaged.
            LifecycleError: not open.
        """
        if self._frames is None or self.set is None:
            raise LifecycleError(str(self._path), "the frame set is not open")
        pair = next(self._frames, None)
        if pair is None and self._repeat:
            self._frames = self.set.frames()
            pair = next(self._frames, None)
        if pair is None:
            raise EndOfFrames(str(self._path))
        wait_s = self._due_s - time.monotonic()
        if wait_s > 0:
            time.sleep(wait_s)
        self._due_s = max(self._due_s + self._period_s, time.monotonic())
        self.entry, frame = pair
        return frame

    def settings_read_back(self) -> dict[str, float]:
        """Nothing can be set on files."""
        return {}

    def reset_hardware(self) -> None:
        """No effect."""

    def close(self) -> None:
        """Let go; idempotent."""
        self._frames = None
