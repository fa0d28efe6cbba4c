"""Is this picture fit to be judged? Every check is cheap and names what it found; none of them guesses a zone.

Checks of one frame by itself: wrong resolution, black, blown out, blocked, blurred, torn, no depth. Checks that
remember the frame before: frozen, a resolution that changes in mid-stream. Whether the camera was knocked out of place
comes out of the registration (:mod:`graderd.perception.registration`) and is judged here.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry
from graderd.core.soil import PictureFault
from graderd.hal.camera import Frame
from graderd.hal.settings import CameraSettings
from graderd.perception.depth import HeightMap
from graderd.perception.geometry import F32, U8, Region
from graderd.perception.registration import Stance
from graderd.perception.settings import HealthSettings

SAMPLE_STEP_PX = (16, 12)
"""Rows and columns of the sample in which light is judged: a row costs a walk through memory, a pixel of it hardly
anything."""
SAME_STEP_PX = (48, 12)
"""The same for whether a picture is the one before: the sensors' noise is in every pixel."""
TILE_PX, FLAT_GRAY = 4, 1.6
"""Side of a tile of the smoothed sample, and the standard deviation in it (grey levels) below which it shows nothing:
the sensor's noise alone gives 0.5 to 1."""
STILL_FLAT_PERCENT = 99.0
"""A photograph may have its smooth sky or wall; only where hardly anything else is left is the lens covered."""
CLIPPED_GRAY = 250
"""Grey level from which a pixel shows no more than that it is bright: compression and noise keep some below 255."""
GRAY_PERCENT = 255 / 100
"""Grey levels of one per cent of full brightness."""
DEPTH_STEP_PX = 8
"""Every eighth pixel of every eighth row, 6,000 of them, tells the share that has depth to half a per cent."""
LAYER_MOST_M = 0.10
"""A layer of soil before a lifted blade is hardly thicker: it would fill the quarter-scale blade to 40 %."""
BLUR_WIDTH_PX = 1280
"""The picture that the distances of the blur's measure are meant for; a larger one is measured as coarsely."""
BLUR_ROWS_N = 9
"""Rows looked at: more hardly change the answer, and each costs a walk through memory."""
BLUR_APART_PX = (2, 4, 16)
"""Distances at which a row's contrast is compared: within a blur, about its size, and of what the picture shows."""
BLUR_MIN_CONTRAST = 64.0
"""Square grey levels of four summed pixels."""
BLUR_GROWTH = 0.1
"""Where contrast grows by less than this share from 4 to 16 pixels there is noise alone, and nothing to judge by."""
BLUR_RANK = 0.7
"""The sharper rows count: a picture is blurred where all of it is, and shade or an even floor has no detail."""


CHECK_EVERY_N = 10
"""At 30 frames a second, three times a second."""


class NowAndThen:
    """Looks now and then at what decides nothing by itself, a frame of :data:`CHECK_EVERY_N`."""

    def __init__(self) -> None:
        self._frame_n = 0
        self._faults: list[PictureFault] = []

    def check(self, judge: Callable[[], list[PictureFault]]) -> list[PictureFault]:
        """The faults that it found last; ``judge`` is called only when it is time to."""
        if self._frame_n % CHECK_EVERY_N == 0:
            self._faults = judge()
        self._frame_n += 1
        return list(self._faults)


