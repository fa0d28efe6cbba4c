"""A complete Protocol 2.0 slave with the PH54's control table, motion and faults, on a pseudo-terminal.

``python -m graderd.simulator.servo --link PATH`` runs it alone; tests and the rig use the classes.
"""

from graderd.simulator.servo.bus import VirtualServoBus
from graderd.simulator.servo.faults import FAULTS, FaultKind
from graderd.simulator.servo.motion import PlantSettings
from graderd.simulator.servo.servo import VirtualServo

__all__ = ["FAULTS", "FaultKind", "PlantSettings", "VirtualServo", "VirtualServoBus"]
