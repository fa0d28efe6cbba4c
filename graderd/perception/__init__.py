"""Perception: a frame and a blade angle in, a soil observation out. numpy and OpenCV, no device, no clock but CPU time.

Four classifiers share one contract: ``paper`` (the letter of the paper's section 3.2), ``fast_color`` (the same rule on
the blade's region), ``depth`` (litres per third above a ground fitted in every frame; the default) and ``fused``
(depth decides, colour cross-checks).

What is imported here needs no OpenCV: the daemon and the guard read their settings without its 150 MB of libraries. The
classifiers are in :mod:`graderd.perception.classifier`.
"""

from graderd.perception.settings import METHODS, CameraCalibration, Method, PerceptionSettings

__all__ = ["METHODS", "CameraCalibration", "Method", "PerceptionSettings"]
