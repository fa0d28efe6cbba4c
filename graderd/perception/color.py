"""The colour rule of the paper (section 3.2): to the letter, and quick.

To the letter: the blade is divided into three parts; brightness adjusted; bilateral filter; HSV window; Otsu
binarisation; the contour with the largest area; contour approximation; its area in each part. Quick: the same steps
on the blade's region only, halved twice by exact area averaging (each halving is one vectorised pass and removes
noise), with a 3-pixel median in the bilateral filter's place.
"""

from __future__ import annotations

import cv2
import numpy as np

from graderd.perception.decide import Verdict, decide
from graderd.perception.geometry import U8, Region
from graderd.perception.settings import ColorSettings, DecisionSettings


def brightness_gain(mean_value: float, settings: ColorSettings) -> float:
    """Factor that brings the mean brightness (0-255) to the target, within the allowed ratio."""
    wanted = settings.brightness_target_percent / 100 * 255 / max(mean_value, 1.0)
    most = settings.brightness_gain_max_ratio
    return float(min(max(wanted, 1.0 / most), most))


def soil_mask(image_bgr: U8, settings: ColorSettings) -> U8:
    """Pixels (255) inside the HSV window that Otsu's threshold puts on the bright side; the input is filtered."""
    hsv = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2HSV)
    low, high = settings.opencv_window()
    window = cv2.inRange(hsv, np.array(low), np.array(high))
    gray = cv2.bitwise_and(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), window)
    _, binary = cv2.threshold(gray, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return np.asarray(binary, dtype=np.uint8)


def largest_contour(mask: U8, tolerance_percent: float) -> U8:
    """The largest contour, approximated and filled."""
    filled = np.zeros_like(mask)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if contours:
        largest = max(contours, key=cv2.contourArea)
        shape = cv2.approxPolyDP(largest, cv2.arcLength(largest, True) * tolerance_percent / 100, True)
        cv2.fillPoly(filled, [shape], 255)
    return filled


def coverage_percent(mask: U8, region: Region) -> tuple[float, float, float]:
    """Soil on each third (left, center, right), percent of the third's own area."""
    counts = [cv2.countNonZero(cv2.bitwise_and(mask, third)) for third in region.masks]
    cover = [100.0 * count / area for count, area in zip(counts, region.areas_px, strict=True)]
    return cover[0], cover[1], cover[2]


def judge(mask: U8, region: Region, color: ColorSettings, decision: DecisionSettings) -> Verdict:
    """Verdict on a soil mask at the region's scale."""
    return decide(coverage_percent(mask, region), 3 * color.none_area_percent, "% of each third", decision)


def paper_steps(image_bgr: U8, settings: ColorSettings) -> tuple[U8, U8, U8]:
    """The letter of section 3.2 on a whole picture: filtered picture, soil mask, largest contour filled."""
    gain = brightness_gain(float(np.mean(cv2.mean(image_bgr)[:3])), settings)
    bright = cv2.convertScaleAbs(image_bgr, alpha=gain)
    sigma = settings.bilateral_sigma_n
    filtered = np.asarray(cv2.bilateralFilter(bright, settings.bilateral_diameter_px, sigma, sigma), dtype=np.uint8)
    mask = soil_mask(filtered, settings)
    return filtered, mask, largest_contour(mask, settings.contour_tolerance_percent)


def paper_verdict(image_bgr: U8, region: Region, color: ColorSettings, decision: DecisionSettings) -> Verdict:
    """The paper's method; ``region`` must be at full scale (no halvings)."""
    _, mask, _ = paper_steps(image_bgr, color)
    blade = cv2.bitwise_and(mask[region.rows, region.columns], region.blade)
    return judge(largest_contour(np.asarray(blade), color.contour_tolerance_percent), region, color, decision)


def halved(image: U8, halvings: int) -> U8:
    """Exact area average over 2x2, repeated; sides must be multiples of 2**halvings."""
    for _ in range(halvings):
        image = np.asarray(
            cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return image


def fast_mask(image_bgr: U8, region: Region, settings: ColorSettings) -> U8:
    """Soil mask of the blade's region, at the region's scale: the largest contour, filled."""
    small = halved(np.asarray(image_bgr[region.rows, region.columns]), region.halvings)
    gain = brightness_gain(float(np.mean(cv2.mean(small)[:3])), settings)
    bright = cv2.medianBlur(cv2.convertScaleAbs(small, alpha=gain), 3)
    mask = cv2.bitwise_and(soil_mask(np.asarray(bright, dtype=np.uint8), settings), region.blade)
    return largest_contour(np.asarray(mask, dtype=np.uint8), settings.contour_tolerance_percent)


def fast_color_verdict(image_bgr: U8, region: Region, color: ColorSettings, decision: DecisionSettings) -> Verdict:
    """The paper's decision from the blade's region only."""
    return judge(fast_mask(image_bgr, region, color), region, color, decision)
