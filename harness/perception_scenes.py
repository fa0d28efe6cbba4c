"""Small synthetic views of soil before the blade, ray-cast from a height field: truth is known to the litre.

Independent of the rig's renderer on purpose: perception is tested against two pictures of the world.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry, blade_coordinates
from graderd.core.soil import Zone
from graderd.hal.camera import Frame
from graderd.perception.geometry import View, face_setback_m
from graderd.perception.settings import CameraCalibration, StreamCalibration

F64 = npt.NDArray[np.float64]

CELL_M = 0.01
X0, X1, Y0, Y1 = -2.2, 1.2, -1.5, 1.5

ON_GROUND = MeasuredAttitude(2.0, 0.0, 0.0)
"""What the lifts and the tilt measure while the edge drags."""


@dataclass(frozen=True)
class PoseError:
    """How far the camera really is from its calibrated place: metres and degrees."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    roll_deg: float = 0.0


@dataclass
class Scene:
    """One scene; ``zone`` says where the pile is, ``angle_deg`` how the blade stands."""

    zone: Zone = Zone.NONE
    angle_deg: float = 0.0
    seed: int = 0
    pose: PoseError = field(default_factory=PoseError)
    height_m: float = 0.18
    soil_bgr: tuple[int, int, int] = (45, 75, 110)
    ground_bgr: tuple[int, int, int] = (130, 135, 130)
    blade_bgr: tuple[int, int, int] = (150, 140, 130)
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise_px: float = 0.08
    holes: float = 0.04
    blade: BladeGeometry = field(default_factory=BladeGeometry)
    ground: Callable[[F64, F64], F64] | None = None
    """Height of the bare ground at x and y (m); None: level."""


def moved(stream: StreamCalibration, error: PoseError) -> StreamCalibration:
    return stream.model_copy(
        update={
            "position_x_m": stream.position_x_m + error.x_m,
            "position_y_m": stream.position_y_m + error.y_m,
            "position_z_m": stream.position_z_m + error.z_m,
            "pitch_down_deg": stream.pitch_down_deg + error.pitch_deg,
            "yaw_deg": stream.yaw_deg + error.yaw_deg,
            "roll_deg": stream.roll_deg + error.roll_deg,
        }
    )


def height_field(scene: Scene) -> F64:
    """Soil heights (rows: x, columns: y), metres."""
    rng = np.random.default_rng(scene.seed)
    x = np.arange(X0, X1, CELL_M) + CELL_M / 2
    y = np.arange(Y0, Y1, CELL_M) + CELL_M / 2
    gx, gy = np.meshgrid(x, y, indexing="ij")
    s, d = blade_coordinates(gx, gy, scene.angle_deg)
    height = np.zeros_like(gx)
    slope = np.tan(np.radians(33))

    def ridge(s_mid: float, half_width: float, top: float) -> F64:
        aside = np.maximum(np.abs(s - s_mid) - half_width, 0.0)
        ahead = np.maximum(0.02 - d, 0.0) * 8 + np.maximum(d - 0.18, 0.0)
        return np.asarray(np.maximum(top - slope * np.hypot(aside, ahead), 0.0), dtype=np.float64)

    centres = {Zone.LEFT: 0.36, Zone.CENTER: 0.0, Zone.RIGHT: -0.36}
    if scene.zone in centres:
        height = ridge(centres[scene.zone] + rng.uniform(-0.03, 0.03), 0.06, scene.height_m)
    elif scene.zone is Zone.EVEN:
        height = ridge(0.0, 0.55, 0.6 * scene.height_m)
    rough = cv2.GaussianBlur(rng.normal(size=height.shape), (0, 0), 3) * 0.03
    height = np.where(height > 0.005, np.maximum(height + rough * 0.5, 0), rough * 0.1)
    if scene.ground is not None:
        height += scene.ground(gx, gy)
    return np.asarray(height, dtype=np.float64)


