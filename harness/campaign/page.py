"""Writes the results as a page: ``python -m harness.campaign --page`` (from a full run, or from its JSON file)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.campaign.conduct import BRAKE_S, SLACK_S
from harness.campaign.model import Case, Phase

HEAD = """\
<!-- Written by `make faults ARGS="--page"` from fault-campaign.json beside it; do not edit. -->

# Fault campaign

The daemon as a process against the simulated grader, which speaks the real wires: each fault below is injected while
the machine stands armed (idle), while automatic operation turns the blade (turning), and while a preset moves both
lifts, rotation and tilt together (coordinated lift). `make faults` runs it all, `make faults ARGS="--short --json"`
the part that the tests run; a long run may be taken in parts (`--part 1/2 --output FILE`, at the end `--of FILE FILE`
for this page). `harness/campaign` is the code.

What must happen is derived from the [fault catalogue](../operators/faults.md): reaction, axes held, and what ends the
fault. What did happen is measured on the virtual devices themselves:

- **named**: from the injection until the daemon's status tells the fault. A fault that only shows in motion is counted
  from the command that asks for motion.
- **still**: from the injection until every axis that had to stop stood still for good. Where a fault lets the machine
  go on (*warn*), from a `manual` command given under the fault (marked †). Axes that the fault itself moves (a runaway
  servo, a slipping brake) are left out: no software can stop those.
- **ends**: the mode afterwards; **back**: what it took to be armed and free of faults again, without a restart.

Promised are, for each fault, the time to its name, and {brake:g} s more to standstill; {slack:g} s on top of each are
allowed for the computer that runs everything at once. An injection passes only if name, times, mode, limits, recovery
and the daemon's log (no error line that does not belong to the fault) are all as they should be.
"""
CANNOT = """\
## What this does not show

- The devices are simulated. Times of real servos, actuators, adapters and cameras are measured on the machine.
- Most faults are made from outside: processes are stopped and killed, their memory limited (`prlimit`), files filled,
  damaged and taken away, wires pulled, sockets flooded. Three are made by a hook inside the daemon, because an ordinary
  user cannot make them in another process: a step of the wall clock (the hook lies to the daemon about the time; the
  hardware-in-the-loop suite sets the real clock of its guest), memory that the daemon itself takes (a leak), and an
  event loop that one handler blocks for a second. What the child says when it lies is a child of the tests.
- A real-time guarantee: the figures are of one run on one computer.
"""
PHASES = tuple(phase.value for phase in Phase)


def write(data: dict[str, Any], cases: Sequence[Case], directory: Path) -> None:
    """Write ``fault-campaign.json`` and ``fault-campaign.md`` into ``directory``; ``data``: about and results."""
    (directory / "fault-campaign.json").write_text(
        json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    (directory / "fault-campaign.md").write_text(page(data, cases), encoding="utf-8")


def page(data: dict[str, Any], cases: Sequence[Case]) -> str:
    """The page's text."""
    results = {(r["fault"], r["phase"]): r for r in data["results"]}
    passed_n = sum(r["passed"] for r in data["results"])
    told = data["about"]
    about = (
        f"Measured {told['measured']} on {told['cores']} cores at a load of {told['load']} (15 min mean), "
        f"in {told['took_s'] / 60:.0f} min"
    )
    parts = [HEAD.format(brake=BRAKE_S, slack=SLACK_S), "## Result\n"]
    parts.append(f"{passed_n} of {len(results)} injections passed ({len(cases)} faults). {about}.\n")
    parts.append(_worst(data["results"]))
    header = "| fault | " + " | ".join(f"{phase}: named / still" for phase in PHASES) + " | ends | back |"
    parts.append("## All injections\n\nTimes in seconds.\n\n" + header + "\n|---|" + "---|" * (len(PHASES) + 2))
    for case in cases:
        found = [results.get((case.name, phase)) for phase in PHASES]
        if any(found):
            parts.append(_row(case, found))
    parts.append("\n## What was told\n\n| fault | the daemon's words |\n|---|---|")
    for case in cases:
        message = next((r["message"] for phase in PHASES if (r := results.get((case.name, phase)))), "")
        parts.append(f"| {case.name} | {message.replace('|', '/')} |")
    failed = [r for r in data["results"] if not r["passed"]]
    if failed:
        parts.append("\n## Not passed\n")
        parts += [f"- {r['fault']}, {r['phase']}: {'; '.join(r['problems'])}" for r in failed]
    return "\n".join(parts) + "\n\n" + CANNOT


def _worst(results: Sequence[dict[str, Any]]) -> str:
    own = [r for r in results if r["standstill_from"] == "injection" and r["standstill_s"] is not None]
    worst = max(own, key=lambda r: r["standstill_s"], default=None)
    if worst is None:
        return ""
    return (
        f"The longest time to standstill was {worst['standstill_s']:.2f} s ({worst['fault']}, {worst['phase']}); "
        f"half of all were below {sorted(r['standstill_s'] for r in own)[len(own) // 2]:.2f} s.\n"
    )


def _row(case: Case, found: Sequence[dict[str, Any] | None]) -> str:
    there = [r for r in found if r]
    ends = ", ".join(dict.fromkeys(r["final_state"] for r in there))
    back = "; ".join(dict.fromkeys(r["recovery"] or "—" for r in there))
    cells = " | ".join(_cell(r) for r in found)
    return f"| **{case.name}**: {case.text} | {cells} | {ends} | {back} |"


def _cell(result: dict[str, Any] | None) -> str:
    if result is None:
        return "—"
    mark = "" if result["standstill_from"] == "injection" else "†"
    times = " / ".join("—" if v is None else f"{v:.2f}" for v in (result["detection_s"], result["standstill_s"]))
    return f"{times}{mark}" + ("" if result["passed"] else " **failed**")
