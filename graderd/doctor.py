"""What is wrong with this computer, its wires and this installation, each with the command that repairs it.

Looks and asks, and changes nothing: it may run beside a daemon, as any user, and says where it may not look. All is
read below one root directory, so that a test gives it a machine of its own.
"""

from __future__ import annotations

import grp
import json
import os
import platform
import pwd
import re
import shutil
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from graderd import places

if TYPE_CHECKING:
    from graderd.config import Config

PACKAGES: Final = ("graderd", "pydantic", "numpy", "opencv-python-headless", "pyserial", "python-can", "fastapi")
CAMERA_VENDOR: Final = "8086"
FTDI_LATENCY_MOST_MS: Final = 2
CAN_QUEUE_LEAST_N: Final = 128
"""What ``systemd/can-link`` sets: with the kernel's 10, three actuators' messages fill the queue of a bus that stalls
for a third of a second, and what is said after them is refused."""
FREE_LEAST_MB: Final = 500.0
RUN_S: Final = 5.0
USB3_MBIT_PER_S: Final = 5000
FIRMWARE_REPAIR: Final = (
    "end the daemon; rs-fw-update -f FILE.bin (librealsense's tool; firmware from Intel's page of D400 releases)"
)


class Verdict(StrEnum):
    """How a check came out. NOTE: it could not be made, or is nothing to judge."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, how it came out, what was seen, and the command that repairs it."""

    check: str
    verdict: Verdict
    seen: str
    repair: str = ""


def run_command(*command: str) -> str | None:
    """What a program of the system says; None where there is none, or it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RUN_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class Machine:
    """Where to look. ``root``: ``/``, or a test's own; ``run``: asks a program; ``status``: of the daemon that answers,
    or None; ``service``: asks one of its services that only read; ``user``: who runs the daemon, and so needs the
    rights (empty: who asks)."""

    config: Config
    root: Path = Path("/")
    run: Callable[..., str | None] = run_command
    status: Mapping[str, Any] | None = None
    service: Callable[[str], Mapping[str, Any]] | None = None
    user: str = ""

    def at(self, path: str | Path) -> Path:
        """A path of the machine's."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str | None:
        """A file's text, None where it cannot be read."""
        try:
            return self.at(path).read_text("utf-8", "replace").strip()
        except OSError:
            return None


def examine(machine: Machine, refusals: list[str]) -> list[Finding]:
    """All checks, from top to bottom. ``refusals``: what `config check` says of the configuration."""
    checks: tuple[Callable[[Machine], Iterator[Finding]], ...] = (
        _versions,
        lambda _: _configuration(refusals),
        _unit,
        _sockets,
        _rights,
        _camera,
        _serial,
        _modem_manager,
        _can,
        _addresses,
        _servo,
        _clock,
        _disk,
        _governor,
        _daemon,
    )
    return [finding for check in checks for finding in check(machine)]


def _versions(_: Machine) -> Iterator[Finding]:
    found = [f"Python {platform.python_version()}", f"kernel {platform.release()}", platform.machine()]
    for package in PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue  # the Debian package carries them without their metadata
    enough = sys.version_info >= (3, 11)
    yield Finding("versions", Verdict.PASS if enough else Verdict.FAIL, ", ".join(found))


def _configuration(refusals: list[str]) -> Iterator[Finding]:
    if not refusals:
        yield Finding("configuration", Verdict.PASS, "valid, and one that this installation can run")
    for refusal in refusals:
        yield Finding("configuration", Verdict.FAIL, refusal, "graderd config check")


def _unit(machine: Machine) -> Iterator[Finding]:
    if not machine.at("/run/systemd/system").is_dir():
        yield Finding("service", Verdict.NOTE, "no systemd here: nobody starts the daemon again when it ends")
        return
    told = machine.run(
        "systemctl", "show", "graderd", "--property=LoadState,ActiveState,UnitFileState,NRestarts,Result"
    )
    state = dict(line.split("=", 1) for line in (told or "").splitlines() if "=" in line)
    if state.get("LoadState") != "loaded":
        yield Finding(
            "service", Verdict.WARN, "the unit graderd.service is not installed", "apt install ./graderd_*.deb"
        )
        return
    seen = f"{state.get('ActiveState')}, {state.get('UnitFileState')}, restarted {state.get('NRestarts')} times"
    if state.get("ActiveState") == "failed":
        yield Finding("service", Verdict.FAIL, f"{seen}: {state.get('Result')}", "journalctl -u graderd -n 50")
    elif state.get("UnitFileState") != "enabled":
        yield Finding("service", Verdict.WARN, f"{seen}: not started at boot", "sudo systemctl enable graderd")
    else:
        yield Finding("service", Verdict.PASS, seen)


