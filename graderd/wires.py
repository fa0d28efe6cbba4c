"""What is plugged in: serial adapters, CAN interfaces, cameras; of this computer, or of a simulated grader's folder.

Names are found and nothing is opened: looking disturbs nobody.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from graderd.doctor import realsense_cameras

if TYPE_CHECKING:
    from graderd.config import Config

ARPHRD_CAN = 280
"""The kernel's number for a CAN interface (``include/uapi/linux/if_arp.h``)."""

RIG_ADAPTERS = ("servo", "can")
"""Names in a rig's folder that come and go with their plugs (docs/developers/rig.md)."""


class Wires(Protocol):
    """Where to look. Each answer is by name, with what a person knows it by."""

    def serial_ports(self) -> dict[str, str]:
        """Serial ports of adapters, by a path that stays when it is plugged in again."""
        ...

    def can_interfaces(self) -> dict[str, str]:
        """CAN network interfaces."""
        ...

    def cameras(self) -> dict[str, str]:
        """Cameras, by serial number."""
        ...

    def camera_settings(self, name: str) -> dict[str, Any]:
        """The sections of the configuration that make the camera ``name`` the one that is used."""
        ...

    def stop_loops(self) -> dict[str, str]:
        """Stop loops that need no line of an adapter: name of the backend by port."""
        ...


@dataclass(frozen=True)
class MachineWires:
    """This computer's. ``root``: ``/``, or a test's own."""

    root: Path = Path("/")

    def serial_ports(self) -> dict[str, str]:
        from serial.tools.list_ports import comports

        names = {path.resolve(): path for path in sorted((self.root / "dev/serial/by-id").glob("*"))}
        found = {}
        for port in comports():
            if port.vid is None:  # a port on the board, which is there whatever is plugged in
                continue
            path = names.get(Path(port.device).resolve(), Path(port.device))
            told = (port.manufacturer, port.product, port.serial_number, port.device)
            found[str(path)] = " ".join(word for word in told if word)
        return found

    def can_interfaces(self) -> dict[str, str]:
        found = {}
        for kind in sorted((self.root / "sys/class/net").glob("*/type")):
            if kind.read_text(encoding="ascii").strip() == str(ARPHRD_CAN):
                state = (kind.parent / "operstate").read_text(encoding="ascii").strip()
                found[kind.parent.name] = f"CAN interface, {state}"
        return found

    def cameras(self) -> dict[str, str]:
        return {one.serial: f"{one.product}, {one.speed_mbit_per_s} Mbit/s" for one in realsense_cameras(self.root)}

    def camera_settings(self, name: str) -> dict[str, Any]:
        return {"camera": {"source": "realsense", "serial_number": name}}

    def stop_loops(self) -> dict[str, str]:
        return {}


@dataclass(frozen=True)
class RigWires:
    """A simulated grader's, by its folder. ``config``: one that runs on it (``graderd.runtime.app.on_rig``)."""

    directory: Path
    config: Config

    def serial_ports(self) -> dict[str, str]:
        ports = [self.directory / name for name in RIG_ADAPTERS]
        return {str(port): "simulated serial adapter" for port in ports if port.exists()}

    def can_interfaces(self) -> dict[str, str]:
        can = self.config.can
        return {} if can.interface == "slcan" else {str(can.channel): f"simulated actuators' bus ({can.interface})"}

    def cameras(self) -> dict[str, str]:
        return {"simulated": "simulated RealSense D455"}

    def camera_settings(self, name: str) -> dict[str, Any]:
        del name
        camera, decision = self.config.camera, self.config.perception.decision
        streams = ("color_width_px", "color_height_px", "depth_width_px", "depth_height_px", "rate_hz")
        return {
            "simulated": True,
            "camera": {name: getattr(camera, name) for name in ("source", "path", *streams)},
            "perception": {"decision": {"max_frame_age_s": decision.max_frame_age_s}},
            "vehicle": {"source": self.config.vehicle.source, "path": self.config.vehicle.path},
        }

    def stop_loops(self) -> dict[str, str]:
        return {"simulated": self.config.stop_input.port}
