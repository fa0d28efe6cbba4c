"""candump text, both ways: one CAN frame a line, the form that every CAN tool reads."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

from drivers.electrak.j1939.ids import Frame

# candump -l / -L:  (1622749162.123456) can0 18EF1300#DC05191500000000
_COMPACT: Final = re.compile(
    r"^\s*(?:\((?P<t>\d+(?:\.\d+)?)\)\s+)?\S+\s+(?P<id>[0-9A-Fa-f]{3,8})#(?P<data>[0-9A-Fa-f]*)"
)
# candump, also with -t and -x:  (0.105000)  can0  TX - -  18EF1300   [8]  DC 05 19 15 00 00 00 00
_COLUMNS: Final = re.compile(
    r"^\s*(?:\((?P<t>[^)]*)\)\s+)?\S+\s+(?:[RT]X\s+\S+\s+\S+\s+)?(?P<id>[0-9A-Fa-f]{3,8})\s+\[(?P<n>\d)\]\s*"
    r"(?P<data>(?:[0-9A-Fa-f]{2}\s?)*)"
)

Timed = tuple[float, Frame]


def parse_candump_line(line: str) -> Timed | None:
    """One line of candump text (any of its formats), or None where it is no data frame."""
    match = _COMPACT.match(line) or _COLUMNS.match(line)
    if match is None:
        return None
    digits = match["id"]
    data = re.sub(r"\s", "", match["data"])
    if len(data) % 2 or len(data) > 16:
        return None
    try:
        t_s = float(match["t"] or 0.0)
    except ValueError:  # candump -tA writes a date
        t_s = 0.0
    return t_s, Frame(int(digits, 16) & 0x1FFFFFFF, bytes.fromhex(data), len(digits) > 3)


def parse_candump(lines: Iterable[str]) -> Iterator[Timed]:
    """The frames of many lines; what is none is left out."""
    for line in lines:
        timed = parse_candump_line(line)
        if timed is not None:
            yield timed


def candump_line(frame: Frame, t_s: float, channel: str = "can0") -> str:
    """One frame as ``candump -L`` writes it."""
    return f"({t_s:.6f}) {channel} {frame.can_id:0{8 if frame.extended else 3}X}#{frame.data.hex().upper()}"
