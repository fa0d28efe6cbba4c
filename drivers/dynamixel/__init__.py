"""Everything that knows Dynamixel: wire protocol, servo bus, the PH54 blade servo, and a virtual one."""

from graderd.drivers.dynamixel.bus import BusTap, ServoBus, ServoRefusedError
from graderd.drivers.dynamixel.device import Difference
from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.dynamixel.safe_off import safe_off

__all__ = ["BusTap", "Difference", "Ph54Rotator", "ServoBus", "ServoRefusedError", "safe_off"]
