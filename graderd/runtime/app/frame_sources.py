"""From the configuration's ``[camera]`` section, or from a path, to a camera."""

from __future__ import annotations

from pathlib import Path

from graderd.drivers.simulated.camera import RigCamera
from graderd.hal.camera import Camera
from graderd.hal.errors import DeviceMissingError, ProtocolError
from graderd.hal.settings import CameraSettings, is_plugin
from graderd.perception.frame_set import FrameSetCamera, is_frame_set


def open_camera(settings: CameraSettings, real_time: bool = True) -> Camera:
    """The camera of these settings, not opened yet.

    ``real_time`` False makes file sources hand out every frame as fast as it is read.

    Raises:
        DeviceMissingError: the source needs a path and has none, or its driver cannot be loaded.
        ConfigError: a driver from elsewhere cannot be had, or does not take its settings.
    """
    if is_plugin(settings.source):
        from graderd.runtime.app.backends import plugin_camera_of  # loaded late: it brings all other drivers with it

        backend, own = plugin_camera_of(settings)
        return backend.build(own, real_time)
    if settings.source != "realsense" and not settings.path:
        raise DeviceMissingError("camera", f"source {settings.source!r} needs a path", "Set camera.path")
    if settings.source == "frame_set":
        return FrameSetCamera(settings, real_time)
    if settings.source == "rig":
        return RigCamera(settings)
    from graderd.drivers import realsense  # loaded late: a daemon on the rig needs no camera library

    if settings.source == "realsense":
        return realsense.RealSenseCamera(settings)
    if settings.source == "recording":
        return realsense.RecordingCamera(settings, real_time)
    if settings.source == "folder":
        return realsense.FolderCamera(settings, real_time)
    return realsense.VideoCamera(settings, real_time)


def settings_for_path(path: Path) -> CameraSettings:
    """What kind of source a path is: frame set, recording, video, folder of pictures or one picture.

    Raises:
        DeviceMissingError: there is nothing.
        ProtocolError: it is no kind of source that is known.
    """
    from graderd.drivers import realsense  # loaded late, as above

    if not path.exists():
        raise DeviceMissingError(str(path), "no such file or folder")
    suffix = path.suffix.lower()
    if path.is_dir():
        return CameraSettings(source="frame_set" if is_frame_set(path) else "folder", path=str(path))
    if suffix in realsense.RECORDING_SUFFIXES:
        return CameraSettings(source="recording", path=str(path))
    if suffix in realsense.VIDEO_SUFFIXES:
        return CameraSettings(source="video", path=str(path))
    if suffix in realsense.PICTURE_SUFFIXES:
        return CameraSettings(source="folder", path=str(path))
    raise ProtocolError(
        str(path),
        f"{suffix or 'a file without a suffix'} is no picture, video or recording that is read",
        "Pictures: .jpg .png .bmp .tif .webp; videos: .mp4 .avi .mkv .webm; recordings: .db3 .bag; or a folder",
    )
