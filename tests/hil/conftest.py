"""Hardware in the loop: the installed package as a service on the CAN of a running kernel, the rig on the far side.

::

    graderd.service ── vcan0 ══ kernel gateway ══ wire0 ── rig (actuators)
                    └─ pty ─────────────────────────────── rig (servo)
                    └─ unix socket ─────────────────────── rig (camera)

Started by ``python3 -m hil.suite``. After every test: no error frame, no restart and no core dump that the test did
not announce with ``error_frames`` or ``restarts(n)``; at the end: no socket or task more than at the beginning.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil import bus
from hil.service import Grader, Rig, run

WIRE = "wire0"
CAN = "vcan0"
CORES = Path("/var/tmp/hil-cores")
# Set by the last test: the machine is turning and shall be found so by the shutdown that follows.
LEFT_TURNING = pytest.StashKey[bool]()
# How many restarts by systemd the tests so far have announced.
RESTARTS_N = pytest.StashKey[int]()
DROP_IN = Path("/etc/systemd/system/graderd.service.d")
# The guest has one processor for machine, computer and test, and each system call costs it 0.1 ms: fewer of them, and
# 0.2 s longer patience where the whole guest may stand still for that long.
FOR_THE_GUEST: dict[str, object] = {
    "rotation.poll_hz": 25.0,
    "rotation.speed_deg_per_s": 10.0,  # so that a test can look while it turns
    "rotation.watchdog_s": 0.4,
    "rotation.goal_timeout_s": 0.4,
    "rotation.reply_timeout_s": 0.5,
    "rotation.max_age_s": 0.4,
    "lift_left.max_age_s": 0.6,
    "lift_right.max_age_s": 0.6,
    "tilt.max_age_s": 0.6,
    "control.overrun_s": 0.3,
    "lift_pair.silent_s": 0.4,
    "lift_pair.reading_max_age_s": 0.6,
    **{
        f"{axis}.{name}": seconds
        for axis in ("lift_left", "lift_right", "tilt")
        for name, seconds in (("feedback_timeout_s", 0.6), ("target_timeout_s", 0.5))
    },
    "camera.color_width_px": 640,
    "camera.color_height_px": 400,
    "camera.depth_width_px": 424,
    "camera.depth_height_px": 240,
    "camera.rate_hz": 2.0,
    "camera.stale_s": 3.0,
    "camera.restart_s": 10.0,
    "machine.lease_s": 1.0,
    "perception.decision.max_frame_age_s": 0.5,
    "perception.decision.max_angle_age_s": 0.5,
    "rule.vote_max_age_s": 4.0,
}

# What the tests of the bus ask for beside the interface: a stop message, and to move where somebody says.
STOP_PGN = 0xFF77
ON_THE_BUS: dict[str, object] = {
    "can.stop_pgn_n": STOP_PGN,
    "can.obey_commanded_address": True,
}


def pytest_configure(config: pytest.Config) -> None:
    """The suite's own marks."""
    config.addinivalue_line("markers", "error_frames: the test makes the bus report errors")
    config.addinivalue_line("markers", "restarts(n): systemd restarts the service so often during the test")
    config.addinivalue_line("markers", "endurance: in the second guest, so that both take about as long as each other")
    config.addinivalue_line("markers", "soak: the long run with faults")
    config.addinivalue_line("markers", "shutdown: leaves the machine as it is, for the shutdown that follows")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Write each failure down as it happens: a guest that dies later takes the summary with it."""
    if report.failed and "HIL_OUT" in os.environ:
        with Path(os.environ["HIL_OUT"], "failures").open("a", encoding="utf-8") as out:
            out.write(f"{report.nodeid} ({report.when}, {report.duration:.1f} s)\n{report.longreprtext}\n\n")


def pytest_report_header() -> list[str]:
    """Which kernel and which kind of bus this is about."""
    where = os.environ.get("HIL_GUEST", "")
    kind = {"uml": "user-mode Linux guest", "qemu": "QEMU guest"}.get(where, "this machine")
    return [
        f"hil: kernel {platform.release()} ({kind}), bus: the kernel's SocketCAN, vcan and slcan, can-j1939",
        f"hil: package {run('dpkg-query', '-W', 'graderd', check=False).stdout.strip() or 'not installed'}",
    ]


@pytest.fixture(scope="session")
def wire(request: pytest.FixtureRequest) -> Iterator[str]:
    """The bus: the rig's end and the service's end, coupled."""
    bus.load_modules()
    for name in (WIRE, CAN):
        bus.add_vcan(name)
    bus.couple(CAN, WIRE)
    yield WIRE
    if not _left_turning(request):
        for name in (CAN, WIRE):
            bus.remove_vcan(name)


@pytest.fixture(scope="session")
def rig(request: pytest.FixtureRequest, wire: str) -> Iterator[Rig]:
    """The simulated grader."""
    machine = Rig(wire, seed=int(os.environ.get("GRADERD_HIL_SEED", "0")))
    machine.start()
    yield machine
    if not _left_turning(request):
        machine.stop()


@pytest.fixture(scope="session")
def grader(request: pytest.FixtureRequest) -> Iterator[Grader]:
    """The installed service, not started yet."""
    CORES.mkdir(exist_ok=True)
    pattern = Path("/proc/sys/kernel/core_pattern")
    former_pattern = pattern.read_text(encoding="ascii")
    pattern.write_text(f"{CORES}/%e.%p", encoding="ascii")
    DROP_IN.mkdir(parents=True, exist_ok=True)
    # The guest has one processor: the drop-in we ship for that. And its page faults are slow: keep memory once taken.
    (DROP_IN / "realtime.conf").write_bytes(Path("/usr/share/graderd/dropins/realtime.conf").read_bytes())
    (DROP_IN / "hil.conf").write_text(
        "[Service]\nTimeoutStopSec=40\nEnvironment=MALLOC_TRIM_THRESHOLD_=1000000000\n"
        "Environment=MALLOC_MMAP_THRESHOLD_=1000000000\n",
        encoding="utf-8",
    )
    service = Grader()
    restarts_before_n = service.unit.restarts_n
    yield service
    # Each test has looked at systemd's counter, which a start by hand sets to 0; the journal forgets nothing.
    restarts_n = service.unit.restarts_n - restarts_before_n
    assert restarts_n == request.session.stash.get(RESTARTS_N, 0), service.unit.journal()
    if _left_turning(request):
        return
    service.unit.ctl("stop")
    assert service.unit.show("Result") == "success", service.unit.journal()
    pattern.write_text(former_pattern, encoding="ascii")
    assert not bus_users(CAN), bus_users(CAN)
    assert not Path("/run/graderd").exists()


@pytest.fixture(scope="module")
def channel() -> str:
    """The CAN interface a module has the service on; a module with one of its own says so."""
    return CAN


@pytest.fixture(scope="module")
def service(grader: Grader, rig: Rig, channel: str) -> Iterator[Grader]:
    """The service, running, with no more sockets at the module's end than at its beginning."""
    grader.run_with(rig.configuration() | FOR_THE_GUEST | ON_THE_BUS | {"can.channel": channel})
    before = _descriptors(grader)
    yield grader
    after = _descriptors(grader) if grader.unit.pid else {}
    assert after.get("socket", 0) <= before["socket"] + 1, f"sockets leaked: {before} -> {after}"


