"""How an engine is run, whichever it is: here a shell."""

from __future__ import annotations

from pathlib import Path

import pytest

from graderd.studies.blade_rotation import engine
from graderd.studies.blade_rotation.engine import BACKGROUND_NICE, StudyError

AUTOGROUP = Path("/proc/self/autogroup")
# The shell is there before it has been sent to the background.
UNTIL_BEHIND = "for _ in $(seq 500); do {} && exit 0; sleep 0.01; done; exit 3"
pytestmark = pytest.mark.live


def test_it_runs_behind_all_else_by_itself_and_by_its_session(tmp_path: Path) -> None:
    behind = f'[ "$(nice)" = {BACKGROUND_NICE} ]'
    own = AUTOGROUP.read_text() if AUTOGROUP.exists() else ""
    if own:
        behind += f" && grep -q 'nice {BACKGROUND_NICE}$' {AUTOGROUP}"
    engine.run(["sh", "-c", UNTIL_BEHIND.format(behind)], tmp_path, "log")
    if own:
        assert AUTOGROUP.read_text() == own, "what started it keeps its claim"


def test_what_it_says_is_the_error(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"ERROR: no such soil") as told:
        engine.run(["sh", "-c", "echo 'ERROR: no such soil' >log; exit 1"], tmp_path, "log")
    assert told.value.where == str(tmp_path / "log")
    with pytest.raises(StudyError, match="ended with status 7"):
        engine.run(["sh", "-c", "exit 7"], tmp_path, "other")


def test_it_ends_with_all_it_started(tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    def stop(step: int) -> None:
        raise StopError(step)

    # Its log tells a step, and the one that is told breaks off; the shell's child holds the lock as long as it lives.
    script = "exec 9>lock; flock 9; (sleep 1000) & echo ' 500 1.0 2.0 3' >log; wait"
    with pytest.raises(StopError):
        engine.run(["sh", "-c", script], tmp_path, "log", stop)
    engine.run(["sh", "-c", "exec 9>lock; flock --wait 10 9"], tmp_path, "again")
