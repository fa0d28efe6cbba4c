"""Virtual Electraks that speak J1939 frames: a physics model, faults on demand, an slcan adapter on a pty."""

from drivers.electrak.virtual.bus import VirtualActuatorBus
from drivers.electrak.virtual.model import VirtualElectrak
from drivers.electrak.virtual.traits import Behaviour
from drivers.electrak.virtual.wire import Wire, WireBus

__all__ = ["Behaviour", "VirtualActuatorBus", "VirtualElectrak", "Wire", "WireBus"]
