"""Tests against real hardware: ``GRADERD_BENCH=1 make bench-hw``.

Talks to the running daemon on its socket as any client would, so every limit of the gate holds. Begins with *stop*;
asks before each motion, naming axis and distance; any other answer than ``yes`` skips that motion; Ctrl-C stops. The
figures go to ``var/bench/DATE.json`` and belong into the form of docs/integrators/bring-up.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from graderd.client import Client, NoDaemonError, RefusedError
from hil.service import SOCKET, Status, WaitError, brief, faults, measured, wait_for

RESULTS: Final = Path(__file__).resolve().parent.parent / "var" / "bench"
RENEW_S: Final = 0.1
SETTLED_DEG: Final = 0.5
SETTLED_MM: Final = 2.5
STEP_TIMEOUT_S: Final = 20.0
MAY_NOT: Final = (
    "bench-hw moves real machinery. Clear the blade's reach, have the emergency stop in hand, read "
    "docs/integrators/bring-up.md, then: GRADERD_BENCH=1 make bench-hw"
)


@dataclass(slots=True)
class Result:
    """One test: what was done and measured."""

    name: str
    outcome: str
    figures: dict[str, float | str] = field(default_factory=dict)


class Bench:
    """One session at the machine. ``ask`` puts a question to the person and returns the answer."""

    def __init__(self, client: Client, ask: Callable[[str], str]) -> None:
        self._client = client
        self._ask = ask
        self.results: list[Result] = []

    def _status(self) -> Status:
        found: Status = self._client.get("/v1/status")
        return found

    def confirmed(self, what: str) -> bool:
        """Whether the person allows this one motion."""
        return self._ask(f"{what}\n  allow this motion? type yes: ").strip().lower() == "yes"

    def run(self) -> None:
        """Everything in order; a stop first, disarmed at the end whatever happened."""
        try:
            self.stop_works()
            self.contract()
            for axis, unit, step in (("rotate", "deg", 5.0), ("lift", "mm", 15.0), ("tilt", "mm", 10.0)):
                for value in (step, -step):
                    name = f"step {axis} {value:+g} {unit}"
                    self._attempt(name, partial(self.step_response, name, axis, unit, value))
            self._attempt("stop in motion", self.stop_in_motion)
        finally:
            self._client.stop()
            self._client.reset()

    def stop_works(self) -> None:
        """Stop latches, arming is refused while it does, reset leaves it."""
        self._client.stop()
        refused = False
        try:
            self._client.command("arm")
        except RefusedError:
            refused = True
        mode = self._status()["mode"]
        self._client.reset()
        self._note("stop latches", ok=refused and mode == "stopped", mode=mode)

    def contract(self) -> None:
        """Every axis is readable in standby, with fresh readings and no fault; nothing moves for two seconds."""
        first = self._status()
        time.sleep(2.0)
        second = self._status()
        figures: dict[str, float | str] = {"faults": ", ".join(sorted(faults(second)))}
        still = True
        for name, axis in second["axes"].items():
            drift = abs((axis["measured"] or 0.0) - (first["axes"][name]["measured"] or 0.0))
            figures[f"{name}_age_s"] = axis["measured_age_s"] if axis["measured_age_s"] is not None else "none"
            figures[f"{name}_drift_{axis['unit']}"] = round(drift, 3)
            still = still and drift <= 0.3 and axis["lifecycle"] == "standby"
        self._note("standby: readable, still", ok=still and not faults(second), **figures)

    def step_response(self, name: str, axis: str, unit: str, value: float) -> None:
        """One small relative jog: time to move, time to arrive, overshoot, rest error."""
        if not self.confirmed(f"{axis} by {value:+g} {unit}"):
            self.results.append(Result(name, "skipped"))
            return
        self._arm()
        tolerance = SETTLED_DEG if unit == "deg" else SETTLED_MM
        watched = {"rotate": "rotation", "lift": "lift_left", "tilt": "tilt"}[axis]
        start = self._measured(watched)
        trace = self._jog(axis, value, lambda status: abs(measured(status, watched) - start - value) <= tolerance)
        moved = [(t, y - start) for t, y in ((t, measured(s, watched)) for t, s in trace) if not math.isnan(y)]
        sign = 1.0 if value > 0 else -1.0
        began_s = next((t for t, y in moved if abs(y) > 0.1 * abs(value)), float("nan"))
        peak = max(y * sign for _, y in moved)
        self._client.command("disarm")
        self._note(
            name,
            ok=abs(moved[-1][1] - value) <= tolerance,
            dead_time_s=round(began_s, 3),
            arrival_s=round(moved[-1][0], 3),
            overshoot=round(max(0.0, peak - abs(value)), 3),
            rest_error=round(moved[-1][1] - value, 3),
        )

    def stop_in_motion(self) -> None:
        """Stop while the blade turns slowly: distance and time until it stands."""
        if not self.confirmed("rotate by +10 deg, stopped on the way"):
            self.results.append(Result("stop in motion", "skipped"))
            return
        self._arm()
        start = self._measured("rotation")
        self._jog("rotate", 10.0, lambda status: abs(measured(status, "rotation") - start) > 3.0)
        at, began_s = self._measured("rotation"), time.monotonic()
        self._client.stop()
        wait_for("a stand", lambda: not self._status()["axes"]["rotation"]["moving"], 3.0, 0.02)
        stood_s = time.monotonic() - began_s
        after = self._measured("rotation") - at
        self._client.reset()
        self._note("stop in motion", ok=abs(after) < 5.0, stood_s=round(stood_s, 3), further_deg=round(after, 3))

    def _attempt(self, name: str, motion: Callable[[], None]) -> None:
        """One motion; what the machine refuses or does not do in time is that motion's result, and it is stopped."""
        try:
            motion()
        except (RefusedError, WaitError) as why:
            self._client.stop()
            self._client.reset()
            self._note(name, ok=False, why=str(why))

    def _arm(self) -> None:
        self._client.command("arm")
        wait_for("armed", lambda: self._status()["mode"] in ("manual", "auto"), 10.0)
        self._client.command("manual")

    def _measured(self, axis: str) -> float:
        return measured(self._status(), axis)

    def _jog(self, axis: str, value: float, done: Callable[[Status], bool]) -> list[tuple[float, Status]]:
        """Jog while renewing the lease until ``done`` or time-out; what was seen on the way."""
        began_s, trace = time.monotonic(), []
        with self._client.lease() as lease:
            lease.jog(axis, value, relative=True)
            while time.monotonic() - began_s < STEP_TIMEOUT_S:
                status = self._status()
                trace.append((time.monotonic() - began_s, status))
                if done(status):
                    break
                lease.renew()
                time.sleep(RENEW_S / 2)
        return trace

    def _note(self, name: str, *, ok: bool, **figures: float | str) -> None:
        result = Result(name, "ok" if ok else "FAILED", dict(figures))
        self.results.append(result)
        sys.stdout.write(f"{result.outcome:8}{name}: {figures}\n")


