"""The RealSense camera: live on USB, or from a recording; and plain pictures and videos from files."""

from graderd.drivers.realsense.files import PICTURE_SUFFIXES, VIDEO_SUFFIXES, FolderCamera, VideoCamera
from graderd.drivers.realsense.live import RealSenseCamera
from graderd.drivers.realsense.recording import RecordingCamera

RECORDING_SUFFIXES = frozenset({".db3", ".bag"})

__all__ = [
    "PICTURE_SUFFIXES",
    "RECORDING_SUFFIXES",
    "VIDEO_SUFFIXES",
    "FolderCamera",
    "RealSenseCamera",
    "RecordingCamera",
    "VideoCamera",
]
