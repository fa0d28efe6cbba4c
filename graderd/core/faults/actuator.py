"""Faults of the three linear actuators; axes ``own`` stands for the axis of the one that has it.

An actuator that cannot be heard or is not the one configured may be anywhere: DISARM. So does one that switched off
or stuck in the middle of a move: its driver lets no motion through until it is armed again, and the blade may stand
askew. One that is heard but may not begin a move holds its own axis, the other lift with it; where a person has to go
to it, automatic operation ends too: RETREAT. An actuator rests unpowered on its brake.
"""

from graderd.core.faults.monitor import Clear, FaultRow, Reaction

OWN = frozenset({"own"})
NO_AXIS: frozenset[str] = frozenset()

ROWS = (
    FaultRow(
        "actuator.no_feedback",
        "an actuator is not heard on the bus",
        "no power at it, a broken CAN cable, or another address than configured",
        "check its power, cable and address-select wires; then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "actuator.implausible_feedback",
        "an actuator reports positions that cannot be true",
        "two devices share its address, or its position sensor is faulty",
        "check the address-select wires with 'graderd can dump'; exchange the actuator if it stays; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "actuator.feedback_flood",
        "an actuator is heard more often than one actuator can send",
        "two actuators share one address and obey the same messages, or one babbles",
        "wire the address-select pins so that every actuator has its own; then arm",
        Reaction.DISARM,
        debounce_s=0.3,
    ),
    FaultRow(
        "actuator.overload",
        "an actuator has switched off because its load was too large",
        "the blade pushes against something, or the current limit is too low",
        "free the blade, look at current_limit_a; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
        axes=OWN,
    ),
    FaultRow(
        "actuator.parameter",
        "an actuator refuses graderd's messages as out of its range",
        "profile or settings do not fit this model (stroke, current or speed)",
        "compare profile, max_mm and current_limit_a with the actuator's label; then disarm and arm",
        Reaction.RETREAT,
        clear=Clear.ON_REARM,
        axes=OWN,
    ),
    FaultRow(
        "actuator.saturation",
        "an actuator works close to the most it can do",
        "a heavy load, or a low supply voltage",
        "take smaller cuts; disarm before anybody goes to the supply",
        Reaction.WARN,
        debounce_s=1.0,
    ),
    FaultRow(
        "actuator.backdrive",
        "an actuator is moved by its load",
        "the load is larger than its brake holds, or its brake is worn",
        "lower the blade to the ground, do not stand under or before it; have the actuator's brake checked; then arm",
        Reaction.RETREAT,
        clear=Clear.ON_REARM,
        axes=OWN,
    ),
    FaultRow(
        "actuator.fatal",
        "an actuator reports a fault that needs service",
        "damaged electronics or mechanics",
        "cut and restore its power, then arm; exchange it if the report comes back",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "actuator.voltage",
        "an actuator's supply voltage is out of its range: it begins no new move",
        "a weak battery, a thin or long cable, or another nominal voltage",
        "measure the voltage at the actuator while it moves, correct the supply; then 'graderd auto' again",
        Reaction.RETREAT,
        debounce_s=0.3,
        axes=OWN,
    ),
    FaultRow(
        "actuator.temperature",
        "an actuator is too hot or too cold: it begins no new move",
        "too much work for its duty cycle, or the weather",
        "let it cool, or warm up, before going on",
        Reaction.HOLD,
        debounce_s=0.3,
        axes=OWN,
    ),
    FaultRow(
        "actuator.uncommanded_motion",
        "an actuator moved although it was not told to, or against what it was told",
        "its manual override is used, its load moves it, its brake fails, or another controller commands it",
        "keep away from the blade; look for the cause with 'graderd can dump'; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "actuator.not_moving",
        "an actuator is told to move and does not",
        "it is stuck, too heavily loaded, or at an end of its stroke that the configuration does not know",
        "free the blade, look at min_mm and max_mm; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
        axes=OWN,
    ),
    FaultRow(
        "actuator.not_arriving",
        "an actuator moves and hardly comes nearer to where it is told to go",
        "a load that it barely overcomes, or a low supply voltage",
        "take some load off the blade, measure the voltage at the actuator while it moves; then disarm and arm",
        Reaction.RETREAT,
        clear=Clear.ON_REARM,
        axes=OWN,
    ),
    FaultRow(
        "actuator.overspeed",
        "an actuator moves much faster than it may",
        "its load drives it, its screw or brake is broken, or the load fell off",
        "keep away from the blade; have screw and brake checked; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "actuator.restarted",
        "an actuator has restarted",
        "its power was cut for a moment",
        "check its power connector and fuse; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "actuator.wrong_address",
        "an actuator has taken another address than configured",
        "another device contends for its address, or the address-select wires were changed",
        "give every device on the bus an address of its own; then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "actuator.thermal_derating",
        "an actuator has worked much: it is slowed down before it gets too hot",
        "more moves, or heavier ones, than its duty cycle allows",
        "pause, or move it less; it is full speed again once it has rested",
        Reaction.WARN,
    ),
    FaultRow(
        "actuator.thermal_limit",
        "an actuator has used up what its duty cycle allows: it rests",
        "more moves, or heavier ones, than its duty cycle allows",
        "wait; it is released by itself once it has rested",
        Reaction.HOLD,
        axes=OWN,
    ),
    FaultRow(
        "actuator.sides_apart",
        "the two lifts are further apart than they may be",
        "one side is stuck, slower or more loaded than the other",
        "free the slow side, then level the blade with 'graderd jog slope =0deg'",
        # The lifts stop by themselves where one lags; holding the axis would forbid the very move that levels it.
        Reaction.RETREAT,
        debounce_s=0.2,
        axes=NO_AXIS,
    ),
)