def _sockets(machine: Machine) -> Iterator[Finding]:
    served = Path(machine.config.api.socket)
    own = places.own_socket()
    if own is not None and machine.status is None and "socket" not in machine.config.api.model_fields_set:
        sockets = {served: "sudo systemctl restart graderd", own: "graderd run, which makes them anew"}
    else:
        sockets = {served: "sudo systemctl restart graderd"}
    for path, repair in (
        (path, repair) for base, repair in sockets.items() for path in (base, base.with_suffix(".stop"))
    ):
        there = machine.at(path)
        if not there.exists():
            continue
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(1.0)
            try:
                probe.connect(str(there))
            except PermissionError:
                yield Finding(
                    "socket", Verdict.WARN, f"{path}: this user may not use it", "sudo usermod -aG graderd $USER"
                )
            except OSError as error:
                seen = f"{path}: left behind, nobody listens ({error.strerror or error})"
                yield Finding("socket", Verdict.WARN, seen, repair)
            else:
                yield Finding("socket", Verdict.PASS, f"{path}: a daemon listens")


def _rights(machine: Machine) -> Iterator[Finding]:
    for name, port in _ports(machine.config).items():
        device = machine.at(port)
        if not device.exists():
            yield Finding(
                f"{name} port", Verdict.FAIL, f"{port} is not there", "plug it in; ls -l /dev/graderd /dev/serial"
            )
        else:
            yield _use_of(machine, f"{name} port", port, f"{port} -> {os.path.realpath(device)}")
    if machine.config.camera.source == "realsense":
        for camera in realsense_cameras(machine.root):
            if machine.at(camera.node).exists():
                yield _use_of(machine, "camera rights", camera.node, f"{camera.node}: {machine.user or 'this user'}")


def _use_of(machine: Machine, check: str, path: str, seen: str) -> Finding:
    """Whether who runs the daemon may read and write a device, and what makes it so."""
    device = machine.at(path)
    found = device.stat()
    if not machine.user:
        may = os.access(device, os.R_OK | os.W_OK)
    else:
        user = pwd.getpwnam(machine.user)
        groups = os.getgrouplist(machine.user, user.pw_gid)
        shift = 6 if found.st_uid == user.pw_uid else 3 if found.st_gid in groups else 0
        may = user.pw_uid == 0 or (found.st_mode >> shift) & 0o6 == 0o6
    if may:
        return Finding(check, Verdict.PASS, seen)
    by_group = stat.S_IMODE(found.st_mode) & 0o060 == 0o060 and found.st_gid != 0
    after = "sudo systemctl restart graderd" if machine.user else "log in again"
    repair = (
        f"sudo usermod -aG {_group(found.st_gid)} {machine.user or '$USER'}; {after}"
        if by_group
        else f"its group has no right to it: ls -lL {path}; 70-graderd.rules of the package gives it: plug it in again"
    )
    return Finding(check, Verdict.FAIL, f"{path}: {machine.user or 'this user'} may not use it", repair)


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _ports(config: Config) -> dict[str, str]:
    """The serial ports that the configuration names."""
    found = {"rotation": getattr(config.rotation, "port", ""), "stop input": getattr(config.stop_input, "port", "")}
    if config.can.interface == "slcan":
        found["can"] = str(config.can.channel)
    return {name: str(port) for name, port in found.items() if port}


@dataclass(frozen=True, slots=True)
class UsbCamera:
    """A camera on USB, as the kernel tells of it."""

    product: str
    serial: str
    speed_mbit_per_s: str
    device_release: str
    node: str
    """The device file that the library opens."""


