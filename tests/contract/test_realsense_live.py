"""The live camera against the SDK's own software device, through the sensors' real queues."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from graderd.drivers.realsense import RealSenseCamera, sdk
from graderd.drivers.realsense.live import attached
from graderd.hal.errors import (
    DeviceLostError,
    DeviceMissingError,
    DeviceTimeoutError,
    LifecycleError,
    WrongDeviceError,
)
from graderd.hal.settings import CameraSettings
from graderd.runtime.app.perception_child import settings_not_kept
from harness.realsense_devices import SoftD455

PERIOD_S = 1 / 30


def settings(**more: object) -> CameraSettings:
    sizes = {"color_width_px": 320, "color_height_px": 200, "depth_width_px": 212, "depth_height_px": 120}
    return CameraSettings.model_validate({**sizes, **more})


@contextmanager
def streaming(soft: SoftD455, push: Callable[[int], None]) -> Iterator[None]:
    """Call ``push`` with growing frame numbers at 30 Hz from another thread, as a camera would."""
    stop = threading.Event()

    def run() -> None:
        number = 0
        while not stop.wait(PERIOD_S):
            number += 1
            push(number)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def color(number: int) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    picture = np.zeros((200, 320, 3), dtype=np.uint8)
    picture[:] = (number % 256, 50, 200)
    return picture


DEPTH = np.full((120, 212), 900, dtype=np.uint16)


def both(soft: SoftD455) -> Callable[[int], None]:
    def push(number: int) -> None:
        soft.push_depth(DEPTH, number, number * 33.3)
        soft.push_color(color(number), number, number * 33.3 + 4)

    return push


@pytest.fixture
def soft() -> SoftD455:
    return SoftD455()


@pytest.fixture
def camera(soft: SoftD455) -> Iterator[RealSenseCamera]:
    camera = RealSenseCamera(settings(), lambda: [soft.device])
    camera.open()
    yield camera
    camera.close()


def test_colour_and_depth_of_the_same_moment(camera: RealSenseCamera, soft: SoftD455) -> None:
    assert camera.description == "Intel RealSense D455 SYN0001"
    with streaming(soft, both(soft)):
        frames = [camera.read(2.0) for _ in range(8)]
    numbers = [frame.color_number for frame in frames]
    assert numbers == sorted(set(numbers))  # each once, in order
    for frame in frames:
        assert frame.depth_number == frame.color_number
        assert frame.depth_mm is not None
        assert np.array_equal(frame.depth_mm, DEPTH)
        assert np.array_equal(frame.color_bgr, color(frame.color_number))
        assert abs(frame.metadata["color_device_s"] - frame.metadata["depth_device_s"]) < 0.02
    assert frames[0].color_intrinsics is not None
    assert frames[0].color_intrinsics.width == 320


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ("5.13.0.50", "firmware 5.13.0.50, older than 5.16.0.1"),
        ("5.16.0.1", "firmware 5.16.0.1"),
        ("5.17.0.9", "firmware 5.17.0.9"),
    ],
)
def test_the_firmware_is_told_and_whether_the_library_would_have_a_newer_one(
    soft: SoftD455, told: str, says: str
) -> None:
    info = sdk.load().camera_info
    soft.device.register_info(info.firmware_version, told)
    soft.device.register_info(info.recommended_firmware_version, "5.16.0.1")
    camera = RealSenseCamera(settings(), lambda: [soft.device])
    camera.open()
    assert camera.description == f"Intel RealSense D455 SYN0001, {says}"
    camera.close()


def test_a_slow_reader_gets_the_newest(camera: RealSenseCamera, soft: SoftD455) -> None:
    push = both(soft)
    for number in range(1, 20):
        push(number)
    assert camera.read(1.0).color_number == 19
    with pytest.raises(DeviceTimeoutError):
        camera.read(0.05)  # none is handed out twice


def test_depth_that_stops_does_not_blind_colour_and_is_told(camera: RealSenseCamera, soft: SoftD455) -> None:
    push = both(soft)

    def depth_stops(number: int) -> None:
        if number < 4:
            push(number)
        else:
            soft.push_color(color(number), number, number * 33.3 + 4)

    with streaming(soft, depth_stops):
        frames = [camera.read(2.0) for _ in range(6)]
    assert frames[0].depth_mm is not None
    assert frames[-1].depth_mm is None
    assert frames[-1].depth_number == -1
    assert frames[-1].metadata["depth_silent_s"] > 0.09


def test_colour_that_stops_is_a_timeout_that_says_so(camera: RealSenseCamera, soft: SoftD455) -> None:
    with (
        streaming(soft, lambda number: soft.push_depth(DEPTH, number, number * 33.3)),
        pytest.raises(DeviceTimeoutError, match=r"no colour frame for 0.20 s \(depth comes\)"),
    ):
        camera.read(0.2)


def test_an_unplugged_camera_is_lost(soft: SoftD455) -> None:
    here = [soft.device]
    camera = RealSenseCamera(settings(), lambda: here)
    camera.open()
    here.clear()
    with pytest.raises(DeviceLostError, match="no longer on USB"):
        camera.read(0.05)
    camera.close()
    with pytest.raises(DeviceMissingError):
        camera.open()
    here.append(soft.device)
    camera.open()  # replugged
    with streaming(soft, both(soft)):
        assert camera.read(2.0).depth_mm is not None
    camera.close()
    camera.close()


def test_exposure_and_white_balance_are_set_locked_and_read_back() -> None:
    rs = sdk.load()
    soft = SoftD455()

    def option(which: sdk.Rs, low: float, high: float, default: float, step: float = 1) -> None:
        span = rs.option_range()
        span.min, span.max, span.default, span.step = low, high, default, step
        soft.color_sensor.add_option(which, span, True)

    option(rs.option.enable_auto_exposure, 0, 1, 1)
    option(rs.option.exposure, 1, 10000, 156)
    option(rs.option.enable_auto_white_balance, 0, 1, 1)
    option(rs.option.white_balance, 2800, 6500, 4600, 10)
    option(rs.option.gain, 0, 128, 64)
    wanted = settings(exposure_us=8000, gain=32, white_balance_k=5200)
    camera = RealSenseCamera(wanted, lambda: [soft.device])
    camera.open()
    assert camera.settings_read_back() == {
        "exposure_us": 8000.0,
        "gain": 32.0,
        "white_balance_k": 5200.0,
        "auto_exposure": 0.0,
        "auto_white_balance": 0.0,
    }
    camera.close()
    assert camera.settings_read_back() == {}
    beyond = RealSenseCamera(settings(exposure_us=2_000_000), lambda: [soft.device])
    beyond.open()
    assert beyond.settings_read_back()["exposure_us"] == 1_000_000.0  # what was really set is what is told
    beyond.close()


def test_the_depth_sensor_is_set_and_read_back_too() -> None:
    rs = sdk.load()
    soft = SoftD455()
    for which, low, high, default in (
        (rs.option.visual_preset, 0, 5, 0),
        (rs.option.emitter_enabled, 0, 2, 0),
        (rs.option.laser_power, 0, 360, 0),
        (rs.option.enable_auto_exposure, 0, 1, 1),
        (rs.option.exposure, 1, 200_000, 8500),
        (rs.option.gain, 16, 248, 16),
    ):
        span = rs.option_range()
        span.min, span.max, span.default, span.step = low, high, default, 1
        soft.depth_sensor.add_option(which, span, True)
    wanted = settings(depth_preset="high_accuracy", depth_laser_mw=240, depth_exposure_us=4000)
    camera = RealSenseCamera(wanted, lambda: [soft.device])
    camera.open()
    read_back = {name: value for name, value in camera.settings_read_back().items() if name.startswith("depth")}
    assert read_back == {
        "depth_preset": 3.0,
        "depth_emitter": 1.0,
        "depth_laser_mw": 240.0,
        "depth_exposure_us": 4000.0,
        "depth_gain": 16.0,
        "depth_auto_exposure": 0.0,
    }
    camera.close()
    assert settings_not_kept(wanted, read_back) == ()
    (wrong,) = settings_not_kept(wanted, {**read_back, "depth_emitter": 0.0})
    assert "depth_emitter" in wrong
    dark = settings(depth_emitter=False)
    assert (
        settings_not_kept(dark, {**read_back, "depth_emitter": 0.0, "depth_laser_mw": 0.0, "depth_preset": 1.0}) == ()
    )


def test_no_camera_is_said_at_once() -> None:
    assert attached() == []
    with pytest.raises(DeviceMissingError, match="no RealSense camera on USB"):
        RealSenseCamera(settings()).open()


def test_the_right_one_of_several(soft: SoftD455) -> None:
    with pytest.raises(DeviceMissingError, match=r"no camera with serial number 123; attached: SYN0001"):
        RealSenseCamera(settings(serial_number="123"), lambda: [soft.device]).open()
    with pytest.raises(DeviceMissingError, match="2 cameras attached"):
        RealSenseCamera(settings(), lambda: [soft.device, SoftD455().device]).open()
    camera = RealSenseCamera(settings(serial_number="SYN0001"), lambda: [soft.device])
    camera.open()
    camera.close()


def test_a_mode_it_does_not_offer(soft: SoftD455) -> None:
    with pytest.raises(WrongDeviceError, match=r"no colour 1280x800 at 30 Hz; it offers 320x200@30"):
        RealSenseCamera(CameraSettings(), lambda: [soft.device]).open()
    with pytest.raises(WrongDeviceError, match="no depth 848x480"):
        RealSenseCamera(settings(depth_width_px=848, depth_height_px=480), lambda: [soft.device]).open()


def test_colour_only(soft: SoftD455) -> None:
    camera = RealSenseCamera(settings(depth_width_px=0), lambda: [soft.device])
    camera.open()
    with streaming(soft, lambda number: soft.push_color(color(number), number, number * 33.3)):
        frame = camera.read(2.0)
    assert frame.depth_mm is None
    assert "depth_silent_s" not in frame.metadata
    camera.close()


def test_a_closed_camera_cannot_be_read(soft: SoftD455) -> None:
    camera = RealSenseCamera(settings(), lambda: [soft.device])
    with pytest.raises(LifecycleError):
        camera.read(0.1)


def test_hardware_reset_waits_until_the_camera_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    class Device:
        def __init__(self) -> None:
            self.resets = 0

        def get_info(self, _info: object) -> str:
            return "SYN0001"

        def hardware_reset(self) -> None:
            self.resets += 1

    device = Device()
    looks = iter([[device], [device], [], [], [device]])
    camera = RealSenseCamera(settings(), lambda: next(looks))
    monkeypatch.setattr("graderd.drivers.realsense.live.time.sleep", lambda _s: None)
    camera.reset_hardware()
    assert device.resets == 1
    with pytest.raises(StopIteration):
        next(looks)


def test_inverse_distortion_is_turned_round() -> None:
    from graderd.hal.camera import Intrinsics
    from graderd.perception.geometry import View
    from graderd.perception.settings import CameraCalibration

    lens = Intrinsics(1280, 800, 629.0, 629.0, 639.5, 399.5)
    inverse = [0.05, -0.02, 0.001, -0.0005, 0.003]
    k = sdk.forward_coefficients(lens, inverse)
    forward = Intrinsics(1280, 800, 629.0, 629.0, 639.5, 399.5, (k[0], k[1], k[2], k[3], k[4]))
    u, v = np.array([100.0, 640.0, 1200.0]), np.array([50.0, 400.0, 700.0])
    x, y = (u - 639.5) / 629.0, (v - 399.5) / 629.0
    r2 = x * x + y * y
    radial = 1 + r2 * (inverse[0] + r2 * (inverse[1] + r2 * inverse[4]))
    ray_x = x * radial + 2 * inverse[2] * x * y + inverse[3] * (r2 + 2 * x * x)
    ray_y = y * radial + 2 * inverse[3] * x * y + inverse[2] * (r2 + 2 * y * y)
    calibration = CameraCalibration()
    view = View(forward, calibration.color.pose(calibration.mounting))
    points = view.position_m + np.column_stack((ray_x, ray_y, np.ones(3))) @ view.rotation.T
    assert view.project(points) == pytest.approx(np.column_stack((u, v)), abs=0.3)