class HealthMonitor:
    """Judges pictures one after the other; one instance per stream of frames."""

    def __init__(
        self, settings: HealthSettings, blade: BladeGeometry, live: bool, camera: CameraSettings | None = None
    ) -> None:
        self._blade = blade
        self._settings = settings
        self._asked = (camera.color_width_px, camera.color_height_px) if camera is not None else None
        self._live = live
        self._last_sample: bytes = b""
        self._last_size: tuple[int, ...] = ()
        self._same_n = 0
        self._light_watch = NowAndThen()
        self._blur_watch = NowAndThen()
        self._is_watched = False
        self.lit = True
        """Whether the newest colour picture shows enough to be judged as a picture."""

    def check(self, frame: Frame, needs_depth: bool, needs_color: bool) -> list[PictureFault]:
        """What is wrong with the picture as such, before anything is measured in it.

        Depth brings its own light: where colour is not needed, its darkness or glare is no fault, and light and blur
        of a live stream are looked at now and then.
        """
        faults = self._size(frame)
        image = frame.color_bgr
        self.lit, self._is_watched = True, self._live and not needs_color
        light = self._light_watch.check(lambda: self._light(image)) if self._is_watched else self._light(image)
        if not needs_color and light and light[0].condition in ("black", "blown_out"):
            self.lit, light = False, []
        faults += light
        faults += self._frozen(frame)
        faults += self._torn(frame)
        if needs_depth:
            faults += self._depth(frame)
        return faults

    def _size(self, frame: Frame) -> list[PictureFault]:
        height, width = frame.color_bgr.shape[:2]
        size: tuple[int, ...] = (width, height)
        if frame.depth_mm is not None:
            size += (frame.depth_mm.shape[1], frame.depth_mm.shape[0])
        changed = self._live and self._last_size and self._last_size[: len(size)] != size[: len(self._last_size)]
        if not changed:
            self._last_size = max(size, self._last_size, key=len)
        faults = []
        for what, lens, shape in (
            ("colour", frame.color_intrinsics, (width, height)),
            ("depth", frame.depth_intrinsics, size[2:]),
        ):
            if lens is not None and shape and (lens.width, lens.height) != shape:
                detail = f"{what} picture is {shape[0]}x{shape[1]}, its lens data are for {lens.width}x{lens.height}"
                faults.append(PictureFault("wrong_resolution", detail))
        if self._asked is not None and (width, height) != self._asked and not faults:
            detail = f"colour picture is {width}x{height}, {self._asked[0]}x{self._asked[1]} was asked for"
            faults.append(PictureFault("wrong_resolution", detail))
        if changed and not faults:
            before = "x".join(str(side) for side in self._last_size[:2])
            detail = f"colour picture is {width}x{height}, the stream began with {before}"
            faults.append(PictureFault("wrong_resolution", detail))
        return faults

    def _light(self, image_bgr: U8) -> list[PictureFault]:
        settings = self._settings
        sample = np.ascontiguousarray(image_bgr[:: SAMPLE_STEP_PX[0], :: SAMPLE_STEP_PX[1]])
        gray = cv2.cvtColor(sample, cv2.COLOR_BGR2GRAY)
        mean_percent = float(gray.mean()) / GRAY_PERCENT
        if mean_percent < settings.black_percent:
            return [
                PictureFault("black", f"mean brightness {mean_percent:.1f} %, at least {settings.black_percent:g} %")
            ]
        clipped = 100.0 * float((gray >= CLIPPED_GRAY).mean())
        if clipped > settings.blown_out_percent:
            return [PictureFault("blown_out", f"{clipped:.0f} % of the pixels are clipped")]
        flat = 100.0 * flat_share(np.asarray(gray, dtype=np.uint8))
        if flat > (
            settings.blocked_flat_percent if self._live else max(STILL_FLAT_PERCENT, settings.blocked_flat_percent)
        ):
            return [PictureFault("blocked", f"{flat:.0f} % of the picture shows no texture: something covers the lens")]
        return []

    def _frozen(self, frame: Frame) -> list[PictureFault]:
        if self._settings.frozen_frames_n == 0 or not self._live:
            return []
        sample = frame.color_bgr[:: SAME_STEP_PX[0], :: SAME_STEP_PX[1], 1].tobytes()
        if frame.depth_mm is not None:
            sample += frame.depth_mm[:: SAME_STEP_PX[0], :: SAME_STEP_PX[1]].tobytes()
        self._same_n = self._same_n + 1 if sample == self._last_sample else 0
        self._last_sample = sample
        if self._same_n >= self._settings.frozen_frames_n:
            return [PictureFault("frozen", f"the same picture {self._same_n + 1} times in a row")]
        return []

    def _torn(self, frame: Frame) -> list[PictureFault]:
        if frame.depth_mm is None:
            return []
        color_s, depth_s = frame.metadata.get("color_device_s"), frame.metadata.get("depth_device_s")
        if color_s is not None and depth_s is not None:
            apart_s = abs(color_s - depth_s)
            if apart_s > self._settings.torn_s:
                return [PictureFault("torn", f"colour and depth were taken {apart_s * 1000:.0f} ms apart")]
            return []
        if frame.color_number >= 0 and frame.depth_number >= 0 and frame.color_number != frame.depth_number:
            detail = f"colour is frame {frame.color_number}, depth is frame {frame.depth_number}"
            return [PictureFault("torn", detail)]
        return []

    def _depth(self, frame: Frame) -> list[PictureFault]:
        if frame.depth_mm is None:
            return [PictureFault("depth_missing", "the frame has no depth picture")]
        sample = np.ascontiguousarray(frame.depth_mm[::DEPTH_STEP_PX, ::DEPTH_STEP_PX])
        valid = 100.0 * float(np.count_nonzero(sample)) / sample.size
        if valid < self._settings.depth_valid_percent:
            return [PictureFault("depth_missing", f"only {valid:.0f} % of the picture has depth")]
        return []

    def blurred(self, image_bgr: U8, region: Region) -> list[PictureFault]:
        """Fine against coarse contrast on rows of the blade's region: a blurred picture has only coarse contrast.

        To be asked after :meth:`check`.
        """
        if self._is_watched:
            return self._blur_watch.check(lambda: self._blurred(image_bgr, region))
        return self._blurred(image_bgr, region)

    def _blurred(self, image_bgr: U8, region: Region) -> list[PictureFault]:
        ratio = sharpness_ratio(image_bgr, region)
        if ratio < self._settings.blurred_ratio:
            detail = f"fine contrast is {ratio:.2f} of the coarse, at least {self._settings.blurred_ratio:.2f}"
            return [PictureFault("blurred", detail)]
        return []

    def misplaced(self, soil: HeightMap, stance: Stance) -> list[PictureFault]:
        """Whether the camera was moved, or the blade is not where its measured angle and lifts say.

        The camera was moved where blade and ground moved together, or where the blade's axis, which cannot move, did. A
        ground that tilts under a blade in its place is a slope; a blade that is turned about its axis, or higher than
        its lifts say over ground in its place, or on another slope, is a blade that moved.
        """
        settings, fix, ground = self._settings, soil.blade, soil.ground
        axis_m = math.hypot(fix.ahead_m, fix.along_m)
        moved: list[str] = []
        elsewhere: list[str] = []
        if max(abs(fix.ahead_m), abs(fix.along_m)) > settings.knocked_mm / 1000:
            moved.append(f"blade {fix.ahead_m * 1000:+.0f} mm ahead, {fix.along_m * 1000:+.0f} mm along")
        if abs(fix.turn_deg) > settings.knocked_deg:
            turned = f"blade turned by {fix.turn_deg:+.1f} deg"
            (moved if axis_m > settings.knocked_axis_mm / 1000 else elsewhere).append(turned)
        if fix.missing * 100 > settings.knocked_missing_percent:
            moved.append(f"{fix.missing * 100:.0f} % of the blade is not where it should be")
        offset_m = ground.offset_m
        level = abs(offset_m) < settings.knocked_ground_mm / 1000 and ground.slope_deg() < settings.knocked_ground_deg
        if soil.edge is None:
            # A level layer of soil looks like ground that is higher; see LAYER_MOST_M for how thick one may be.
            layer = 0.0 < offset_m < LAYER_MOST_M and ground.slope_deg() < settings.knocked_ground_deg
            if abs(offset_m) > settings.knocked_ground_mm / 1000 and not layer:
                moved.append(f"ground {offset_m * 1000:+.0f} mm off")
        else:
            up_m = soil.edge.height_m - stance.edge_m(self._blade) - stance.tall_m(self._blade)
            tilted_deg = math.degrees(soil.edge.rise - stance.rise)
            said = f"edge {up_m * 1000:+.0f} mm up, tilted by {tilted_deg:+.1f} deg"
            off = abs(up_m) > settings.knocked_ground_mm / 1000 or abs(tilted_deg) > settings.knocked_deg / 2
            if not level and off and abs(offset_m - up_m) < settings.knocked_axis_mm / 1000:
                moved.append(f"{said}, and the ground with it (tilted by {ground.slope_deg():.1f} deg)")
            elif stance.attitude.height_mm is not None and abs(up_m) > settings.knocked_mm / 1000:
                elsewhere.append(said)
            elif stance.attitude.slope_deg is not None:
                # Lifts with their sides swapped tell the slope with the wrong sign. A camera that rolled a little tilts
                # the ground as well, so the edge has to be off against that, too.
                turn = math.radians(stance.angle_deg)
                floor_deg = math.degrees(ground.slope_y * math.cos(turn) - ground.slope_x * math.sin(turn))
                if min(abs(tilted_deg), abs(tilted_deg - floor_deg)) > settings.knocked_ground_deg:
                    elsewhere.append(f"{said} (are the lifts' sides swapped?)")
        if moved:
            return [PictureFault("knocked", ", ".join(moved) + " against the calibration")]
        if elsewhere:
            return [PictureFault("blade_elsewhere", ", ".join(elsewhere) + " against what is measured")]
        return []


