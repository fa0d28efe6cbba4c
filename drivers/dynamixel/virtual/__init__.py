"""A complete Protocol 2.0 slave with the PH54's control table, motion and faults, on a pseudo-terminal.

``python -m drivers.dynamixel.virtual --link PATH`` runs it alone; tests and the rig use the classes.
"""

from drivers.dynamixel.virtual.bus import VirtualServoBus
from drivers.dynamixel.virtual.faults import FAULTS, FaultKind
from drivers.dynamixel.virtual.motion import PlantSettings
from drivers.dynamixel.virtual.servo import VirtualServo

__all__ = ["FAULTS", "FaultKind", "PlantSettings", "VirtualServo", "VirtualServoBus"]