@pytest.fixture(autouse=True)
def quiet(request: pytest.FixtureRequest, service: Grader) -> Iterator[None]:
    """Each test begins disarmed with the machine at rest, and ends with nothing unasked."""
    watch = bus.RawBus("", only_errors=True)
    restarts = request.node.get_closest_marker("restarts")
    allowed = restarts.args[0] if restarts else 0
    pid_before, restarts_before_n = service.unit.numbers("MainPID", "NRestarts")
    yield
    errors = watch.drain()
    watch.close()
    if not request.node.get_closest_marker("error_frames"):
        assert not errors, f"error frames unasked: {errors[:5]}"
    pid, restarts_n = service.unit.numbers("MainPID", "NRestarts")
    by_hand = pid != pid_before and restarts_n == 0
    assert by_hand or restarts_n - restarts_before_n == allowed, service.unit.journal()
    request.session.stash[RESTARTS_N] = request.session.stash.get(RESTARTS_N, 0) + allowed
    assert not list(CORES.iterdir())


@pytest.fixture
def ready(request: pytest.FixtureRequest, service: Grader, rig: Rig) -> Iterator[Grader]:
    """The service, disarmed and ready to be armed; disarmed again afterwards."""
    rig.ask("clear_faults")
    service.disarm()
    service.wait_ready()
    yield service
    if _left_turning(request):
        return
    if service.status_or_none() is not None:
        service.disarm()
    rig.ask("clear_faults")


@pytest.fixture
def listener(wire: str) -> Iterator[bus.RawBus]:
    """A raw socket on the rig's end of the bus."""
    raw = bus.RawBus(wire)
    yield raw
    raw.close()


def _left_turning(request: pytest.FixtureRequest) -> bool:
    return request.session.stash.get(LEFT_TURNING, False)


def _descriptors(grader: Grader) -> dict[str, int]:
    kinds: dict[str, int] = {}
    for entry in Path(f"/proc/{grader.unit.pid}/fd").iterdir():
        try:
            kind = entry.readlink().name.split(":")[0] or "other"
        except FileNotFoundError:
            continue
        kinds[kind] = kinds.get(kind, 0) + 1
    return kinds


def bus_users(interface: str) -> list[str]:
    """Receive lists of the kernel that still hold an entry on this interface, apart from the gateway's."""
    found = []
    for path in Path("/proc/net/can").glob("rcvlist_*"):
        lines = path.read_text(encoding="ascii").splitlines()
        found += [line for line in lines if line.split()[:1] == [interface] and "gw" not in line.split()[-1]]
    return found
