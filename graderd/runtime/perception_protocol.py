"""What the daemon and its perception child say to each other: one JSON object a line, both ways.

To the child: first a :class:`Start`, then ``Angle`` at the control rate, ``PreviewRequest`` when someone looks,
``SaveFrame`` while calibrating, ``RecordFrames`` where raw frames are recorded. From the child: ``Opened``,
``Observed`` for every frame, ``CameraProblem``, ``Preview``, ``Saved``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import PROFILE_BINS_N, SoilObservation
from graderd.hal.settings import AnyCameraSettings
from graderd.perception.settings import CameraCalibration, PerceptionSettings
from graderd.record import FramesWanted

_OBSERVATION: TypeAdapter[SoilObservation] = TypeAdapter(SoilObservation)

MAX_HEIGHT_MM = 10_000.0
"""No soil that a blade meets stands higher: what says so is not right."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Start(_Message):
    """Everything the child needs to know."""

    kind: Literal["start"] = "start"
    camera: AnyCameraSettings
    calibration: CameraCalibration
    perception: PerceptionSettings
    blade: BladeGeometry
    reset_first: bool = False


class Angle(_Message):
    """The measured blade angle and its monotonic time; with it the blade's attitude, as far as it is measured."""

    kind: Literal["angle"] = "angle"
    angle_deg: float
    time_s: float
    height_mm: float | None = None
    slope_deg: float | None = None
    pitch_deg: float | None = None

    @property
    def attitude(self) -> MeasuredAttitude:
        """Height, cross slope and pitch together."""
        return MeasuredAttitude(self.height_mm, self.slope_deg, self.pitch_deg)


class PreviewFormat(_Message):
    """How a picture is wanted. ``labels``: with names and numbers in it, else lines alone, for whoever writes them
    beside it and may mirror it. ``width_px``: no wider than that; None: as the camera gives it."""

    labels: bool = True
    width_px: int | None = None


class PreviewRequest(_Message):
    """Send the next frame's annotated picture."""

    kind: Literal["preview"] = "preview"
    format: PreviewFormat = PreviewFormat()


class SaveFrame(_Message):
    """Add the next frame to the frame set in ``folder``, taken at ``blade_angle_deg``."""

    kind: Literal["save_frame"] = "save_frame"
    folder: str
    id: str
    blade_angle_deg: float


class RecordFrames(_Message):
    """Record raw frames from now on as ``wanted`` says, or no more."""

    kind: Literal["record_frames"] = "record_frames"
    wanted: FramesWanted


class Saved(_Message):
    """A frame was saved; ``problem`` says why not, where it could not."""

    kind: Literal["saved"] = "saved"
    id: str
    problem: str = ""


class Opened(_Message):
    """The camera is open."""

    kind: Literal["opened"] = "opened"
    description: str
    settings_read_back: dict[str, float]
    not_kept: tuple[str, ...] = ()


class Observed(_Message):
    """One frame was judged; ``observation`` as :class:`SoilObservation`'s fields."""

    kind: Literal["observed"] = "observed"
    observation: dict[str, Any]

    @classmethod
    def of(cls, observation: SoilObservation) -> Observed:
        """Pack an observation."""
        return cls(observation=asdict(observation))

    def unpack(self) -> SoilObservation:
        """The observation again.

        Raises:
            ValueError: a field is missing, unknown, of another type, or a number that cannot be.
        """
        try:
            observation = _OBSERVATION.validate_python(self.observation)
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        shares = (observation.share_left, observation.share_center, observation.share_right)
        if not 0.0 <= observation.confidence <= 1.0 or not all(0.0 <= share <= 1.0 for share in shares):
            raise ValueError(f"confidence {observation.confidence} or shares {shares} are not between 0 and 1")
        if observation.ahead is not None and not 0.0 <= observation.ahead.confidence <= 1.0:
            raise ValueError(f"confidence {observation.ahead.confidence} of the soil ahead is not between 0 and 1")
        if not all(map(math.isfinite, _floats(asdict(observation)))):
            raise ValueError("a number in it is not finite")
        profile_mm = observation.profile_mm
        if profile_mm is not None:
            if len(profile_mm) != PROFILE_BINS_N:
                raise ValueError(f"profile_mm has {len(profile_mm)} heights, not {PROFILE_BINS_N}")
            if not all(0.0 <= height_mm <= MAX_HEIGHT_MM for height_mm in _floats(profile_mm)):
                raise ValueError(f"a height in profile_mm is not between 0 and {MAX_HEIGHT_MM:.0f} mm")
        return observation


def _floats(content: object) -> Iterator[float]:
    if isinstance(content, float):
        yield content
    elif isinstance(content, dict):
        for value in content.values():
            yield from _floats(value)
    elif isinstance(content, list | tuple):
        for value in content:
            yield from _floats(value)


class CameraProblem(_Message):
    """No frame now; ``condition`` is a row of the fault catalogue's camera part. ``final``: the child gives up."""

    kind: Literal["problem"] = "problem"
    condition: str
    message: str
    final: bool = False


class Preview(_Message):
    """An annotated picture, JPEG, base64; ``capture_s``: monotonic, when it was taken."""

    kind: Literal["preview"] = "preview"
    format: PreviewFormat
    capture_s: float
    jpeg_base64: str


ToChild = TypeAdapter[Angle | PreviewRequest | SaveFrame | RecordFrames](
    Annotated[Angle | PreviewRequest | SaveFrame | RecordFrames, Field(discriminator="kind")]
)
FromChild = TypeAdapter[Opened | Observed | CameraProblem | Preview | Saved](
    Annotated[Opened | Observed | CameraProblem | Preview | Saved, Field(discriminator="kind")]
)
