"""Calibration with the edge above the ground and the blade leaning: what it makes of the blade's height.

    python -m benchmarks.calibration

Bars: blade height within 5 mm of the drawing's, or refused; and the empty bed of the same frames is none afterwards.
"""

from __future__ import annotations

import argparse
import sys

import cv2

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.calibration import CalibrationError, calibrate
from graderd.perception.classifier import make_classifier
from harness.empty_blades import empty_blades

UP_MM = (0.0, 10.0, 25.0, 50.0)
LEAN_DEG = (-10.0, 0.0, 10.0)
HEIGHT_BAR_MM = 5.0


def main() -> int:
    """Calibrate with each stance, print, and return 1 where a bar is missed."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    cv2.setNumThreads(1)
    missed_n = 0
    for up_mm in UP_MM:
        for lean_deg in LEAN_DEG:
            views, drawn = empty_blades(up_mm, lean_deg), BladeGeometry()
            stance = f"{up_mm:3.0f} mm up, leaning {lean_deg:+3.0f} deg:"
            try:
                found = calibrate(views, CameraCalibration(), drawn)
            except CalibrationError as refusal:
                print(f"{stance} refused: {refusal}")
                continue
            off_mm = (found.blade.height_m - drawn.height_m) * 1000.0
            judge = make_classifier(PerceptionSettings(), found.calibration, found.blade, live=False)
            zones = [judge.classify(view.frame, view.blade_angle_deg, 0.0, view.attitude).zone for view in views]
            met = abs(off_mm) <= HEIGHT_BAR_MM and set(zones) == {Zone.NONE}
            missed_n += not met
            print(f"{stance} height {off_mm:+.1f} mm, then {', '.join(zones)}{'' if met else '   MISSED'}")
    return 1 if missed_n else 0


if __name__ == "__main__":
    sys.exit(main())
