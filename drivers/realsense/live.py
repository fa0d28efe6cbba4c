"""A RealSense camera on USB, its colour and depth sensors opened apart.

Apart, because the ordinary pipeline with its matcher delivers nothing at all once one stream stops: a depth stall would
blind the colour rule, and silently. Here colour goes on without depth, and says so. ``pipeline.start()`` without a
camera blocks for 15 s holding the interpreter lock; devices are asked for first, which takes a millisecond.

Frames of the two sensors are paired by device time; pictures are stamped with the monotonic time of arrival, because
the device's clock may jump.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from graderd.drivers.realsense import sdk
from graderd.hal.camera import Frame, Intrinsics
from graderd.hal.errors import DeviceLostError, DeviceMissingError, DeviceTimeoutError, LifecycleError, WrongDeviceError
from graderd.hal.settings import DEPTH_PRESETS, CameraSettings

QUEUE_N = 2
KEPT_DEPTH_N = 4
POLL_S = 0.005
DEPTH_GRACE_PERIODS = 3.0
"""Colour waits so many frame periods for its depth before it goes on alone."""
RESET_WAIT_S = 10.0
EXPOSURE_UNIT_US = 100.0
"""UVC counts the colour sensor's exposure in steps of 100 microseconds (UVC 1.5, 4.2.2.1.4); the depth sensor's is in
single ones."""
Options = list[tuple[sdk.Rs, float | None]]
"""Options in the order in which they are set; None is left as it is."""


def attached() -> list[sdk.Rs]:
    """The RealSense devices on USB now; an empty list where there are none."""
    return list(sdk.load().context().query_devices())


@dataclass(slots=True)
class _Stream:
    sensor: sdk.Rs
    queue: sdk.Rs
    lens: Intrinsics


@dataclass(frozen=True, slots=True)
class _Arrived:
    frame: sdk.Rs
    at_s: float
    device_s: float


class RealSenseCamera:
    """A live camera. ``devices`` lists what is attached (a test hands in a software device)."""

    def __init__(self, settings: CameraSettings, devices: Callable[[], list[sdk.Rs]] = attached) -> None:
        self._settings = settings
        self._devices = devices
        self._device: sdk.Rs = None
        self._color: _Stream | None = None
        self._depth: _Stream | None = None
        self._depths: deque[_Arrived] = deque(maxlen=KEPT_DEPTH_N)
        self._last_depth_s = 0.0
        self._description = f"RealSense {settings.serial_number}".strip()
        self._firmware = ""

    @property
    def description(self) -> str:
        """Model, serial number and firmware, once open."""
        return f"{self._description}{self._firmware}"

    def open(self) -> None:
        """Find the camera, set what the settings say of both sensors, open colour and depth.

        Raises:
            DeviceMissingError: no camera, or not the one with this serial number.
            WrongDeviceError: it does not offer the streams asked for.
        """
        if self._device is not None:
            raise LifecycleError(self._description, "the camera is open already")
        rs, settings = sdk.load(), self._settings
        device = self._find()
        color = _find_profile(
            device, rs.stream.color, settings.color_width_px, settings.color_height_px, settings.rate_hz
        )
        depth = None
        if settings.depth_width_px and settings.depth_height_px:
            depth = _find_profile(
                device, rs.stream.depth, settings.depth_width_px, settings.depth_height_px, settings.rate_hz
            )
        self._device = device
        self._description = _describe(device)
        self._firmware = _firmware(device)
        try:
            _set_options(color[0], self._color_options())
            if depth is not None:
                _set_options(depth[0], self._depth_options())
            self._color = _start(*color)
            self._depth = _start(*depth) if depth is not None else None
        except RuntimeError as error:
            self.close()
            raise WrongDeviceError(
                self._description, f"streams do not start ({error})", "Replug it; use a USB 3 port and cable"
            ) from error
        self._last_depth_s = time.monotonic()

    def _find(self) -> sdk.Rs:
        rs, wanted = sdk.load(), self._settings.serial_number
        found = self._devices()
        serials = [device.get_info(rs.camera_info.serial_number) for device in found]
        if not found:
            raise DeviceMissingError(
                "camera",
                "no RealSense camera on USB",
                "Check cable and power; list what is there with `lsusb -d 8086:`",
            )
        if not wanted and len(found) == 1:
            return found[0]
        if not wanted:
            raise DeviceMissingError(
                "camera",
                f"{len(found)} cameras attached ({', '.join(serials)})",
                "Set camera.serial_number to one of them",
            )
        for device, serial in zip(found, serials, strict=True):
            if serial == wanted:
                return device
        raise DeviceMissingError(
            "camera",
            f"no camera with serial number {wanted}; attached: {', '.join(serials)}",
            "Correct camera.serial_number",
        )

    def _color_options(self) -> Options:
        rs, settings = sdk.load(), self._settings
        return [
            (rs.option.enable_auto_exposure, float(settings.exposure_us is None and settings.gain is None)),
            (rs.option.exposure, settings.exposure_us and settings.exposure_us / EXPOSURE_UNIT_US),
            (rs.option.gain, settings.gain),
            (rs.option.enable_auto_white_balance, float(settings.white_balance_k is None)),
            (rs.option.white_balance, settings.white_balance_k),
        ]

    def _depth_options(self) -> Options:
        rs, settings = sdk.load(), self._settings
        preset = settings.depth_preset and float(DEPTH_PRESETS.index(settings.depth_preset))
        return [
            (rs.option.visual_preset, preset),  # first: a preset sets what follows
            (rs.option.emitter_enabled, float(settings.depth_emitter)),
            (rs.option.laser_power, settings.depth_laser_mw),
            (rs.option.enable_auto_exposure, float(settings.depth_exposure_us is None and settings.depth_gain is None)),
            (rs.option.exposure, settings.depth_exposure_us),
            (rs.option.gain, settings.depth_gain),
        ]

    def settings_read_back(self) -> dict[str, float]:
        """What both sensors say: ``exposure_us``, ``gain``, ``white_balance_k``, ``auto_*`` (0 or 1) of colour;
        ``depth_preset`` (its number), ``depth_emitter`` (0 or 1), ``depth_laser_mw``, ``depth_exposure_us``,
        ``depth_gain`` and ``depth_auto_exposure`` of depth."""
        if self._color is None:
            return {}
        rs = sdk.load()
        names = {
            "exposure_us": (rs.option.exposure, EXPOSURE_UNIT_US),
            "gain": (rs.option.gain, 1.0),
            "white_balance_k": (rs.option.white_balance, 1.0),
            "auto_exposure": (rs.option.enable_auto_exposure, 1.0),
            "auto_white_balance": (rs.option.enable_auto_white_balance, 1.0),
        }
        values = _read_options(self._color.sensor, names)
        if self._depth is not None:
            names = {
                "depth_preset": (rs.option.visual_preset, 1.0),
                "depth_emitter": (rs.option.emitter_enabled, 1.0),
                "depth_laser_mw": (rs.option.laser_power, 1.0),
                "depth_exposure_us": (rs.option.exposure, 1.0),
                "depth_gain": (rs.option.gain, 1.0),
                "depth_auto_exposure": (rs.option.enable_auto_exposure, 1.0),
            }
            values |= _read_options(self._depth.sensor, names)
        return values

    def read(self, timeout_s: float) -> Frame:
        """The newest colour frame with the depth frame of the same moment.

        Where depth has stopped, colour comes alone: ``depth_mm`` None, its silence in ``metadata["depth_silent_s"]``.

        Raises:
            DeviceTimeoutError: no colour frame within ``timeout_s``.
            DeviceLostError: the camera is no longer on USB.
            LifecycleError: not open.
        """
        if self._color is None:
            raise LifecycleError(self._description, "the camera is not open")
        period_s = 1.0 / self._settings.rate_hz
        deadline_s = time.monotonic() + timeout_s
        color: _Arrived | None = None
        while True:
            color = _newest(self._color.queue, POLL_S) or color
            self._collect_depth()
            now_s = time.monotonic()
            if color is not None:
                if self._depth is None:
                    return self._frame(color, None)
                depth = self._partner(color, period_s)
                if depth is not None:
                    return self._frame(color, depth)
                if now_s - self._last_depth_s > DEPTH_GRACE_PERIODS * period_s:
                    return self._frame(color, None)
            if now_s > deadline_s:
                raise self._silence(timeout_s)

    def _collect_depth(self) -> None:
        if self._depth is None:
            return
        while True:
            got, frame = self._depth.queue.try_wait_for_frame(1) if not self._depths else _poll(self._depth.queue)
            if not got:
                return
            self._last_depth_s = time.monotonic()
            self._depths.append(_Arrived(frame, self._last_depth_s, frame.get_timestamp() / 1000.0))

    def _partner(self, color: _Arrived, period_s: float) -> _Arrived | None:
        same_clock = [
            depth
            for depth in self._depths
            if depth.frame.get_frame_timestamp_domain() == color.frame.get_frame_timestamp_domain()
        ]
        if same_clock:
            best = min(same_clock, key=lambda depth: abs(depth.device_s - color.device_s))
            return best if abs(best.device_s - color.device_s) <= 0.5 * period_s else None
        if not self._depths:
            return None
        best = min(self._depths, key=lambda depth: abs(depth.at_s - color.at_s))
        return best if abs(best.at_s - color.at_s) <= 0.5 * period_s else None

    def _frame(self, color: _Arrived, depth: _Arrived | None) -> Frame:
        assert self._color is not None  # read() has checked
        metadata = {"color_device_s": color.device_s, **_frame_settings(color.frame)}
        picture = lens = None
        if depth is not None:
            picture = sdk.depth_mm(depth.frame, sdk.depth_units_m(depth.frame))
            lens = self._depth.lens if self._depth else None
            if depth.frame.get_frame_timestamp_domain() == color.frame.get_frame_timestamp_domain():
                metadata["depth_device_s"] = depth.device_s
            else:
                metadata["color_device_s"], metadata["depth_device_s"] = color.at_s, depth.at_s
        elif self._depth is not None:
            metadata["depth_silent_s"] = time.monotonic() - self._last_depth_s
        return Frame(
            sdk.color_bgr(color.frame),
            picture,
            self._color.lens,
            lens,
            color.at_s,
            int(color.frame.get_frame_number()),
            int(depth.frame.get_frame_number()) if depth is not None else -1,
            metadata=metadata,
        )

    def _silence(self, timeout_s: float) -> DeviceTimeoutError | DeviceLostError:
        rs = sdk.load()
        serial = self._device.get_info(rs.camera_info.serial_number)
        here = [device.get_info(rs.camera_info.serial_number) for device in self._devices()]
        if serial not in here:
            return DeviceLostError(self._description, "the camera is no longer on USB", "Check cable and power")
        depth = "depth comes" if time.monotonic() - self._last_depth_s < timeout_s else "nor depth"
        return DeviceTimeoutError(self._description, f"no colour frame for {timeout_s:.2f} s ({depth})")

    def reset_hardware(self) -> None:
        """Restart the camera (it leaves USB and comes back) and wait up to 10 s for it. Leaves it closed.

        Raises:
            DeviceMissingError: it is not there, or did not come back.
        """
        self.close()
        rs = sdk.load()
        device = self._find()
        serial = device.get_info(rs.camera_info.serial_number)
        device.hardware_reset()
        del device
        deadline_s = time.monotonic() + RESET_WAIT_S
        gone = False
        while time.monotonic() < deadline_s:
            here = serial in [device.get_info(rs.camera_info.serial_number) for device in self._devices()]
            gone = gone or not here
            if gone and here:
                return
            time.sleep(0.2)
        if gone:
            raise DeviceMissingError(
                "camera", f"{serial} did not come back after a reset", "Replug it or cycle its power"
            )

    def close(self) -> None:
        """Stop both sensors and let go; idempotent. May hang in the library: the caller is an expendable process."""
        streams = (self._color, self._depth)
        self._color = self._depth = None
        self._depths.clear()
        self._device = None
        for stream in streams:
            if stream is not None:
                with contextlib.suppress(RuntimeError):
                    stream.sensor.stop()
                with contextlib.suppress(RuntimeError):
                    stream.sensor.close()


def _set_options(sensor: sdk.Rs, pairs: Options) -> None:
    for option, value in pairs:
        if value is None or not sensor.supports(option) or sensor.is_option_read_only(option):
            continue
        span = sensor.get_option_range(option)
        # Out of range or refused is seen in the read-back, and reported from there.
        with contextlib.suppress(RuntimeError):
            sensor.set_option(option, min(max(value, span.min), span.max))


def _read_options(sensor: sdk.Rs, names: dict[str, tuple[sdk.Rs, float]]) -> dict[str, float]:
    values = {}
    for name, (option, factor) in names.items():
        if sensor.supports(option):
            with contextlib.suppress(RuntimeError):
                values[name] = float(sensor.get_option(option)) * factor
    return values


def _poll(queue: sdk.Rs) -> tuple[bool, sdk.Rs]:
    frame = queue.poll_for_frame()
    return bool(frame), frame


def _newest(queue: sdk.Rs, wait_s: float) -> _Arrived | None:
    got, frame = queue.try_wait_for_frame(max(1, int(wait_s * 1000)))
    if not got:
        return None
    while True:
        more, newer = _poll(queue)
        if not more:
            return _Arrived(frame, time.monotonic(), frame.get_timestamp() / 1000.0)
        frame = newer


def _find_profile(device: sdk.Rs, stream: sdk.Rs, width: int, height: int, rate_hz: float) -> tuple[sdk.Rs, sdk.Rs]:
    rs = sdk.load()
    wanted = [rs.format.z16] if stream == rs.stream.depth else [rs.format.bgr8, rs.format.rgb8, rs.format.yuyv]
    offered: set[str] = set()
    matches: list[tuple[int, sdk.Rs, sdk.Rs]] = []
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() != stream or not profile.is_video_stream_profile():
                continue
            video = profile.as_video_stream_profile()
            offered.add(f"{video.width()}x{video.height()}@{profile.fps()}")
            fits = video.width() == width and video.height() == height and abs(profile.fps() - rate_hz) < 0.5
            if fits and profile.format() in wanted:
                matches.append((wanted.index(profile.format()), sensor, profile))
    if not matches:
        usb = ""
        if device.supports(rs.camera_info.usb_type_descriptor):
            usb = f" on USB {device.get_info(rs.camera_info.usb_type_descriptor)}"
        name = "depth" if stream == rs.stream.depth else "colour"
        raise WrongDeviceError(
            _describe(device),
            f"no {name} {width}x{height} at {rate_hz:g} Hz{usb}; it offers {', '.join(sorted(offered)) or 'none'}",
            "Use a USB 3 port and cable, or ask for one of these in [camera]",
        )
    _, sensor, profile = min(matches, key=lambda match: match[0])
    return sensor, profile


def _start(sensor: sdk.Rs, profile: sdk.Rs) -> _Stream:
    queue = sdk.load().frame_queue(QUEUE_N)
    sensor.open(profile)
    sensor.start(queue)
    return _Stream(sensor, queue, sdk.intrinsics(profile))


def _describe(device: sdk.Rs) -> str:
    rs = sdk.load()
    parts = [
        device.get_info(info) for info in (rs.camera_info.name, rs.camera_info.serial_number) if device.supports(info)
    ]
    return " ".join(parts)


def _firmware(device: sdk.Rs) -> str:
    """Its version, and whether the library would have a newer one; empty where the device does not say."""
    info = sdk.load().camera_info
    if not device.supports(info.firmware_version):
        return ""
    told = device.get_info(info.firmware_version)
    wanted = (
        device.get_info(info.recommended_firmware_version) if device.supports(info.recommended_firmware_version) else ""
    )
    older = wanted and _numbers(told) < _numbers(wanted)
    return f", firmware {told}" + (f", older than {wanted}" if older else "")


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]


def _frame_settings(frame: sdk.Rs) -> dict[str, float]:
    rs = sdk.load()
    values = {}
    names = {
        "exposure_us": rs.frame_metadata_value.actual_exposure,
        "gain": rs.frame_metadata_value.gain_level,
        "white_balance_k": rs.frame_metadata_value.white_balance,
    }
    for name, key in names.items():
        if frame.supports_frame_metadata(key):
            values[name] = float(frame.get_frame_metadata(key))
    return values