def realsense_cameras(root: Path) -> list[UsbCamera]:
    """The RealSense cameras on USB. ``root``: see :class:`Machine`."""

    def told(device: Path, name: str) -> str:
        try:
            return (device / name).read_text("utf-8", "replace").strip()
        except OSError:
            return ""

    return [
        UsbCamera(
            told(device, "product"),
            told(device, "serial"),
            told(device, "speed"),
            told(device, "bcdDevice"),
            f"/dev/bus/usb/{told(device, 'busnum').zfill(3)}/{told(device, 'devnum').zfill(3)}",
        )
        for device in sorted((root / "sys/bus/usb/devices").glob("*"))
        if told(device, "idVendor") == CAMERA_VENDOR and "RealSense" in told(device, "product")
    ]


def _camera(machine: Machine) -> Iterator[Finding]:
    if machine.config.camera.source != "realsense":
        yield Finding("camera", Verdict.NOTE, f"pictures come from '{machine.config.camera.source}': no USB to look at")
        return
    found = realsense_cameras(machine.root)
    for camera in found:
        seen = f"{camera.product} {camera.serial}: {camera.speed_mbit_per_s} Mbit/s"
        seen += f", device release {camera.device_release}"
        if float(camera.speed_mbit_per_s or 0) < USB3_MBIT_PER_S:
            yield Finding(
                "camera", Verdict.FAIL, f"{seen}: USB 2", "use a USB 3 cable and port (blue), no hub; lsusb -t"
            )
        else:
            yield Finding("camera", Verdict.PASS, seen)
    if not found:
        yield Finding("camera", Verdict.FAIL, "no RealSense camera on USB", "plug it in; lsusb -d 8086:")
    told = str((machine.status or {}).get("camera", {}).get("description", ""))
    firmware = re.search(r"firmware [\d.]+(, older than [\d.]+)?", told)
    if firmware is None:
        why = "no daemon to ask" if machine.status is None else "the daemon has not read it"
        yield Finding("camera firmware", Verdict.NOTE, f"{why}: it is read from the open camera")
    elif firmware[1]:
        yield Finding("camera firmware", Verdict.WARN, f"{firmware[0]}, which the library recommends", FIRMWARE_REPAIR)
    else:
        yield Finding("camera firmware", Verdict.PASS, firmware[0])


def _serial(machine: Machine) -> Iterator[Finding]:
    for name, port in _ports(machine.config).items():
        device = Path(os.path.realpath(machine.at(port)))
        if not device.exists():
            continue
        latency = machine.text(f"/sys/class/tty/{device.name}/device/latency_timer")
        if latency is not None and int(latency) > FTDI_LATENCY_MOST_MS:
            seen = f"{device.name} holds received bytes back for {latency} ms"
            repair = (
                f"echo 1 | sudo tee /sys/class/tty/{device.name}/device/latency_timer; name it in /etc/graderd/adapters"
            )
            yield Finding(f"{name} latency", Verdict.FAIL, seen, repair)
        elif latency is not None:
            yield Finding(f"{name} latency", Verdict.PASS, f"{device.name}: {latency} ms")
        users = _users_of(machine, device)
        others = {pid: command for pid, command in users.items() if "graderd" not in command}
        if others:
            told = ", ".join(f"process {pid} ({command[:60]})" for pid, command in others.items())
            yield Finding(f"{name} user", Verdict.FAIL, f"{device.name} is used by {told}", f"kill {' '.join(others)}")


def _users_of(machine: Machine, device: Path) -> dict[str, str]:
    """Who has it open, by process: as far as this user may see."""
    found = {}
    for process in machine.at("/proc").glob("[0-9]*"):
        try:
            opened = [os.readlink(entry) for entry in (process / "fd").iterdir()]
        except OSError:
            continue
        if str(device) in opened:
            found[process.name] = (machine.text(f"/proc/{process.name}/cmdline") or "").replace("\0", " ").strip()
    return found


def _modem_manager(machine: Machine) -> Iterator[Finding]:
    running = any(
        (machine.text(f"/proc/{p.name}/comm") or "") == "ModemManager" for p in machine.at("/proc").glob("[0-9]*")
    )
    if running and _ports(machine.config):
        seen = "it runs, and writes AT commands to every serial port that is not marked"
        yield Finding("ModemManager", Verdict.WARN, seen, "sudo systemctl mask --now ModemManager")
    else:
        yield Finding("ModemManager", Verdict.PASS, "it does not run" if not running else "no serial port of ours")