def volumes_l(scene: Scene, heights: F64) -> tuple[float, float, float]:
    """True litres (left, center, right) before the blade to its reach."""
    x = np.arange(X0, X1, CELL_M) + CELL_M / 2
    y = np.arange(Y0, Y1, CELL_M) + CELL_M / 2
    gx, gy = np.meshgrid(x, y, indexing="ij")
    s, d = blade_coordinates(gx, gy, scene.angle_deg)
    inside = (d > 0) & (d < scene.blade.reach_m)
    third = scene.blade.length_m / 6
    soil = np.where(inside & (heights > 0.01), heights, 0.0) * CELL_M**2 * 1000
    half = scene.blade.length_m / 2
    return (
        float(soil[(s > third) & (s < half)].sum()),
        float(soil[np.abs(s) <= third].sum()),
        float(soil[(s < -third) & (s > -half)].sum()),
    )


def _cast(view: View, scene: Scene, heights: F64) -> tuple[F64, npt.NDArray[np.int8], F64, F64]:
    """Depth (m, along the axis), what was hit (0 nothing, 1 ground, 2 soil, 3 blade), and where (x, y)."""
    rays = view.rays().reshape(-1, 3).astype(np.float64)
    origin = view.position_m
    kind = np.zeros(len(rays), dtype=np.int8)
    hit_t = _march(rays, origin, heights)
    at = origin + rays * np.where(np.isfinite(hit_t), hit_t, 0.0)[:, None]
    kind[np.isfinite(hit_t)] = 1
    kind[np.isfinite(hit_t) & (_sample(heights, at[:, 0], at[:, 1]) > 0.008)] = 2
    # The hollow face: a few steps of fixed-point iteration on d = -setback(z).
    angle = np.radians(scene.angle_deg)
    s0, d0 = blade_coordinates(origin[0:1], origin[1:2], scene.angle_deg)
    d_ray = rays[:, 0] * np.cos(angle) + rays[:, 1] * np.sin(angle)
    s_ray = -rays[:, 0] * np.sin(angle) + rays[:, 1] * np.cos(angle)
    with np.errstate(all="ignore"):
        t = -d0[0] / d_ray
        for _ in range(6):
            z = origin[2] + t * rays[:, 2]
            t = (-face_setback_m(scene.blade, z) - d0[0]) / d_ray
        z = origin[2] + t * rays[:, 2]
        s = s0[0] + t * s_ray
        on_blade = (t > 0.1) & (np.abs(s) < scene.blade.length_m / 2)
        on_blade &= (z > scene.blade.bottom_z_m) & (z < scene.blade.bottom_z_m + scene.blade.height_m)
        nearer = on_blade & (t < hit_t)
    hit_t[nearer], kind[nearer] = t[nearer], 3
    at = origin + rays * np.where(np.isfinite(hit_t), hit_t, 0.0)[:, None]
    return hit_t, kind, at[:, 0], at[:, 1]


def _march(rays: F64, origin: F64, heights: F64) -> F64:
    """How far along each ray soil or ground lies; inf: nowhere near. In steps, from where the ray comes below the
    highest soil; the one that went under is halved."""
    steps = np.arange(0.24, 3.4, 0.02)
    top_m = max(float(heights.max()), 0.0)  # beyond the field it is level
    with np.errstate(all="ignore"):
        enters = np.where(rays[:, 2] < 0.0, (top_m - origin[2]) / rays[:, 2], np.inf)
    # Those that enter first stand first: at each step the next ones join.
    order = np.argsort(enters, kind="stable")
    joined = np.searchsorted(enters[order], steps, side="left")
    ways = np.ascontiguousarray(rays[order].T)
    met_at = np.zeros(len(rays), dtype=np.intp)
    under_way = np.arange(0)
    for number, (t, before, now) in enumerate(zip(steps, (0, *joined), joined, strict=False)):
        under_way = np.concatenate((under_way, np.arange(before, now)))
        if under_way.size:
            x, y, z = (origin[axis] + ways[axis, under_way] * t for axis in range(3))
            under = z < _sample(heights, x, y)
            met_at[under_way[under]] = number + 1
            under_way = under_way[~under]
    met = np.flatnonzero(met_at)
    ways = ways[:, met]
    low, high = np.concatenate(((0.2,), steps))[met_at[met] - 1], steps[met_at[met] - 1]
    for _ in range(7):
        mid = (low + high) / 2
        x, y, z = (origin[axis] + ways[axis] * mid for axis in range(3))
        under = z < _sample(heights, x, y)
        low, high = np.where(under, low, mid), np.where(under, mid, high)
    hit_t = np.full(len(rays), np.inf)
    hit_t[order[met]] = (low + high) / 2
    return hit_t


