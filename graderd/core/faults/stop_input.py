"""Faults of the stop input. Whatever is not a closed loop that answers is a stop, and stays one until reset."""

from graderd.core.faults.monitor import Clear, FaultRow, Reaction

ROWS = (
    FaultRow(
        "stop_input.open",
        "the stop loop is open: somebody has pressed stop, or opened a gate",
        "a pressed button, an open gate, a cut wire or a pulled plug in the loop",
        "see who stopped and why; release the button, close the gate; then reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
    FaultRow(
        "stop_input.lost",
        "the stop loop cannot be read: its adapter is gone",
        "its plug was pulled, it lost power, or the configuration names another port",
        "plug the adapter in, look at stop_input.port; then reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
    FaultRow(
        "stop_input.stale",
        "the stop loop was not read for too long",
        "its adapter hangs, or the computer is too busy",
        "pull and plug the adapter if it stays; then reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
    FaultRow(
        "stop_input.stuck",
        "the stop loop would not show a press: it reads closed though nothing drives it",
        "a short circuit between the loop's wires, or a faulty adapter",
        "look for the short circuit, exchange the adapter; then reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
)