def _can(machine: Machine) -> Iterator[Finding]:
    can = machine.config.can
    if can.interface != "socketcan":
        return
    told = machine.run("ip", "-details", "-statistics", "-json", "link", "show", "dev", str(can.channel))
    try:
        link = json.loads(told or "")[0]
    except (ValueError, LookupError):
        repair = f"plug the adapter in; sudo systemctl start graderd-can@{can.channel}"
        yield Finding("can", Verdict.FAIL, f"there is no interface {can.channel}", repair)
        return
    data = link.get("linkinfo", {}).get("info_data", {})
    bitrate, state = data.get("bittiming", {}).get("bitrate"), data.get("state", "")
    seen = f"{can.channel}: {link.get('operstate', '?').lower()}, {bitrate or 'no'} bit/s, {state or 'no state'}"
    if "UP" not in link.get("flags", []):
        yield Finding("can", Verdict.FAIL, f"{seen}: it is down", f"sudo systemctl start graderd-can@{can.channel}")
    elif bitrate is not None and bitrate != can.bitrate_n:
        repair = f"sudo systemctl restart graderd-can@{can.channel}"
        yield Finding("can", Verdict.FAIL, f"{seen}: the configuration says {can.bitrate_n}", repair)
    elif state in ("ERROR-PASSIVE", "BUS-OFF", "ERROR-WARNING"):
        seen += ": nobody acknowledges, or the line is not terminated"
        repair = "measure 60 Ω between CAN-H and CAN-L, unpowered; power the actuators; ip -details link"
        yield Finding("can", Verdict.FAIL if state != "ERROR-WARNING" else Verdict.WARN, seen, repair)
    else:
        yield Finding("can", Verdict.PASS, seen)
    queue_n = link.get("txqlen")
    if queue_n is not None and queue_n < CAN_QUEUE_LEAST_N:
        seen = f"{can.channel} queues {queue_n} messages, not {CAN_QUEUE_LEAST_N}: a stop may find the queue full"
        repair = f"sudo ip link set {can.channel} txqueuelen {CAN_QUEUE_LEAST_N}"
        yield Finding("can queue", Verdict.WARN, seen, repair)
    elif queue_n is not None:
        yield Finding("can queue", Verdict.PASS, f"{can.channel} queues {queue_n} messages")


def _addresses(machine: Machine) -> Iterator[Finding]:
    by_address: dict[int, list[str]] = {}
    for name, section in machine.config.actuators().items():
        address = getattr(section, "address_n", None)
        if address is not None:
            by_address.setdefault(address, []).append(name)
    for address, names in by_address.items():
        if len(names) > 1:
            seen = f"{' and '.join(names)} have address {address}"
            repair = "wire address-select 1 of the right lift; graderd config set lift_right.address_n 20"
            yield Finding("addresses", Verdict.FAIL, seen, repair)
    if by_address and all(len(names) == 1 for names in by_address.values()):
        told = ", ".join(f"{names[0]} {address}" for address, names in sorted(by_address.items()))
        yield Finding("addresses", Verdict.PASS, told)


def _servo(machine: Machine) -> Iterator[Finding]:
    if machine.config.rotation.backend != "ph54":
        return
    if machine.service is None:
        yield Finding(
            "servo", Verdict.NOTE, "no daemon to ask: its model and watchdog were not read", "graderd rotation scan"
        )
        return
    try:
        told = machine.service("rotation.verify_profile")
    except Exception as error:
        yield Finding("servo", Verdict.FAIL, str(error), "graderd status")
        return
    wrong = [one for one in told.get("differences", []) if one.get("kind") != "default"]
    if wrong:
        yield Finding(
            "servo",
            Verdict.FAIL,
            f"not as its profile says: {json.dumps(wrong)[:300]}",
            "graderd profile verify rotation",
        )
    else:
        yield Finding("servo", Verdict.PASS, "model, watchdog and limits are as its profile says")


def _clock(machine: Machine) -> Iterator[Finding]:
    told = machine.run("timedatectl", "show", "--property=NTPSynchronized,Timezone")
    if told is None:
        yield Finding("clock", Verdict.NOTE, "nobody says whether it is synchronised (no timedatectl)")
    elif "NTPSynchronized=yes" in told:
        yield Finding("clock", Verdict.PASS, "synchronised")
    else:
        seen = "not synchronised: records carry wrong times; control does not need it"
        yield Finding("clock", Verdict.WARN, seen, "sudo timedatectl set-ntp true")


