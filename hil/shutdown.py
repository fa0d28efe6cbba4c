"""What the bus sees while the computer shuts down: ``watch`` writes it down as it comes, ``judge`` reads it later."""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from threading import Event
from typing import Final, TextIO

from hil.bus import RawBus
from hil.service import RIG_DIRECTORY, Rig

ACM: Final = 0xEF00
MOTION_ENABLE: Final = 0x10
SAMPLE_S: Final = 0.05
OURS_N: Final = 3


def watch(interface: str, path: Path) -> None:
    """Write control messages and the rig's true angle as JSON lines until SIGTERM; each line is on disk at once."""
    ended = Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    bus, rig = RawBus(interface), Rig(interface)
    with path.open("w", encoding="ascii") as out:
        due_s = time.monotonic()
        while not ended.is_set():
            frame = bus.receive(SAMPLE_S)
            now_s = round(time.monotonic(), 3)
            if frame is not None and frame.pgn == ACM:
                _write(
                    out, {"s": now_s, "to": frame.can_id >> 8 & 0xFF, "enabled": bool(frame.data[3] & MOTION_ENABLE)}
                )
            if now_s >= due_s and (RIG_DIRECTORY / "control.sock").exists():
                due_s = now_s + SAMPLE_S
                try:
                    state = rig.ask("state")
                except (OSError, ValueError):
                    continue
                _write(out, {"s": now_s, "blade_deg": state["blade_deg"]})


def _write(out: TextIO, record: dict[str, object]) -> None:
    out.write(json.dumps(record) + "\n")
    out.flush()


def judge(path: Path) -> list[str]:
    """What is wrong with a record; empty where the machine was brought to a stand."""
    records = [json.loads(line) for line in path.read_text(encoding="ascii").splitlines()]
    angles = [(r["s"], r["blade_deg"]) for r in records if "blade_deg" in r]
    controls = [r for r in records if "to" in r]
    wrong = []
    if len(angles) < 10 or not controls:
        return [f"too little was seen: {len(angles)} angles, {len(controls)} control messages"]
    moved = max(a for _, a in angles) - min(a for _, a in angles)
    if moved < 3.0:
        wrong.append(f"the blade moved only {moved:.1f} deg: it was not turning")
    rest = [angle for _, angle in angles[-4:]]
    if max(rest) - min(rest) > 0.1:
        wrong.append(f"the blade still moved at the end: {rest}")
    if rest[-1] > 44.5:
        wrong.append(f"the blade went all the way to {rest[-1]:.1f} deg")
    last: dict[int, bool] = {r["to"]: r["enabled"] for r in controls}
    if len(last) < OURS_N or any(last.values()):
        wrong.append(f"the last control messages left motion enabled: {last}")
    return wrong


if __name__ == "__main__":
    watch(sys.argv[2], Path(sys.argv[3]))