def _sample(heights: F64, x: F64, y: F64) -> F64:
    i = ((x - X0) / CELL_M).astype(np.int64)
    j = ((y - Y0) / CELL_M).astype(np.int64)
    rows, columns = heights.shape
    inside = (i >= 0) & (j >= 0) & (i < rows) & (j < columns)
    cells = i * columns + j
    cells *= inside
    return np.asarray(heights.reshape(-1)[cells] * inside, dtype=np.float64)


def render(
    scene: Scene,
    calibration: CameraCalibration | None = None,
    color_size: tuple[int, int] = (320, 200),
    depth_size: tuple[int, int] = (424, 240),
    capture_s: float = 0.0,
    number: int = 1,
) -> Frame:
    """The frame a camera would take of the scene. ``*_size``: width, height."""
    calibration = calibration or CameraCalibration()
    rng = np.random.default_rng(scene.seed + 7 * number)
    heights = height_field(scene)
    depth_stream = moved(calibration.depth, scene.pose)
    lens_d = depth_stream.intrinsics().scaled(*depth_size)
    z, _, _, _ = _cast(View(lens_d, depth_stream.pose(calibration.mounting)), scene, heights)
    disparity = 95.0 * lens_d.fx / (z * 1000)
    # The noise is that of 848 pixels across; a smaller picture is the same measurement read out coarser.
    disparity += rng.normal(size=z.size) * scene.noise_px * lens_d.fx / 427.0
    with np.errstate(all="ignore"):
        depth = 95.0 * lens_d.fx / disparity
    depth[~np.isfinite(depth) | (depth < 340) | (depth > 1700)] = 0
    depth[rng.random(z.size) < scene.holes] = 0
    color_stream = moved(calibration.color, scene.pose)
    lens_c = color_stream.intrinsics().scaled(*color_size)
    color = _paint(View(lens_c, color_stream.pose(calibration.mounting)), scene, heights, rng)
    return Frame(
        color,
        np.round(depth).astype(np.uint16).reshape(lens_d.height, lens_d.width),
        lens_c,
        lens_d,
        capture_s,
        number,
        number,
        f"{scene.zone}-{scene.seed}",
    )


@cache
def _texture() -> F64:
    fine = np.random.default_rng(5).normal(size=(512, 512))
    return np.asarray(fine * 0.5 + cv2.GaussianBlur(fine, (0, 0), 2) * 2, dtype=np.float64)


def _paint(view: View, scene: Scene, heights: F64, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    _, kind, x, y = _cast(view, scene, heights)
    grain = _texture()[(x * 200).astype(int) % 512, (y * 200).astype(int) % 512]
    palette = np.array([(90, 80, 70), scene.ground_bgr, scene.soil_bgr, scene.blade_bgr], dtype=np.float64)
    strength = np.array([0.02, 0.10, 0.18, 0.03])[kind]
    picture = palette[kind] * (1 + strength * grain)[:, None] * np.asarray(scene.cast)
    picture += rng.normal(size=picture.shape) * 2.5
    flat = np.clip(picture, 0, 255).astype(np.uint8)
    return np.asarray(flat.reshape(view.lens.height, view.lens.width, 3), dtype=np.uint8)
