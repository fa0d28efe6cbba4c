"""Real drivers under emulated hardware: ``make hil-usb``.

QEMU with Debian's kernel has an FTDI adapter that can be pulled and plugged, its far end a virtual servo on this host,
and two SJA1000 controllers on one CAN bus. What is done and tested there: :mod:`hil.usb_guest`.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread
from typing import Final

from hil import qemu, uml
from hil.run import PROJECT, PYTHON, RESULTS, newest_package
from hil.service import wait_for
from hil.usb_guest import SERIAL

OUT: Final = RESULTS / "usb"
GUEST_PYTHON: Final = "/opt/graderd/bin/python"
ADAPTER: Final = {"driver": "usb-serial", "id": "servo", "bus": "xhci.0", "chardev": "servo", "serial": SERIAL}


@contextlib.contextmanager
def virtual_servo(link: Path) -> Iterator[None]:
    """A servo behind a pseudo-terminal of this host."""
    command = [str(PYTHON), "-m", "graderd.simulator.servo", "--link", str(link)]
    with (OUT / "servo").open("wb") as log:
        process = subprocess.Popen(command, cwd=PROJECT, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        wait_for("the virtual servo", link.exists, 20.0)
        yield
    finally:
        process.terminate()
        process.wait()


def serve(monitor_path: Path, ended: Event) -> None:
    """Do what the guest asks for, until it has ended."""
    monitor: qemu.Monitor | None = None
    while not ended.wait(0.1):
        for path in OUT.glob("please-*"):
            monitor = monitor or qemu.Monitor(monitor_path)
            if path.name.startswith("please-plug-"):
                monitor.ask("device_add", **ADAPTER, **{"always-plugged": True})
            else:
                monitor.ask("device_del", id=ADAPTER["id"])
            path.unlink()
    if monitor is not None:
        monitor.close()


def main() -> int:
    """Command line; 0 where every step was as it should be."""
    parser = argparse.ArgumentParser(prog="make hil-usb", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--timeout-s", type=float, default=900.0)
    options = parser.parse_args()
    if absent := [*qemu.missing(), *([] if uml.BUSYBOX.exists() else [str(uml.BUSYBOX)])]:
        sys.stderr.write(f"hil: no {', '.join(absent)}. Run `sudo hil/setup --usb` once\n")
        return uml.GUEST_DIED
    began_s = time.monotonic()
    disk = qemu.disk_for(newest_package())
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix="graderd-hil-usb-") as scratch, virtual_servo(Path(scratch, "servo")):
        monitor, ended = Path(scratch, "monitor"), Event()
        guest = qemu.Guest(
            ("/bin/sh", "-c", f"cd /run/hil-project && exec {GUEST_PYTHON} -B -m hil.usb_guest"),
            OUT,
            directory=Path("/"),
            timeout_s=options.timeout_s,
            memory_mib=1536,
            place_n=None,
            disk=disk,
            monitor=monitor,
            devices=(
                *("-device", "qemu-xhci,id=xhci", "-chardev", f"serial,id=servo,path={scratch}/servo"),
                *("-object", "can-bus,id=bus"),
                *("-device", "kvaser_pci,canbus=bus", "-device", "kvaser_pci,canbus=bus"),
            ),
        )
        server = Thread(target=serve, args=(monitor, ended), name="requests of the guest")
        server.start()
        try:
            status = guest.run()
        finally:
            ended.set()
            server.join()
    result = {0: "passed", uml.TIMED_OUT: "timed out", uml.GUEST_DIED: "the guest died"}.get(status, "FAILED")
    sys.stdout.write(f"hil-usb: {result} in {time.monotonic() - began_s:.0f} s; {OUT}\n")
    return status


if __name__ == "__main__":
    uml.end_in_order()
    sys.exit(main())
