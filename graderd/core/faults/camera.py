"""Faults of the camera and of the pictures. Without a good picture there is nothing to go by: the rotation holds.

What comes and goes by itself (a restart of the worker) lets the rule go on afterwards, with fresh votes. What makes
all further decisions doubtful, or sends a person to the lens or the blade, ends automatic operation and leaves the
blade to the operator.
"""

from graderd.core.faults.monitor import FaultRow, Reaction

ROTATION = frozenset({"rotation"})
NO_AXIS: frozenset[str] = frozenset()
AGAIN = "then 'graderd auto' again"
LENS = "clean the lens, look for what stands before it"

ROWS = (
    FaultRow(
        "camera.missing",
        "there is no camera",
        "its cable is pulled, it has no power, or the configuration names another one",
        "check the cable and [camera] serial_number; then 'graderd auto' again",
        Reaction.RETREAT,
        axes=NO_AXIS,
    ),
    FaultRow(
        "camera.stale",
        "the camera has stopped sending pictures",
        "a loose cable, a USB port that fell asleep, or a camera that hangs",
        "wait: the camera is restarted by itself; disarm before anybody goes to its cable",
        Reaction.HOLD,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.black",
        "the picture is black",
        "no light, a covered lens, or an exposure set too short",
        f"switch the work light on, {LENS}, look at exposure_us; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.1,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.blown_out",
        "the picture is too bright to see anything",
        "the sun or a lamp shines into the lens, or the exposure is set too long",
        f"shade the lens, look at exposure_us; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.1,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.blocked",
        "something covers the lens",
        "mud, dust, a leaf or a hand on it",
        f"{LENS}; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.1,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.frozen",
        "the camera sends the same picture again and again",
        "the camera hangs",
        f"pull and plug its cable if it does not go away by itself; {AGAIN}",
        Reaction.RETREAT,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.blurred",
        "the picture is blurred",
        "a dirty or wet lens, or strong shaking",
        f"{LENS}; check the camera's mount; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.5,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.torn",
        "colour and depth do not belong to the same moment",
        "a USB connection that loses data, or a computer that is too busy",
        "disarm, then give it a USB 3 port and a short cable",
        Reaction.HOLD,
        debounce_s=0.3,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.wrong_resolution",
        "the picture has another size than the camera was calibrated at",
        "the [camera] settings were changed, or a USB 2 port allows no larger picture",
        "set the calibrated size, use a USB 3 port, or calibrate again with 'graderd calibrate camera'",
        Reaction.RETREAT,
        axes=NO_AXIS,
    ),
    FaultRow(
        "camera.knocked",
        "the camera no longer looks where it was calibrated",
        "its mount was hit or has come loose",
        "fix the mount and calibrate again with 'graderd calibrate camera'; then 'graderd auto' again",
        Reaction.RETREAT,
        debounce_s=1.0,
        axes=NO_AXIS,
    ),
    FaultRow(
        "camera.blade_elsewhere",
        "the blade is not where its measured angle and lifts say",
        "a slipped horn or linkage, or lifts and angle that were set up wrongly",
        "compare blade and 'graderd status'; mend the linkage or correct [attitude] and [rotation]; "
        "then 'graderd auto' again",
        Reaction.RETREAT,
        debounce_s=1.0,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.obstructed",
        "something that is no soil stands before the blade",
        "a person, a post or another tall thing in the blade's zone",
        f"see that everybody is clear of the blade and nothing stands before it; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.1,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.depth_missing",
        "the camera gives no depth, or too little",
        "direct sun, a shiny or wet blade, or a stream that has stopped",
        f"shade the blade, paint it matt; pull and plug the camera if it stays; {AGAIN}",
        Reaction.RETREAT,
        debounce_s=0.5,
        axes=ROTATION,
        automatic_only=True,
    ),
    FaultRow(
        "camera.worker_restarted",
        "the program that reads the camera ended and was started again",
        "a fault in the camera's driver, or too little memory",
        "nothing, if it happens seldom; else report it with the daemon's log",
        Reaction.WARN,
    ),
    FaultRow(
        "camera.worker_hung",
        "the program that reads the camera hung; it was killed and started again",
        "the camera's driver hangs, often after a USB disturbance",
        "disarm before you check the camera's cable; report it with the daemon's log if it comes back",
        Reaction.WARN,
    ),
    FaultRow(
        "camera.settings_not_kept",
        "the camera did not take a setting",
        "the value is outside its range, or another setting overrules it",
        "see 'graderd status --json' for what it took; correct the [camera] section",
        Reaction.WARN,
    ),
)
