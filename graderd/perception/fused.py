"""Depth decides, colour cross-checks: the default wherever the camera gives depth."""

from __future__ import annotations

from graderd.core.zones import Zone
from graderd.perception.decide import Verdict

OPPOSITE = {Zone.LEFT: Zone.RIGHT, Zone.RIGHT: Zone.LEFT}
SURE_COLOR = 0.8
"""Confidence from which a colour verdict counts as an objection."""


def fuse(depth: Verdict, color: Verdict) -> Verdict:
    """One verdict out of two.

    The zone is depth's. Colour that names the same zone raises the confidence; colour that surely names the
    *opposite* side turns it into UNKNOWN (a swing the wrong way is the one mistake that must not happen). Any other
    difference only lowers the confidence: the hue rule is fooled by rust, grey gravel and shade.
    """
    if depth.zone is Zone.UNKNOWN:
        return depth
    if color.zone is depth.zone:
        confidence = depth.confidence + 0.5 * (1.0 - depth.confidence)
        return Verdict(depth.zone, confidence, f"{depth.reason}; colour agrees", depth.shares, depth.volumes_l)
    if OPPOSITE.get(depth.zone) is color.zone and color.confidence >= SURE_COLOR:
        return depth.unknown(f"depth says {depth.zone} ({depth.reason}), colour says {color.zone} ({color.reason})")
    return Verdict(
        depth.zone, 0.9 * depth.confidence, f"{depth.reason}; colour says {color.zone}", depth.shares, depth.volumes_l
    )
