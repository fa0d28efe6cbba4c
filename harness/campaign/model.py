"""What a case of the campaign is, and what becomes of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.campaign.stack import Stack

ROTATION = frozenset({"rotation"})
LIFT = frozenset({"lift"})
TILT = frozenset({"tilt"})
NONE: frozenset[str] = frozenset()


class Phase(StrEnum):
    """What the machine does when the fault strikes.

    IDLE: armed, manual, standing. TURNING: automatic operation swings the blade to where the soil asks for it.
    LIFTING: a preset moves both lifts together, and rotation and tilt with them.
    """

    IDLE = "idle"
    TURNING = "turning"
    LIFTING = "coordinated lift"


Action = Callable[["Stack"], Awaitable[None]]


@dataclass
class Outcome:
    """One injection, measured. Times in seconds from the injection unless said otherwise.

    ``detection_s``: until the daemon's status named the fault. ``standstill_s``: until every axis that had to stop
    stood still for good on the virtual devices; where nothing had to stop, the time from a ``manual`` command given
    under the fault to standstill. ``problems``: every expectation that was not met; empty means passed.
    """

    fault: str
    phase: str
    detected: bool = False
    detection_s: float | None = None
    named: str = ""
    safe: bool = False
    standstill_s: float | None = None
    standstill_from: str = "injection"
    final_state: str = ""
    expected_state: str = ""
    recovered_as_catalogued: bool = False
    message: str = ""
    recovery: str = ""
    seen: tuple[str, ...] = ()
    problems: list[str] = field(default_factory=list)
    took_s: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether everything was as the catalogue says."""
        return self.detected and self.safe and self.recovered_as_catalogued and not self.problems

    def as_json(self) -> dict[str, Any]:
        """For the results' line and file."""
        found = asdict(self) | {"passed": self.passed}
        return {key: round(value, 3) if isinstance(value, float) else value for key, value in found.items()}


Conduct = Callable[["Stack", "Case", Phase, Outcome], Awaitable[None]]


@dataclass(frozen=True)
class Case:
    """One fault of the table.

    ``faults``: names the daemon may give it; the first decides what must happen. With ``either`` the one that the
    daemon gave decides: each is as true, and which comes first depends on where the axes are. ``needs``: the axis
    that has to be commanded for the fault to show; in a phase where it is not, it is commanded after the injection
    and times count from there. ``detect_s``: promised time to detection. ``own_motion``: axes the fault itself
    moves, which no software can stop. ``hidden_by``: an axis whose lift hides the fault, because the drive makes up
    for it; times count from where that axis stands. ``repair``: takes the cause away. ``before_arm``: what the
    remedy asks of a person first. ``log_errors``: error lines of the daemon's log that belong to the fault.
    ``conduct``: how it is run where the general way does not fit (the daemon itself dies, say). ``short``: phases
    of the shortened campaign.
    """

    name: str
    text: str
    faults: tuple[str, ...]
    inject: Action
    repair: Action
    needs: str = ""
    either: bool = False
    detect_s: float = 0.6
    recover_s: float = 12.0
    stand_s: float | None = None
    own_motion: frozenset[str] = NONE
    hidden_by: str = ""
    before_arm: Action | None = None
    log_errors: tuple[str, ...] = ()
    conduct: Conduct | None = None
    short: tuple[Phase, ...] = ()

    @property
    def group(self) -> str:
        """Part of the machine: the name's first word."""
        return self.name.partition("_")[0]
