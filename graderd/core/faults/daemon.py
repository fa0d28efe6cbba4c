"""Faults of the daemon itself. Records may fail without a word to the blade; what delays control may not."""

from graderd.core.faults.monitor import FaultRow, Reaction

ROTATION = frozenset({"rotation"})

ROWS = (
    FaultRow(
        "daemon.tick_overrun",
        "the control tick came late",
        "the computer is too busy, or too slow",
        "end other programs, look at 'graderd status' for tick and camera; lower rates if it stays",
        Reaction.WARN,
    ),
    FaultRow(
        "daemon.loop_blocked",
        "the daemon stood still for a moment; the devices have stopped by themselves",
        "a defect of graderd or of a library, or a computer that has far too much to do",
        "report it with the daemon's log; 'graderd auto' again when the area is clear",
        Reaction.RETREAT,
    ),
    FaultRow(
        "daemon.suspended",
        "the computer slept: what was measured before is older than it looks",
        "its lid was closed, a button was pressed, or its power management put it to sleep",
        "switch sleep off ('systemctl mask sleep.target suspend.target'); arm again when the area is clear",
        # Not only what moved by itself: who armed the machine may have gone long ago.
        Reaction.DISARM,
    ),
    FaultRow(
        "daemon.disk_full",
        "the disk is full: nothing is recorded any more",
        "recordings or other files fill it",
        "make room, or lower recording.max_mb; control goes on",
        Reaction.WARN,
    ),
    FaultRow(
        "daemon.recorder_failed",
        "recording has failed",
        "its directory is missing or may not be written to, or the disk is faulty",
        "look at recording.directory and the disk; control goes on",
        Reaction.WARN,
    ),
    FaultRow(
        "daemon.clock_stepped",
        "the computer's clock was set while running: times in records jump",
        "time synchronisation, or somebody set the clock",
        "nothing: control does not use that clock; mind the jump when reading records",
        Reaction.WARN,
    ),
    FaultRow(
        "daemon.state_file_corrupt",
        "what the daemon remembered from its last run could not be read",
        "a power cut while writing, or a faulty disk",
        "the last stop's reason is lost, and the machine starts stopped: reset; check the disk if it happens again",
        Reaction.WARN,
    ),
    FaultRow(
        "daemon.memory_high",
        "the daemon uses more memory than it should",
        "a defect of graderd or of a library",
        "restart the daemon at the next pause; report it with the daemon's log",
        Reaction.WARN,
        debounce_s=5.0,
    ),
    FaultRow(
        "daemon.perception_nonsense",
        "perception sent what cannot be true",
        "a defect of graderd, or damaged messages between its processes",
        "wait: its process is restarted; report it with the daemon's log",
        Reaction.HOLD,
        axes=ROTATION,
    ),
    FaultRow(
        "daemon.lease_lapsed",
        "a client that moved the blade was not heard in time: the blade holds",
        "the client ended or hangs, or the network stalled",
        "send the jog again",
        Reaction.WARN,
    ),
)
