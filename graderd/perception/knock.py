"""Whether the camera still sits where the calibration has it, for the methods that do not measure the blade.

The depth methods find ground and blade again in every frame and so notice by themselves. The colour methods do not:
beside them the depth picture is registered every so many frames. From colour alone it is not told: the upper edge was
tried and is no dependable mark (in an ordinary picture a third of it shows no contrast, and the horizon or the cutting
edge is as straight).
"""

from __future__ import annotations

from collections.abc import Callable

from graderd.core.zones import PictureFault
from graderd.perception.depth import HeightMap

CHECK_EVERY_N = 10
"""At 30 frames a second the blade is looked for three times a second."""


class KnockWatch:
    """Looks now and then whether the blade is where it should be; one instance per stream of frames."""

    def __init__(self, of_height_map: Callable[[HeightMap], list[PictureFault]]) -> None:
        self._of_height_map = of_height_map
        self._frame_n = 0
        self._faults: list[PictureFault] = []

    def check(self, height_map: Callable[[], HeightMap | None]) -> list[PictureFault]:
        """The fault ``knocked`` as long as the last look found the camera moved.

        ``height_map`` measures the frame's depth picture (None where it has none); called only when it is time to look.
        """
        if self._frame_n % CHECK_EVERY_N == 0:
            soil = height_map()
            self._faults = self._of_height_map(soil) if soil is not None else []
        self._frame_n += 1
        return list(self._faults)
