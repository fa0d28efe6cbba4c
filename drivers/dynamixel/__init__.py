"""Everything that knows Dynamixel: wire protocol, servo bus, the PH54 blade servo, and a virtual one."""

from drivers.dynamixel.bus import BusLog, ServoBus, ServoRefusedError
from drivers.dynamixel.device import Difference
from drivers.dynamixel.guard import safe_off
from drivers.dynamixel.ph54 import Ph54Rotator

__all__ = ["BusLog", "Difference", "Ph54Rotator", "ServoBus", "ServoRefusedError", "safe_off"]
