"""Thomson Electrak HD and MD actuators on SAE J1939."""

from drivers.electrak.actuator import ElectrakActuator
from drivers.electrak.link import CanLink
from drivers.electrak.safe_off import safe_off

__all__ = ["CanLink", "ElectrakActuator", "safe_off"]
