"""``python -m tests.fault.campaign``: run the campaign, print a table or one JSON line, write JSON and page."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from tests.fault.campaign.conduct import run_case
from tests.fault.campaign.daemon import BREAKS
from tests.fault.campaign.model import Case, Outcome, Phase
from tests.fault.campaign.page import write
from tests.fault.campaign.stack import Stack
from tests.fault.campaign.table import ACTUATOR, CAMERA, CAN, SERVO
from tests.fault.campaign.table_daemon import DAEMON, PERCEPTION

CASES: tuple[Case, ...] = (*CAMERA, *PERCEPTION, *SERVO, *CAN, *ACTUATOR, *DAEMON)


def chosen(short: bool, faults: list[str], phases: list[str]) -> list[tuple[Case, Phase]]:
    """The injections to run."""
    pairs = [(case, phase) for case in CASES for phase in (case.short if short else tuple(Phase))]
    return [
        (case, phase)
        for case, phase in pairs
        if (not faults or case.name in faults) and (not phases or phase.value in phases)
    ]


async def run(pairs: list[tuple[Case, Phase]], broken: str, quiet: bool, output: Path | None) -> list[Outcome]:
    """Run the injections one after the other on one machine; ``output`` is written anew after each."""
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="graderd-faults-") as directory:
        async with Stack(Path(directory), broken) as stack:
            for case, phase in pairs:
                outcome = await run_case(stack, case, phase)
                outcomes.append(outcome)
                if output is not None:
                    _save(output, outcomes)
                if not quiet:
                    sys.stdout.write(_line(outcome) + "\n")
                    sys.stdout.flush()
    return outcomes


def _save(output: Path, outcomes: list[Outcome]) -> None:
    results = {"results": [outcome.as_json() for outcome in outcomes]}
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


def _about(took_s: float) -> dict[str, object]:
    """Where and when the results were measured."""
    return {
        "measured": f"{datetime.now(UTC):%Y-%m-%d}",
        "cores": os.cpu_count(),
        "load": f"{os.getloadavg()[2]:.1f} (15 min mean)",
        "took": f"{took_s / 60:.0f} min",
    }


def main() -> int:
    """Command line. Status 0 where every injection passed."""
    parser = argparse.ArgumentParser(prog="make faults ARGS=", description=__doc__)
    parser.add_argument("--short", action="store_true", help="the shortened campaign (at least 20 injections)")
    parser.add_argument("--json", action="store_true", help="print nothing but a last line with all results")
    parser.add_argument("--fault", action="append", default=[], metavar="NAME", help="only this one (repeatable)")
    parser.add_argument("--phase", action="append", default=[], choices=[p.value for p in Phase])
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--output", type=Path, help="write the results as JSON")
    parser.add_argument("--page", action="store_true", help="write docs/integrators/fault-campaign.{md,json}")
    parser.add_argument("--break", dest="broken", default="", choices=["", *BREAKS], help="spoil one reaction")
    options = parser.parse_args()
    if options.list:
        sys.stdout.writelines(f"{case.name:24} {case.text}\n" for case in CASES)
        return 0
    pairs = chosen(options.short, options.fault, options.phase)
    began_s = time.monotonic()
    outcomes = asyncio.run(run(pairs, options.broken, options.json, options.output))
    results = {"results": [outcome.as_json() for outcome in outcomes]}
    if options.page:
        write(results["results"], CASES, _about(time.monotonic() - began_s), Path("docs/integrators"))
    good_n = sum(outcome.passed for outcome in outcomes)
    if options.json:
        sys.stdout.write(json.dumps(results) + "\n")
    else:
        sys.stdout.write(f"{good_n} of {len(outcomes)} injections passed in {time.monotonic() - began_s:.0f} s\n")
    return 0 if good_n == len(outcomes) and outcomes else 1


if __name__ == "__main__":
    sys.exit(main())
