"""Virtual Electraks that speak J1939 frames: a physics model, faults on demand, an slcan adapter on a pty."""

from graderd.simulator.actuators.bus import VirtualActuatorBus
from graderd.simulator.actuators.model import VirtualElectrak
from graderd.simulator.actuators.motor import Behaviour
from graderd.simulator.actuators.wire import Wire, WireBus

__all__ = ["Behaviour", "VirtualActuatorBus", "VirtualElectrak", "Wire", "WireBus"]
