"""Thomson Electrak HD and MD actuators on SAE J1939."""

from graderd.drivers.electrak.actuator import ElectrakActuator
from graderd.drivers.electrak.safe_off import safe_off
from graderd.drivers.j1939.link import CanLink

__all__ = ["CanLink", "ElectrakActuator", "safe_off"]
