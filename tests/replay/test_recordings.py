"""Recordings of the simulated grader at work, decided again by today's code: bit for bit what was decided then.

``recordings/graderd-left-then-right.mcap``: automatic operation with soil on the left, then on the right; one raw
frame. After a change that is meant, ``python -m tests.replay.test_recordings --update`` writes the decisions anew, and
what was seen in the raw frames: read what ``graderd replay FILE --check`` lists before you do.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from graderd.perception.classifier import judge_frame, make_classifier
from graderd.record.export import raw_frames
from graderd.record.files import RecordingFile
from graderd.record.frames import messages_of
from graderd.record.layout import FRAMES_SUFFIX
from graderd.record.reader import Recording
from graderd.record.replay import check, decided_again
from graderd.record.table import rows

FOLDER = Path(__file__).parent / "recordings"
RECORDINGS = sorted(path for path in FOLDER.glob("*.mcap") if not path.name.endswith(FRAMES_SUFFIX))


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_today_decides_what_was_decided(path: Path) -> None:
    found = check(Recording(path))
    assert [difference.text for difference in found.differences] == []
    assert found.frames_n >= 1
    decided = [row.get("decision") for row in rows(Recording(path))]
    assert {"left", "right"} <= set(decided), "it is still the work that it is meant to be"
    # Where the tick's memory has another shape by now, its first ten seconds are not judged until it is written anew.
    assert found.ticks_n > (200 if found.warm_ups_n else 700)


def update(path: Path) -> None:
    """Write the recording, and its raw frames, with today's decisions."""
    recording = Recording(path)
    new = path.with_suffix(".new")
    file = RecordingFile(new, recording.head, recording.config_json)
    for message in decided_again(recording):
        file.add(message)
    file.finish()
    new.replace(path)
    config = recording.config
    for frames in recording.frame_files:
        classifier = make_classifier(config.perception, config.camera.calibration, config.blade, camera=config.camera)
        file = RecordingFile(new, Recording(frames).head, recording.config_json)
        log_ns = next(Recording(frames).messages()).log_ns
        for _, judged in raw_frames(Recording(frames)):
            seen = judge_frame(
                classifier, judged.frame, judged.angle_deg, judged.angle_age_s, judged.judged_s,
                config.perception.decision, judged.attitude,
            )  # fmt: skip
            offset_ns = log_ns - int(judged.frame.capture_s * 1e9)
            for message in messages_of(
                judged._replace(observation=replace(seen, cpu_ms=judged.observation.cpu_ms)), 1, offset_ns
            ):
                file.add(message)
        file.finish()
        new.replace(frames)


if __name__ == "__main__" and sys.argv[1:] == ["--update"]:
    for each in RECORDINGS:
        update(each)
        sys.stdout.write(f"{each.name}: written anew\n")
