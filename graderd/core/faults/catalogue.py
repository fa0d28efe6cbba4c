"""The fault catalogue: what every fault means, does and wants. The page for operators is generated from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType

from graderd.core.axes import ACTUATORS
from graderd.core.faults import actuator, camera, can, daemon, rotation, stop_input
from graderd.core.faults.monitor import FaultRow, catalogue_key


def _by_key(rows: Iterable[FaultRow]) -> Mapping[str, FaultRow]:
    """Rows by key; a key given twice would hide one of the two, so it is an error."""
    found: dict[str, FaultRow] = {}
    for row in rows:
        if row.key in found:
            raise ValueError(f"the fault catalogue has two rows {row.key}")
        found[row.key] = row
    return MappingProxyType(found)


CATALOGUE: Mapping[str, FaultRow] = _by_key(
    (*rotation.ROWS, *actuator.ROWS, *can.ROWS, *camera.ROWS, *daemon.ROWS, *stop_input.ROWS),
)


def find_rows(name: str) -> tuple[FaultRow, ...]:
    """Rows a person may mean by ``name``: a fault's name (``lift_left.overload``), a row's key
    (``actuator.overload``), or a condition or device alone (``overload``, ``tilt``)."""
    device, _, condition = name.partition(".")
    if condition:
        row = CATALOGUE.get(catalogue_key(device, condition))
        return () if row is None else (row,)
    part = "actuator" if name in ACTUATORS else name
    return tuple(row for row in CATALOGUE.values() if part in row.key.split("."))
