"""Depth as files: ``.npy`` and 16-bit PNG with a camera file beside them, recordings with raw frames (``.mcap``), point
clouds as ``.ply`` and ``.las``."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from graderd.evaluation.bed import Points
from graderd.evaluation.ground import F64
from graderd.hal.camera import Intrinsics, StreamPose
from graderd.hal.errors import DeviceMissingError, ProtocolError
from graderd.perception.geometry import View
from graderd.record.export import gaps_of, raw_frames
from graderd.record.reader import Recording

CAMERA = "camera.json"
PICTURES = (".npy", ".png")
CLOUDS = (".ply", ".las")
RECORDING = ".mcap"
EXTRA = "Install graderd[evaluation]"
_EXPORTED = "Write out what is whole with graderd record export, and name the depth pictures that are meant"

Edge = Literal["up", "down", "left", "right"]
"""An edge of the picture: where forward is."""
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]

_OF_EDGE = {"up": (0.0, -1.0, 0.0), "down": (0.0, 1.0, 0.0), "left": (-1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0)}


class Lens(BaseModel):
    """The block ``depth`` of a frame set's ``camera.json``; its pose is not needed, the ground is found."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    width: Annotated[int, Field(gt=0, le=10_000)]
    height: Annotated[int, Field(gt=0, le=10_000)]
    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float
    coeffs: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    scale_m: Annotated[float, Field(gt=0, le=1)] = 0.001
    """Metres that one step of an integer picture stands for."""

    def rays(self) -> F64:
        """Optical directions of all pixels, scaled to Z = 1: height x width x 3."""
        lens = Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.coeffs)
        own = StreamPose((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        return View(lens, own).rays().astype(np.float64)


def find(folder: Path, pattern: str, where: str) -> list[Path]:
    """The files that a name or pattern stands for, in the order of the numbers in their names.

    Raises:
        DeviceMissingError: there is none.
        ProtocolError: no pattern, or one that leads out of every folder.
    """
    given = Path(pattern)
    try:
        base, name = (
            (Path(given.anchor), str(given.relative_to(given.anchor))) if given.is_absolute() else (folder, pattern)
        )
        found = [path for path in base.glob(name) if path.is_file()]
    # pathlib's words on what names no file: "/", ".", an absolute pattern
    except (ValueError, LookupError, NotImplementedError, OSError) as error:
        raise ProtocolError(where, f"{pattern!r} is no name or pattern of files ({error})") from None
    if not found:
        raise DeviceMissingError(
            where, f"no file is named {pattern!r} in {folder}", "Names count from the experiment file"
        )
    return sorted(
        found, key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", str(path))]
    )


Span = tuple[float, float]
"""Seconds after a recording's first raw frame: from, to."""


def span_of(name: str, where: str) -> tuple[str, Span | None]:
    """A name, and the part of a recording that ``NAME@FROM..TO`` stands for; None: all of it.

    Raises:
        ProtocolError: what follows the @ is no span.
    """
    pattern, at, text = name.rpartition("@")
    if not at or not pattern.endswith(RECORDING):
        return name, None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\.\.(\d+(?:\.\d+)?)", text)
    if match is None or float(match[1]) >= float(match[2]):
        raise ProtocolError(
            where, f"{text!r} is no part of a recording", "Seconds after its first picture: name.mcap@3..4.5"
        )
    return pattern, (float(match[1]), float(match[2]))


class Reader:
    """Reads scans; lens and rays are read once for each camera file."""

    def __init__(self, camera: Path | None, travel: Edge, cloud_up: Axis, cloud_travel: Axis) -> None:
        self._camera = camera
        self._picture = (np.array((0.0, 0.0, -1.0)), np.array(_OF_EDGE[travel]))
        self._cloud = (_axis(cloud_up), _axis(cloud_travel))
        self._lenses: dict[Path, tuple[Lens, F64]] = {}
        self._recorded_rays: dict[Lens, F64] = {}

    def scans(self, path: Path, span: Span | None = None) -> list[Points]:
        """The scans in one file: one, or as many as a three-dimensional ``.npy`` or a recording holds; ``span``: of a
        recording.

        Raises:
            DeviceMissingError, ProtocolError: it cannot be read; the message says why.
        """
        suffix = path.suffix.lower()
        if suffix in CLOUDS:
            points_m = _ply(path) if suffix == ".ply" else _las(path)
            known = np.isfinite(points_m).all(axis=1)
            if not known.any():
                raise ProtocolError(str(path), "holds no points")
            return [Points(points_m[known] * 1000.0, *self._cloud)]
        if suffix == RECORDING:
            return self._recorded(path, span)
        if suffix not in PICTURES:
            readable = ", ".join((*PICTURES, RECORDING, *CLOUDS))
            raise ProtocolError(str(path), f"{suffix or 'no suffix'} is none of {readable}")
        lens, rays = self._lens(self._camera or path.parent / CAMERA, path)
        return [self._back_projected(path, depth, lens, rays) for depth in _pictures(path)]

    def _recorded(self, path: Path, span: Span | None) -> list[Points]:
        """The depth pictures among a recording's raw frames, by the lens that each came with."""
        found: list[Points] = []
        first_s: float | None = None
        recording = Recording(path)
        for gap in gaps_of(recording):
            raise ProtocolError(str(path), str(gap), _EXPORTED)
        for message, judged in raw_frames(recording):
            frame = judged.frame
            first_s = frame.capture_s if first_s is None else first_s
            if span is not None and not span[0] <= frame.capture_s - first_s <= span[1]:
                continue
            if frame.depth_mm is None or frame.depth_intrinsics is None:
                continue
            told = frame.depth_intrinsics
            try:
                lens = Lens(**{name: getattr(told, name) for name in Lens.model_fields if hasattr(told, name)})
            except ValidationError as error:
                recording.refuse(message, error)
                continue
            if lens not in self._recorded_rays:
                self._recorded_rays[lens] = lens.rays()
            try:
                found.append(self._back_projected(path, frame.depth_mm, lens, self._recorded_rays[lens]))
            except ProtocolError as error:
                recording.refuse(message, ValueError(error.cause))
        for each in recording.unreadable:
            raise ProtocolError(str(path), str(each), _EXPORTED)
        if not found:
            which = "" if span is None else f" from {span[0]:g} to {span[1]:g} s"
            raise ProtocolError(str(path), f"holds no raw depth{which}", "Record with graderd record start --raw full")
        return found

    def _back_projected(self, path: Path, depth: Any, lens: Lens, rays: F64) -> Points:
        if depth.shape != (lens.height, lens.width):
            size = f"{depth.shape[1]}x{depth.shape[0]}"
            raise ProtocolError(str(path), f"is {size}, its camera file says {lens.width}x{lens.height}")
        unit_mm = lens.scale_m * 1000.0 if np.issubdtype(depth.dtype, np.integer) else 1000.0
        z = depth.astype(np.float64) * unit_mm
        seen = np.isfinite(z) & (z > 0.0)
        if not seen.any():
            raise ProtocolError(str(path), "no pixel has depth")
        return Points(rays[seen] * z[seen, None], *self._picture)

    def _lens(self, camera: Path, picture: Path) -> tuple[Lens, F64]:
        if camera not in self._lenses:
            try:
                data = json.loads(camera.read_text(encoding="utf-8"))
            except FileNotFoundError:
                remedy = "Put the frame set's camera.json beside it, or name it in the experiment file (camera)"
                raise DeviceMissingError(
                    str(camera), f"the camera file of {picture.name} is not there", remedy
                ) from None
            except (OSError, ValueError, RecursionError) as error:
                raise ProtocolError(str(camera), f"cannot be read as JSON ({error})") from None
            if not isinstance(data, dict) or not isinstance(data.get("depth"), dict):
                raise ProtocolError(str(camera), "the block 'depth' is missing", "It is a frame set's camera.json")
            try:
                lens = Lens.model_validate(data["depth"])
            except ValidationError as error:
                first = error.errors()[0]
                raise ProtocolError(str(camera), f"depth.{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
            self._lenses[camera] = lens, lens.rays()
        return self._lenses[camera]


def _axis(name: str) -> F64:
    return np.asarray(np.eye(3)["xyz".index(name[1])] * (1.0 if name[0] == "+" else -1.0), dtype=np.float64)


def _pictures(path: Path) -> list[Any]:
    """Depth pictures of a file: integers are the camera's steps, floats metres."""
    if path.suffix.lower() == ".png":
        picture = (
            cv2.imdecode(np.frombuffer(_bytes(path), dtype=np.uint8), cv2.IMREAD_UNCHANGED) if _bytes(path) else None
        )
        if picture is None or picture.dtype != np.uint16 or picture.ndim != 2:
            raise ProtocolError(str(path), "not a 16-bit grey PNG", "Depth is millimetres along the optical axis")
        return [picture]
    try:
        # Mapped, not read: a heading that promises more than there is asks for no memory.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from None
    except (ValueError, EOFError, SyntaxError) as error:
        raise ProtocolError(str(path), f"not a NumPy file of numbers ({error})") from None
    numbers = isinstance(array, np.ndarray) and (
        np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)
    )
    if not numbers or array.ndim not in (2, 3) or 0 in array.shape:
        remedy = (
            "Rows and columns of depth, or a stack of such pictures: integers in steps of scale_m, floats in metres"
        )
        raise ProtocolError(str(path), "holds no depth picture", remedy)
    return list(array) if array.ndim == 3 else [array]


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from None


def _ply(path: Path) -> F64:
    try:
        import plyfile
    except ImportError:
        raise DeviceMissingError(str(path), "reading .ply needs the package plyfile", EXTRA) from None
    try:
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        return np.column_stack([np.asarray(vertex[axis], dtype=np.float64) for axis in "xyz"])
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from None
    except (plyfile.PlyParseError, KeyError, ValueError, IndexError, MemoryError) as error:
        raise ProtocolError(str(path), f"not a PLY file with vertices x, y, z ({error})") from None


def _las(path: Path) -> F64:
    try:
        import laspy
    except ImportError:
        raise DeviceMissingError(str(path), "reading .las needs the package laspy", EXTRA) from None
    try:
        return np.asarray(laspy.read(str(path)).xyz, dtype=np.float64)
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from None
    except Exception as error:  # laspy lets struct, value and lookup errors of a broken file through
        raise ProtocolError(str(path), f"not a readable LAS file ({error or type(error).__name__})") from None
