"""``python -m harness.campaign``: run the campaign, print a table or one JSON line, write JSON and page."""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import os
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from harness.campaign.conduct import run_case
from harness.campaign.daemon import BREAKS
from harness.campaign.model import Case, Outcome, Phase
from harness.campaign.page import write
from harness.campaign.stack import Stack
from harness.campaign.table import ACTUATOR, CAMERA, CAN, SERVO
from harness.campaign.table_daemon import DAEMON, PERCEPTION

CASES: tuple[Case, ...] = (*CAMERA, *PERCEPTION, *SERVO, *CAN, *ACTUATOR, *DAEMON)
PAGES = Path("docs/integrators")


def chosen(
    short: bool, faults: list[str], phases: list[str], part: tuple[int, int] = (1, 1)
) -> list[tuple[Case, Phase]]:
    """The injections to run; ``part`` is which of how many equal parts of the table."""
    number, parts_n = part
    cases = [case for case in CASES if not faults or case.name in faults]
    cases = cases[len(cases) * (number - 1) // parts_n : len(cases) * number // parts_n]
    pairs = [(case, phase) for case in cases for phase in (case.short if short else tuple(Phase))]
    return [(case, phase) for case, phase in pairs if not phases or phase.value in phases]


async def run(pairs: list[tuple[Case, Phase]], broken: str, quiet: bool, output: Path | None) -> list[Outcome]:
    """Run the injections one after the other on one machine; ``output`` is written anew after each."""
    gc.collect()
    gc.freeze()  # a client that stands still for a full collection loses its lease
    outcomes, began_s = [], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="graderd-faults-") as directory:
        async with Stack(Path(directory), broken) as stack:
            for case, phase in pairs:
                outcome = await run_case(stack, case, phase)
                outcomes.append(outcome)
                if output is not None:
                    _save(output, outcomes, began_s)
                if not quiet:
                    sys.stdout.write(_line(outcome) + "\n")
                    sys.stdout.flush()
    return outcomes


def _save(output: Path, outcomes: list[Outcome], began_s: float) -> None:
    results = {"about": about(time.monotonic() - began_s), "results": [outcome.as_json() for outcome in outcomes]}
    output.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _line(outcome: Outcome) -> str:
    def seconds(value: float | None) -> str:
        return "    —" if value is None else f"{value:5.2f}"

    verdict = "ok " if outcome.passed else "BAD"
    text = (
        f"{verdict} {outcome.fault:24} {outcome.phase:16} named {seconds(outcome.detection_s)} s, "
        f"still {seconds(outcome.standstill_s)} s, {outcome.final_state:9} {outcome.recovery} [{outcome.took_s:.1f} s]"
    )
    return "\n      ".join([text, *outcome.problems])


def about(took_s: float) -> dict[str, Any]:
    """Where and when results were measured."""
    return {
        "measured": f"{datetime.now(UTC):%Y-%m-%d}",
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[2], 1),
        "took_s": round(took_s),
    }


def joined(files: list[Path]) -> dict[str, Any]:
    """The results of several parts as one run's."""
    parts = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    notes = [part["about"] for part in parts]
    return {
        "about": notes[-1]
        | {"load": max(note["load"] for note in notes), "took_s": sum(note["took_s"] for note in notes)},
        "results": [result for part in parts for result in part["results"]],
    }


def _part(text: str) -> tuple[int, int]:
    number, _, parts_n = text.partition("/")
    if not 1 <= int(number) <= int(parts_n):
        raise ValueError
    return int(number), int(parts_n)


def main() -> int:
    """Command line. Status 0 where every injection passed."""
    parser = argparse.ArgumentParser(prog="make faults ARGS=", description=__doc__)
    parser.add_argument("--short", action="store_true", help="the shortened campaign (at least 20 injections)")
    parser.add_argument("--json", action="store_true", help="print nothing but a last line with all results")
    parser.add_argument("--fault", action="append", default=[], metavar="NAME", help="only this one (repeatable)")
    parser.add_argument("--phase", action="append", default=[], choices=[p.value for p in Phase])
    parser.add_argument("--part", type=_part, default=(1, 1), metavar="K/N", help="the K-th of N parts of the table")
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--output", type=Path, help="write the results as JSON")
    parser.add_argument("--page", action="store_true", help="write docs/integrators/fault-campaign.{md,json}")
    parser.add_argument(
        "--of", type=Path, nargs="+", metavar="FILE", help="run nothing: the page of parts saved with --output"
    )
    parser.add_argument("--break", dest="broken", default="", choices=["", *BREAKS], help="spoil one reaction")
    options = parser.parse_args()
    if options.list:
        sys.stdout.writelines(f"{case.name:24} {case.text}\n" for case in CASES)
        return 0
    if options.of:
        data = joined(options.of)
        write(data, CASES, PAGES)
        return 0 if data["results"] and all(result["passed"] for result in data["results"]) else 1
    pairs = chosen(options.short, options.fault, options.phase, options.part)
    began_s = time.monotonic()
    outcomes = asyncio.run(run(pairs, options.broken, options.json, options.output))
    results: dict[str, Any] = {"results": [outcome.as_json() for outcome in outcomes]}
    if options.page:
        write(results | {"about": about(time.monotonic() - began_s)}, CASES, PAGES)
    good_n = sum(outcome.passed for outcome in outcomes)
    if options.json:
        sys.stdout.write(json.dumps(results) + "\n")
    else:
        sys.stdout.write(f"{good_n} of {len(outcomes)} injections passed in {time.monotonic() - began_s:.0f} s\n")
    return 0 if good_n == len(outcomes) and outcomes else 1


if __name__ == "__main__":
    sys.exit(main())