def _disk(machine: Machine) -> Iterator[Finding]:
    named = {"state": machine.config.state.directory, "recordings": machine.config.recording.directory}
    for name, directory in named.items():
        if not directory:
            continue
        there = machine.at(directory)
        while not there.exists() and there != there.parent:
            there = there.parent
        free_mb = shutil.disk_usage(there).free / 1e6
        least_mb = max(FREE_LEAST_MB, machine.config.recording.min_free_mb)
        seen = f"{name} {directory}: {free_mb:.0f} MB free"
        if free_mb < least_mb:
            yield Finding(
                "disk", Verdict.FAIL, seen, f"sudo journalctl --vacuum-size=200M; du -xh {directory} | sort -h"
            )
        else:
            yield Finding("disk", Verdict.PASS, seen)


def _governor(machine: Machine) -> Iterator[Finding]:
    found = {
        path.read_text().strip()
        for path in machine.at("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    }
    if "powersave" in found and machine.text("/sys/devices/system/cpu/intel_pstate/status") != "active":
        repair = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
        yield Finding("governor", Verdict.WARN, "powersave: the tick comes late", repair)
    else:
        yield Finding("governor", Verdict.PASS, ", ".join(sorted(found)) or "the kernel does not change the clock")


def _daemon(machine: Machine) -> Iterator[Finding]:
    status = machine.status
    if status is None:
        yield Finding("daemon", Verdict.NOTE, "none answers", "sudo systemctl start graderd")
        return
    tick = status["tick"]
    seen = f"{status['mode']}, {tick['rate_hz']:.0f} Hz, p99 {tick['lateness_p99_ms']:.1f} ms late"
    late = tick["lateness_p99_ms"] > 0.5e3 / max(tick["rate_hz"], 1.0)
    repair = "see the governor above; docs/integrators/install.md, real-time scheduling" if late else ""
    yield Finding("daemon", Verdict.WARN if late else Verdict.PASS, seen, repair)
    for axis in status["axes"].values():
        counters = axis["counters"]
        lost, asked = counters.get("timeouts_n", 0), counters.get("requests_n", 0)
        if asked and lost > 0.02 * asked:
            seen = f"{axis['name']}: {lost} of {asked} requests were not answered in time"
            yield Finding("dead times", Verdict.WARN, seen, "cable, ground, termination; then the latency timer above")
        age_s = axis["measured_age_s"]
        if age_s is None:
            yield Finding("dead times", Verdict.WARN, f"{axis['name']}: never measured", "power it; graderd status")
        else:
            yield Finding("dead times", Verdict.PASS, f"{axis['name']}: newest position {age_s * 1000:.0f} ms old")
    for fault in status["faults"]:
        verdict = Verdict.WARN if fault["reaction"] == "warn" else Verdict.FAIL
        yield Finding("fault", verdict, f"{fault['name']}: {fault['reads']}", fault["remedy"])


def worst(findings: list[Finding]) -> Verdict:
    """The verdict on the whole."""
    verdicts = {finding.verdict for finding in findings}
    return next((v for v in (Verdict.FAIL, Verdict.WARN) if v in verdicts), Verdict.PASS)


def as_dict(findings: list[Finding]) -> dict[str, Any]:
    """For programs."""
    return {"verdict": worst(findings), "findings": [asdict(finding) for finding in findings]}


SECRETS: Final = (
    (re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?-----END [A-Z ]*PRIVATE KEY-----", re.DOTALL), "(key removed)"),
    (re.compile(r"(?i)(bearer\s+|token[\"']?\s*[=:]\s*[\"']?|#)[A-Za-z0-9_-]{32,}"), r"\1(removed)"),
    (re.compile(r"\b[0-9a-f]{64}\b"), "(digest removed)"),
    (re.compile(r"(?i)(passw(?:or)?d|psk|secret)([\"']?\s*[=:]\s*)\S+"), r"\1\2(removed)"),
)


def without_secrets(text: str) -> str:
    """The text with everything removed that opens a door."""
    for pattern, instead in SECRETS:
        text = pattern.sub(instead, text)
    return text
