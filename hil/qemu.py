"""A QEMU machine with Debian's own kernel, for what user-mode Linux lacks: USB and PCI.

Built from Debian's archive: a bare root with the package installed by apt, the modules it takes, all in one ext4 image
that stays in ``var/hil/cache`` until the package changes. Each boot sees it read-only under an overlay, as the
user-mode guests see the host's root. Emulated without KVM, so it runs anywhere, ten to fifty times slower than there.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hil import uml
from hil.package import BASE, apt_install, clean_root
from hil.run import PROJECT

CACHE: Final = PROJECT / "var" / "hil" / "cache"
QEMU: Final = "qemu-system-x86_64"
TOOLS: Final = (QEMU, "mmdebstrap", "mkfs.ext4", "depmod", "modprobe", "cpio", "dpkg-deb")
TO_BOOT: Final = ("virtio_pci", "virtio_blk", "crc32c_generic", "ext4", "overlay", "9pnet_virtio", "9p")
TO_USE: Final = ("xhci_pci", "ftdi_sio", "kvaser_pci", "can_raw", "can_j1939", "virtio_rng")
IMAGE_MB: Final = 2000


@dataclass(frozen=True, slots=True)
class Disk:
    """What a machine boots: kernel, the modules to find its root with, root."""

    kernel: Path
    modules: tuple[Path, ...]
    image: Path


def missing() -> list[str]:
    """Programs that are not there."""
    return [name for name in TOOLS if shutil.which(name) is None]


def disk_for(package: Path, suite: str = "bookworm") -> Disk:
    """The disk with this package installed; made where there is none yet or the package is newer (minutes)."""
    place = CACHE / suite
    stamp = place / "made-of"
    origin = f"{package.name} {package.stat().st_mtime_ns} {Path(__file__).stat().st_mtime_ns}\n"
    if not stamp.exists() or stamp.read_text(encoding="utf-8") != origin:
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        with tempfile.TemporaryDirectory(prefix="graderd-qemu-", dir="/var/tmp") as scratch:
            _build(place, Path(scratch), package, suite)
        stamp.write_text(origin, encoding="utf-8")
    return Disk(place / "vmlinuz", tuple(sorted((place / "modules").iterdir())), place / "root.img")


def _build(place: Path, scratch: Path, package: Path, suite: str) -> None:
    root = scratch / "root"
    clean_root(root, suite, "", (*BASE, "procps"))
    apt_install(root, package)
    release = _add_kernel(root, scratch)
    shutil.copy(next((scratch / "kernel" / "boot").glob("vmlinuz-*")), place / "vmlinuz")
    (place / "modules").mkdir()
    for number, module in enumerate(_with_dependencies(scratch / "kernel", release, TO_BOOT)):
        shutil.copy(module, place / "modules" / f"{number:02}-{module.name}")
    image = place / "root.img"
    subprocess.run(["truncate", f"--size={IMAGE_MB}M", image], check=True)
    subprocess.run(["mkfs.ext4", "-q", "-O", "^has_journal,^metadata_csum", "-m", "0", "-d", root, image], check=True)
    sys.stdout.write(f"hil: disk image with {package.name} and Linux {release} made\n")
    sys.stdout.flush()


def _add_kernel(root: Path, scratch: Path) -> str:
    """Fetch the archive's newest kernel, put the modules we use into the root; its release.

    Raises:
        SystemExit: it cannot be had, or has not all of the modules.
    """
    newest = "apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: //p' | head -n 1"
    command = ["chroot", str(root), "/bin/sh", "-c", f"cd /tmp && apt-get download -q $({newest})"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"hil: no kernel from the archive: {done.stderr.strip()[-500:]}. See `apt-cache policy linux-image-amd64`; "
            "where the mirror is at fault, run it again"
        )
    archive = next((root / "tmp").glob("linux-image-*.deb"))
    subprocess.run(["dpkg-deb", "-x", archive, scratch / "kernel"], check=True)
    archive.unlink()
    tree = next((scratch / "kernel" / "lib" / "modules").iterdir())
    subprocess.run(["depmod", "-b", scratch / "kernel", tree.name], check=True)
    target = root / "usr" / "lib" / "modules" / tree.name
    for module in _with_dependencies(scratch / "kernel", tree.name, (*TO_BOOT, *TO_USE)):
        copy = target / module.relative_to(tree)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(module, copy)
    for name in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
        shutil.copy(tree / name, target / name)
    subprocess.run(["depmod", "-b", root, tree.name], check=True)
    return tree.name


def _with_dependencies(base: Path, release: str, names: Sequence[str]) -> list[Path]:
    """The files of these modules, each after those it needs, none twice.

    Raises:
        SystemExit: this kernel has not all of them.
    """
    command = ["modprobe", "--all", "--show-depends", "--dirname", str(base), "--set-version", release, *names]
    listed = subprocess.run(command, capture_output=True, text=True, check=False)
    if listed.returncode:
        raise SystemExit(
            f"hil: Linux {release} of the archive: {listed.stderr.strip()}. Modules were renamed or built in since: "
            "correct TO_BOOT and TO_USE in hil/qemu.py"
        )
    found = [Path(line.split()[1]) for line in listed.stdout.splitlines() if line.startswith("insmod")]
    return list(dict.fromkeys(found))


@dataclass(frozen=True, slots=True)
class Guest(uml.Guest):
    """The same guest in QEMU: ``disk`` is what it boots, ``devices`` further arguments, ``monitor`` its QMP socket."""

    disk: Disk | None = None
    devices: tuple[str, ...] = ()
    monitor: Path = Path("monitor")

    def command_line(self, scratch: Path) -> list[str]:
        """See the base class."""
        assert self.disk is not None
        return [
            QEMU,
            *("-M", "q35", "-accel", "tcg,thread=multi,tb-size=512", "-cpu", "Nehalem", "-smp", "2"),
            *("-m", f"{self.memory_mib}M", "-nodefaults", "-display", "none", "-no-reboot", "-serial", "stdio"),
            *("-kernel", str(self.disk.kernel), "-initrd", str(uml.build_initramfs(scratch, self.disk.modules))),
            *("-drive", f"file={self.disk.image},format=raw,if=virtio,readonly=on,cache=unsafe"),
            *("-virtfs", f"local,path={self.out.resolve()},mount_tag=hil-out,security_model=none"),
            *("-virtfs", f"local,path={PROJECT},mount_tag=hil-project,security_model=none,readonly=on"),
            *("-qmp", f"unix:{self.monitor},server=on,wait=off"),
            *("-device", "virtio-rng-pci"),
            *self.devices,
            *("-append", "console=ttyS0 quiet panic=-1 mitigations=off nokaslr hil_root=/dev/vda hil_out=9p"),
        ]


class Monitor:
    """QEMU's control socket (QMP): plugs devices in and pulls them out."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(30.0)
        self._socket.connect(str(path))
        self._lines = self._socket.makefile("r", encoding="utf-8")
        self._lines.readline()  # the greeting
        self.ask("qmp_capabilities")

    def close(self) -> None:
        """Let go of the socket."""
        self._lines.close()
        self._socket.close()

    def ask(self, command: str, **arguments: object) -> Any:
        """One command; what it returns. Events in between are passed over.

        Raises:
            RuntimeError: QEMU refused.
        """
        self._socket.sendall(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while True:
            answer = json.loads(self._lines.readline())
            if "error" in answer:
                raise RuntimeError(f"QEMU: {command}: {answer['error']['desc']}")
            if "return" in answer:
                return answer["return"]
