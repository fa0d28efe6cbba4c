"""Faults of the servo that turns the blade, and of its bus.

A servo that is lost, alarmed or not in the state it was put into cannot be commanded: DISARM. A blade that moves
where nobody sent it is the most dangerous thing this machine can do: STOP, until a person has looked.
"""

from graderd.core.faults import Clear, FaultRow, Reaction

ROTATION = frozenset({"rotation"})
REBOOT = "take the load off the blade, 'graderd rotation reboot', then arm"

ROWS = (
    FaultRow(
        "rotation.no_reply",
        "the blade servo does not answer",
        "no power at the servo, a loose RS-485 connector, another baud rate or servo id, or the adapter hangs",
        "check the servo's power and bus cable; it is found again by itself, then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "rotation.corrupt_replies",
        "answers of the blade servo arrive damaged",
        "a disturbed or badly terminated RS-485 line, a loose shield, or two servos with one id",
        "check cable, shield and termination; keep the line away from motor cables",
        Reaction.HOLD,
        debounce_s=0.2,
        axes=ROTATION,
    ),
    FaultRow(
        "rotation.wrong_device",
        "what answers is not the servo the configuration names, or it is set up differently",
        "another servo or firmware, or its limits, mode or drive settings were changed",
        "'graderd profile verify rotation' lists the differences; correct the servo or the configuration, then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "rotation.alert_voltage",
        "the blade servo reports a supply voltage outside its limits",
        "a weak battery or supply, a thin or long cable, or braking energy that nothing takes up",
        f"measure the voltage at the servo under load and correct the supply; then {REBOOT}",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.alert_hall_sensor",
        "the blade servo reports a fault of its motor's hall sensor",
        "a damaged servo",
        f"{REBOOT}; exchange the servo if it comes back",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.alert_overheating",
        "the blade servo has switched off because it is too hot",
        "too much load for too long, or no air around it",
        f"let it cool and find what loads it; then {REBOOT}",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.alert_encoder",
        "the blade servo reports a fault of its encoder: its angle cannot be trusted",
        "a damaged servo, or a strong shock",
        f"{REBOOT}; exchange the servo if it comes back",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.alert_electrical_shock",
        "the blade servo reports an electrical shock or too little power for its motor",
        "a short circuit, a supply that cannot give the current, or a loose power connector",
        f"check supply and wiring; then {REBOOT}",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.alert_overload",
        "the blade servo has switched off because the load was too large for too long",
        "the blade is stuck in the ground or against something",
        f"lift and free the blade; then {REBOOT}",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.watchdog_tripped",
        "the blade servo stopped by itself because no command reached it in time",
        "the daemon, the computer or the bus stood still for longer than the watchdog allows",
        "see what else was reported at that moment; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.ram_reset",
        "the blade servo has restarted and forgotten its limits and torque",
        "its power was cut for a moment",
        "check the servo's power connector; then arm, which writes everything again",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.turns_lost",
        "the blade servo lost count of its turns: the blade's angle may be wrong by whole turns of the servo",
        "a restart of the servo while it stood outside one turn",
        "compare the blade with the angle shown (if they differ: bring it near square by hand, reboot the servo), "
        "'graderd rotation confirm-turns'; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.torque_off",
        "the blade servo's torque is off although it was switched on",
        "the servo protected itself, restarted, or another program uses the bus",
        "look for an alert of the servo; end other programs on its port; then arm",
        Reaction.DISARM,
        clear=Clear.ON_REARM,
    ),
    FaultRow(
        "rotation.not_moving",
        "the blade is told to turn and does not",
        "the blade is stuck, the load is too large for the current limit, or the coupling slips",
        "lift and free the blade, look at coupling and current limit; then disarm and arm",
        Reaction.HOLD,
        clear=Clear.ON_REARM,
        axes=ROTATION,
    ),
    FaultRow(
        "rotation.moving_uncommanded",
        "the blade turns although nobody told it to",
        "an overwhelming outer force, a broken coupling, a faulty servo, or another program on its bus",
        "keep away, use the emergency stop; find the cause before reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
    FaultRow(
        "rotation.wrong_way",
        "the blade turns away from where it was told to go",
        "sign or gear_ratio of the calibration is wrong, the encoder is faulty, or a load drives the blade",
        "keep away; check the sign with 'graderd jog rotate +2deg' and a lifted blade after reset and arm",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    ),
    FaultRow(
        "rotation.voltage_near_limit",
        "the blade servo's supply voltage is close to its limit",
        "the battery runs low, or braking drives the voltage up",
        "charge or exchange the battery soon; look at the supply's cable",
        Reaction.WARN,
        debounce_s=0.5,
    ),
    FaultRow(
        "rotation.temperature_near_limit",
        "the blade servo is getting hot",
        "a heavy load for a long time, or no air around it",
        "take some load off or pause, before it switches off",
        Reaction.WARN,
        debounce_s=1.0,
    ),
    FaultRow(
        "rotation.unplugged",
        "the blade servo's adapter is gone",
        "its USB plug was pulled, or the hub lost power",
        "plug it in again, in any port; it is found by its serial number, then arm",
        Reaction.DISARM,
    ),
    FaultRow(
        "servo_bus.adapter_latency",
        "the servo's USB adapter collects its bytes for longer than it should",
        "its latency timer could not be set to 1 ms: no right to, or a driver without one",
        "install graderd's udev rule, or set the latency timer to 1 ms by hand",
        Reaction.WARN,
    ),
)