def write_report(results: list[Result], status: Status) -> Path:
    """Keep the figures of one session, with what the machine said it is."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{datetime.now(UTC):%Y%m%d-%H%M%S}.json"
    content = {"version": status["version"], "simulated": status["simulated"], "results": [asdict(r) for r in results]}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def main() -> int:
    """Command line; 2 where it is refused, 1 where a test failed."""
    parser = argparse.ArgumentParser(prog="make bench-hw", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--socket", type=Path, default=SOCKET)
    options = parser.parse_args()
    if os.environ.get("GRADERD_BENCH") != "1" or not sys.stdin.isatty():
        sys.stderr.write(f"bench-hw: refused. {MAY_NOT}\n")
        return 2
    client = Client(options.socket, name="bench-hw")
    try:
        status: Status = client.get("/v1/status")
    except NoDaemonError as error:
        sys.stderr.write(f"bench-hw: {error}\n")
        return 2
    sys.stdout.write(f"{brief(status)}\n")
    bench = Bench(client, input)
    try:
        bench.run()
    except KeyboardInterrupt:
        sys.stderr.write("\nbench-hw: stopped\n")
    sys.stdout.write(f"figures: {write_report(bench.results, status)}\n")
    return 1 if any(result.outcome == "FAILED" for result in bench.results) else 0


if __name__ == "__main__":
    sys.exit(main())
