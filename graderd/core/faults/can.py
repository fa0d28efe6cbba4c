"""Faults of the CAN bus. While the bus is lost no actuator can be told to stop: DISARM; a disturbed bus is told."""

from graderd.core.axes import ACTUATORS, PARTS
from graderd.core.faults.monitor import Clear, FaultRow, Reaction

BOTH_KINDS = frozenset(PARTS[name] for name in ACTUATORS)

ROWS = (
    FaultRow(
        "can.interface_down",
        "the CAN interface is down",
        "it was switched off, or never brought up",
        "bring it up ('ip link set can0 up type can bitrate 250000', or start its service); then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "can.unplugged",
        "the CAN adapter is gone",
        "its plug was pulled, or it lost power",
        "plug it in again; the bus is opened again by itself, then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "can.adapter_refuses",
        "the CAN adapter does not send what it is given",
        "it lost power for a moment and forgot its channel, its bit rate is not one it knows, or nobody acknowledges",
        "graderd opens its channel again by itself; where that does not help, pull it and plug it in; then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "can.bus_off",
        "the CAN controller has left the bus after too many errors",
        "a short circuit, a wrong bit rate somewhere, or missing terminators",
        "check wiring, the two 120 ohm terminators and every device's bit rate (250 kbit/s); then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "can.error_passive",
        "the CAN bus is badly disturbed",
        "a loose connector, a missing terminator, or no other device on the bus",
        "disarm, then check connectors and terminators before the bus is lost",
        Reaction.WARN,
        debounce_s=0.2,
    ),
    FaultRow(
        "can.queue_overrun",
        "CAN messages were lost in a full queue",
        "more traffic than the computer or the adapter takes, or nobody on the bus acknowledges",
        "see 'graderd can dump' for who sends so much; raise the interface's queue length",
        Reaction.WARN,
    ),
    FaultRow(
        "can.address_conflict",
        "another device on the CAN bus uses graderd's address",
        "a second controller, or a second graderd, with the same address or name",
        "give it another address, or graderd another source_address_n; then arm",
        # Messages that look like ours may command the actuators.
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "can.cannot_claim",
        "graderd has no address on the CAN bus and may not send",
        "its address is taken by a device of higher priority, and no other is free, allowed or left to it",
        "free the address or choose another source_address_n; then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "can.claim_storm",
        "another device claims graderd's address on the CAN bus without end",
        "two devices with equal NAMEs, or a faulty one",
        "disarm, then give one of them another NAME or address",
        Reaction.HOLD,
        axes=BOTH_KINDS,
    ),
    FaultRow(
        "can.flood",
        "there is far more traffic on the CAN bus than the machine needs",
        "a babbling device, or a second network connected to this one",
        "see 'graderd can dump' for who sends so much",
        Reaction.WARN,
        debounce_s=0.5,
    ),
)
