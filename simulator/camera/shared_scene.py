"""The bed and the blade's pose in anonymous shared memory: written by the rig, read by its camera process.

An anonymous memory file (``memfd``) leaves nothing behind however the processes end. One writer, any reader: a
sequence number that is odd while the writer is at work lets the reader notice and read again (a seqlock).
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graderd.simulator.grader.blade import BladePose

_SEQUENCE = struct.Struct("<Q")
_HEADER = struct.Struct("<6d3q")
"""time_s, vehicle_x_m, blade angle, height, slope, pitch; cells along x, cells along y, cell in micrometres."""
_BODY = 128


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """One consistent state. ``heights_m`` is the reader's own copy; ``time_s`` is monotonic."""

    time_s: float
    vehicle_x_m: float
    blade: BladePose
    heights_m: npt.NDArray[np.float32]
    cell_m: float


class SharedScene:
    """Both ends of the shared memory. The writer makes it with :meth:`create`, the reader opens its descriptor."""

    def __init__(self, descriptor: int, size: int) -> None:
        self.descriptor = descriptor
        self._memory = mmap.mmap(descriptor, size)
        self._sequence = 0

    @classmethod
    def create(cls, shape: tuple[int, int]) -> SharedScene:
        """New memory for a bed of ``shape`` cells."""
        size = _BODY + shape[0] * shape[1] * 4
        descriptor = os.memfd_create("graderd-rig")
        os.ftruncate(descriptor, size)
        return cls(descriptor, size)

    @classmethod
    def open(cls, descriptor: int) -> SharedScene:
        """The memory behind a descriptor inherited from the writer."""
        return cls(descriptor, os.fstat(descriptor).st_size)

    def write(
        self, time_s: float, vehicle_x_m: float, blade: BladePose, heights_m: npt.NDArray[np.float64], cell_m: float
    ) -> None:
        """Publish a state."""
        _SEQUENCE.pack_into(self._memory, 0, self._sequence + 1)
        header = (time_s, vehicle_x_m, blade.angle_deg, blade.height_m, blade.slope_deg, blade.pitch_deg)
        _HEADER.pack_into(self._memory, 8, *header, *heights_m.shape, round(cell_m * 1e6))
        cells = np.frombuffer(self._memory, np.float32, heights_m.size, _BODY)
        np.copyto(cells.reshape(heights_m.shape), heights_m, casting="same_kind")
        self._sequence += 2
        _SEQUENCE.pack_into(self._memory, 0, self._sequence)

    def close(self) -> None:
        """Let go of the memory; idempotent."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def read(self) -> Snapshot:
        """The newest complete state; waits microseconds where the writer is just at it."""
        while True:
            before = _SEQUENCE.unpack_from(self._memory, 0)[0]
            if before % 2 == 0 and before > 0:
                time_s, x_m, angle, height, slope, pitch, n_x, n_y, cell_um = _HEADER.unpack_from(self._memory, 8)
                cells = np.frombuffer(self._memory, np.float32, n_x * n_y, _BODY).reshape(n_x, n_y).copy()
                if _SEQUENCE.unpack_from(self._memory, 0)[0] == before:
                    return Snapshot(time_s, x_m, BladePose(angle, height, slope, pitch), cells, cell_um * 1e-6)
            time.sleep(0.0002)
