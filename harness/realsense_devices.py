"""A synthetic D455 through the SDK's own software device, and a recording made with the ordinary recorder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from graderd.drivers.realsense import sdk

Color = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.uint16]


class SoftD455:
    """Two sensors of a software device with a D455's names and lenses; pictures are pushed by the test."""

    def __init__(self, color: tuple[int, int] = (320, 200), depth: tuple[int, int] | None = (212, 120)) -> None:
        rs = sdk.load()
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Intel RealSense D455")
        self.device.register_info(rs.camera_info.serial_number, "SYN0001")
        if depth is not None:
            self.depth_sensor = self.device.add_sensor("Stereo Module")
            self.depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
            focal = 427.675 * depth[0] / 848
            self.depth_profile = _stream(self.depth_sensor, rs.stream.depth, 1, depth, 2, rs.format.z16, focal)
        self.color_sensor = self.device.add_sensor("RGB Camera")
        focal = 629.085 * color[0] / 1280
        self.color_profile = _stream(self.color_sensor, rs.stream.color, 2, color, 3, rs.format.rgb8, focal)
        if depth is not None:
            pairs = ((self.depth_profile, self.color_profile, -0.059), (self.color_profile, self.depth_profile, 0.059))
            for one, other, shift in pairs:
                away = rs.extrinsics()
                away.rotation, away.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [shift, 0, 0]
                one.register_extrinsics_to(other, away)
            self.device.create_matcher(rs.matchers.dlr_c)

    def push_depth(self, picture: Depth, number: int, time_ms: float) -> None:
        """One depth picture, as the camera would send it."""
        _push(self.depth_sensor, self.depth_profile, picture, 2, number, time_ms)

    def push_color(self, picture_bgr: Color, number: int, time_ms: float) -> None:
        """One colour picture, as the camera would send it."""
        _push(self.color_sensor, self.color_profile, picture_bgr[..., ::-1], 3, number, time_ms)


def _stream(
    sensor: sdk.Rs, kind: sdk.Rs, uid: int, size: tuple[int, int], bpp: int, fmt: sdk.Rs, focal: float
) -> sdk.Rs:
    rs = sdk.load()
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy = size[0], size[1], focal, focal
    lens.ppx, lens.ppy = (size[0] - 1) / 2, (size[1] - 1) / 2
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0] * 5
    video = rs.video_stream()
    video.type, video.index, video.uid, video.width, video.height = kind, 0, uid, size[0], size[1]
    video.fps, video.bpp, video.fmt, video.intrinsics = 30, bpp, fmt, lens
    return sensor.add_video_stream(video, True)


def _push(
    sensor: sdk.Rs, profile: sdk.Rs, picture: npt.NDArray[np.generic], bpp: int, number: int, time_ms: float
) -> None:
    rs = sdk.load()
    frame = rs.software_video_frame()  # a new object for every frame: the SDK frees it
    frame.pixels = np.ascontiguousarray(picture)
    frame.bpp, frame.stride = bpp, picture.shape[1] * bpp
    frame.timestamp, frame.domain, frame.frame_number = time_ms, rs.timestamp_domain.hardware_clock, number
    frame.profile = profile.as_video_stream_profile()
    sensor.on_video_frame(frame)


def record(path: Path, frames: list[tuple[Color, Depth | None]], soft: SoftD455) -> None:
    """Record frames with librealsense's own recorder into a .db3."""
    rs = sdk.load()
    recorder = rs.recorder(str(path), soft.device)
    sensors = recorder.query_sensors()
    queue = rs.frame_queue(len(frames) * 2 + 2)
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number, (color, depth) in enumerate(frames, start=1):
        if depth is not None:
            soft.push_depth(depth, number, number * 33.333)
        soft.push_color(color, number, number * 33.333)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    recorder.pause()
