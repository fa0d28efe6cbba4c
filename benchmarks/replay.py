"""How fast a recording is decided again: ``python -m benchmarks.replay [--minutes 60]``. Bar: 20 times real time.

A recording without pictures is made of a stretch of work over and over, in virtual time, then checked on one core; the
same file twice, and the findings compared.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from pathlib import Path

from graderd.record.reader import Recording
from graderd.record.replay import check
from harness.recording import record_in_virtual_time


def main() -> int:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = record_in_virtual_time(Path(folder), options.minutes * 60.0)
        found = []
        spent_s = []
        for _ in range(2):
            began_s = time.process_time()
            found.append(check(Recording(path)))
            spent_s.append(time.process_time() - began_s)
        told = {
            "minutes": options.minutes,
            "size_mb": round(path.stat().st_size / 1e6, 1),
            "ticks_n": found[0].ticks_n,
            "differences_n": len(found[0].differences),
            "twice_the_same": all(a == b for a, b in itertools.pairwise(found)),
            "times_real_time": round(options.minutes * 60.0 / max(spent_s), 1),
        }
    print(json.dumps(told))
    return 0


if __name__ == "__main__":
    sys.exit(main())