def flat_share(gray: U8) -> float:
    """Share of tiles in which the smoothed picture hardly varies."""
    smooth = cv2.blur(gray, (3, 3)).astype(np.float32)
    rows, columns = (side // TILE_PX for side in smooth.shape)
    if rows == 0 or columns == 0:
        return 0.0
    whole = smooth[: rows * TILE_PX, : columns * TILE_PX]
    mean = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    square = cv2.resize(whole * whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return float((square - mean * mean < FLAT_GRAY**2).mean())


def sharpness_ratio(image_bgr: U8, region: Region) -> float:
    """How much of the contrast along a row comes within a few pixels: 0.05 for a ramp, 0.15 to 0.8 for a sharp picture.

    With E(k) the mean square difference of pixels k apart, it is (E(4) - E(2)) / (E(16) - E(4)): the sensor's noise
    adds the same to every E and falls out. Green channel, sums of four rows, sampled over the region; the sharper rows
    count (their 70th percentile), because a picture is blurred where all of it is. Distances are those of a picture
    1280 across; larger ones are measured as coarsely. 1 where there is no contrast to judge by.
    """
    unit = max(1, round(image_bgr.shape[1] / BLUR_WIDTH_PX))
    band = image_bgr[region.rows, region.columns, 1]
    step = max(4, band.shape[0] // BLUR_ROWS_N)
    usable = band.shape[0] // step * step
    if usable == 0 or band.shape[1] < 2 * BLUR_APART_PX[-1] * unit:
        return 1.0
    lines = band[:usable:step].astype(np.float32)
    for row in range(1, 4):
        lines += band[row:usable:step]
    two, four, sixteen = (_square_difference(lines, distance * unit) for distance in BLUR_APART_PX)
    textured = sixteen - four > np.maximum(BLUR_MIN_CONTRAST, BLUR_GROWTH * four)
    if not textured.any():
        return 1.0
    ratios = np.sort((four - two)[textured] / (sixteen - four)[textured])
    return float(ratios[int(ratios.size * BLUR_RANK)])


def _square_difference(lines: F32, distance: int) -> F32:
    """Mean square difference of pixels ``distance`` apart, per row."""
    difference = lines[:, distance:] - lines[:, :-distance]
    return np.asarray(np.einsum("ij,ij->i", difference, difference) / difference.shape[1], dtype=np.float32)


def obstructed(soil: HeightMap) -> list[PictureFault]:
    """Whether something stands upright before the face, as a person's leg does and no soil."""
    if soil.standing_at_m is None:
        return []
    s, d = soil.standing_at_m
    side = "left" if s > 0 else "right"
    detail = f"something stands {d * 100:.0f} cm ahead of the blade, {abs(s) * 100:.0f} cm {side} of its middle"
    return [PictureFault("obstructed", detail)]
