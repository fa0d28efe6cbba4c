"""What the machine did, kept: the recorder with its black box, and what reads its files (replay, report)."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class FramesWanted(BaseModel):
    """What perception is to record of raw frames: one of ``every_n`` to ``path``, or beside it where that is taken; an
    empty path: none. ``head`` and ``config_json`` as in every recording.

    Here, because whoever passes it on needs nothing else of a recording, and all else takes long to import."""

    model_config = ConfigDict(frozen=True)

    path: str = ""
    every_n: int = 1
    head: dict[str, str] = {}
    config_json: str = "{}"
