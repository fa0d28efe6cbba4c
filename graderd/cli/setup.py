"""``graderd setup``: asks its way from bare wires to a machine that may work, and signs what it found.

A conversation over what exists: it runs a daemon of its own (:mod:`graderd.cli.setup_daemon`) and the same commands and
services that a person would use one by one, and writes by the one writer of the configuration. What is done is kept
step by step in the commissioning record, so that it may be left at any question and taken up again.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from graderd import places
from graderd.cli.asking import Answers, agree, answered_by, ask, choice, numbered
from graderd.cli.console import DEFAULT_CONFIG, CliError, ExitCode, client_of, example, print_text
from graderd.cli.setup_daemon import SetupDaemon, is_running
from graderd.client import Client, RefusedError
from graderd.core.axes import ACTUATORS, LIFTS

if TYPE_CHECKING:
    from graderd.commissioning import Commissioning
    from graderd.config import Config
    from graderd.wires import Wires

UNPLUG_S: Final = 60.0
POLL_S: Final = 0.2
HEARD_S: Final = 15.0
BUS_S: Final = 3.0
SCAN_S: Final = 120.0
SQUARE_DEG: Final = 20.0
CLEAR_MM: Final = 40.0
ABOVE_MM: Final = 5.0
UNPLUG: Final = "unplug"
QUESTIONS: Final = (
    ("servo.port", "the servo's adapter: path, number in the list, or 'unplug'"),
    ("can.channel", "the actuators' bus: interface, port of an slcan adapter, or number in the list"),
    ("camera.name", "the camera: serial number, or number in the list"),
    ("stop_input.backend", "the stop loop: none, serial, or simulated on a simulated grader"),
    ("stop_input.port", "the stop loop's serial port"),
    ("servo.scan", "consent: the servo is looked for; nothing moves"),
    ("servo.which", "which of the servos found"),
    ("lift_left.address, lift_right.address, tilt.address", "an actuator's address on the bus"),
    ("rotation", "zero, sign and limits now? y or n"),
    ("rotation.square, rotation.aside, rotation.left_back, rotation.right_back", "Enter, once the blade stands there"),
    ("rotation.clear, rotation.back, rotation.write", "of 'graderd calibrate rotation'"),
    ("stop.square", "Enter, once the blade stands about square"),
    ("stop.command, stop.switch, stop.death", "consent to each test of the stop: the blade turns"),
    ("stop.death.stands", "whether the blade stands without a daemon"),
    ("lifts", "which lift is left now? y or n"),
    ("lifts.raise, lifts.clear", "consent: the blade rises, tilts"),
    ("lifts.rose, lifts.write", "of 'graderd calibrate lifts'"),
    ("camera", "the camera's place now? y or n"),
    ("camera.lower, camera.clear", "consent: the blade sinks to just above the ground, turns"),
    ("camera.write", "of 'graderd calibrate camera'"),
    ("signed_by", "who answers for the record"),
)


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "sudo graderd setup",
            "graderd setup --config grader.toml --rig-dir grader     (on a simulated grader: graderd rig --dir grader)",
            "graderd setup --answers answers.txt",
        )
    )
    def setup(
        context: typer.Context,
        config: Annotated[Path | None, typer.Option(help=f"Configuration to make. {DEFAULT_CONFIG}")] = None,
        rig_dir: Annotated[
            Path | None, typer.Option(help="Set up the simulated grader that serves this directory.")
        ] = None,
        record: Annotated[
            Path | None, typer.Option(help="Where the commissioning record goes. Default: beside the configuration.")
        ] = None,
        answers: Annotated[
            str, typer.Option(metavar="FILE", help="Answers, a line KEY = ANSWER each; '-': from standard input.")
        ] = "",
        again: Annotated[bool, typer.Option("--again", help="Do every step, also those that are done.")] = False,
        questions: Annotated[bool, typer.Option("--questions", help="List the questions' keys, and end.")] = False,
    ) -> None:
        """Set up a new machine: wires, servo, actuators, zero and sign, stop, lifts, camera.

        It asks; every question says what Enter means. Nothing moves before a yes to that motion, and Ctrl-C holds the
        blade and ends. What is done is kept: begun again, it goes on where it was left. At the end the commissioning
        record is signed, and the machine is ready for 'graderd run'.
        """
        if questions:
            print_text("\n".join(f"{key}: {what}" for key, what in QUESTIONS))
            return
        path = config or places.config()
        with answered_by(_answers(answers)):
            _set_up(client_of(context), path, rig_dir, record or path.with_name("commissioning.json"), again=again)


def _answers(source: str) -> Answers | None:
    if not source and sys.stdin.isatty():
        return None
    if source in ("", "-"):
        return Answers(sys.stdin.readlines(), "standard input")
    try:
        return Answers(Path(source).read_text(encoding="utf-8").splitlines(), source)
    except (OSError, UnicodeDecodeError) as error:
        raise CliError(source, f"cannot be read ({error})", "Name another with --answers", ExitCode.USAGE) from None


def _set_up(running: Client, path: Path, rig_dir: Path | None, record_path: Path, *, again: bool) -> None:
    from graderd.cli.calibrate import may_write
    from graderd.commissioning import Commissioning

    if rig_dir is None and is_running(running):
        raise CliError("setup", "a daemon runs, and has the wires", "sudo systemctl stop graderd, then do it again")
    _begin_file(path)
    may_write(path)
    wires = _wires(rig_dir, path)
    record = Commissioning(record_path)
    with SetupDaemon(path.absolute()) as daemon:
        conversation = _Setup(path, wires, record, daemon)
        for number, step in enumerate(STEPS, start=1):
            print_text(f"\n{number} of {len(STEPS)}: {step.title}")
            now = conversation.resolved()
            if not again and record.is_done(step.name, now):
                print_text(f"  done {record.steps[step.name]['at']}")
                continue
            found = step.run(conversation)
            if found is not None:
                record.done(step.name, conversation.resolved(), step.rests_on, found)
        conversation.sign()
    start = f"graderd run --config {path}" if config_is_elsewhere(path) else "sudo systemctl start graderd"
    print_text(f"\nReady. Start it with '{start}', then 'graderd arm' and 'graderd auto'.")


def config_is_elsewhere(path: Path) -> bool:
    """Whether the service does not read this file."""
    return path.absolute() != places.CONFIG


def _wires(rig_dir: Path | None, path: Path) -> Wires:
    from graderd.cli.calibrate import load_config
    from graderd.hal.settings import StopInputSettings
    from graderd.runtime.app import on_rig
    from graderd.wires import MachineWires, RigWires

    if rig_dir is None:
        return MachineWires()
    present = load_config(path, must_exist=True)
    asked = present.model_copy(update={"stop_input": StopInputSettings(backend="simulated")})
    return RigWires(rig_dir.absolute(), on_rig(asked, rig_dir.absolute()))


def _begin_file(path: Path) -> None:
    """A file to change, with every key explained, where there is none."""
    from graderd.config.template import begin

    if path.exists():
        print_text(f"{path}: is there already; setup goes on with it")
        return
    try:
        begin(path)
    except OSError as error:
        cause = f"cannot be made ({error.strerror})"
        raise CliError(str(path), cause, "Run it with sudo, or name another with --config") from None
    print_text(f"{path}: made, with every key and its meaning")


class _Setup:
    """What the steps share."""

    def __init__(self, path: Path, wires: Wires, record: Commissioning, daemon: SetupDaemon) -> None:
        self.path = path
        self.wires = wires
        self.record = record
        self._daemon = daemon
        self._is_up = False

    # -- what they work with -------------------------------------------------------------------------------------------

    def config(self) -> Config:
        """The file as it is now."""
        from graderd.cli.calibrate import load_config

        return load_config(self.path, must_exist=True)

    def resolved(self) -> dict[str, Any]:
        """The same, as plain values."""
        return self.config().model_dump(mode="json")

    def write(self, changes: Mapping[str, Any]) -> None:
        """Put changes into the file, if they are any; the daemon starts anew with them when it is needed next."""
        from graderd.cli.calibrate import write_calibration

        if write_calibration(self.path, dict(changes)) is not None:
            self._is_up = False

    def daemon(self) -> SetupDaemon:
        """Running with the file as it is."""
        if not self._is_up:
            print_text("  (starting the daemon with this configuration)")
            _unlatched(self._daemon.restart())
            self._is_up = True
        return self._daemon

    def command(self, *arguments: str) -> int:
        """A command of graderd's own, to the daemon of this setup; its exit status."""
        from graderd.cli.app import INTERRUPTED, make_cli

        whole = ["--socket", str(self.daemon().socket), *arguments]
        status = int(make_cli()(whole, prog_name="graderd", standalone_mode=False) or 0)
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        return status

    # -- the steps -----------------------------------------------------------------------------------------------------

    def find_wires(self) -> dict[str, Any]:
        """Which adapter, interface, camera and stop loop; nothing is opened."""
        config = self.config()
        port = self._serial_port("servo", str(getattr(config.rotation, "port", "")), self.wires.serial_ports())
        interface, channel = self._can(config, port)
        cameras = self.wires.cameras()
        if not cameras:
            raise CliError("camera", "no camera is plugged in", "Plug it into a USB 3 port, then do it again")
        camera = self._one("camera.name", "Which camera", cameras, config.camera.serial_number)
        stop_loop = self._stop_loop(config, {port, channel})
        self.write(
            {
                "rotation": {"port": port},
                "can": {"interface": interface, "channel": channel},
                "stop_input": stop_loop,
                **self.wires.camera_settings(camera),
            }
        )
        return {"servo": port, "can": channel, "camera": camera, "stop_input": stop_loop["backend"]}

    def find_servo(self) -> dict[str, Any]:
        """Baud rate and id, by pings alone; then whether the servo is as its profile says."""
        rotation = self.config().rotation
        agree("servo.scan", "The servo is looked for at every id and baud rate. Nothing moves. Go on?")
        print_text("  looking (ten seconds or so)")
        servos = self.daemon().client.service("rotation.scan", SCAN_S, consent=True)["servos"]
        if not servos:
            raise CliError("servo", "none answers at any baud rate", "Check the 24 V supply and the RS-485 cable")
        names = {
            f"{one['baud_n']}:{one['servo_id_n']}": f"id {one['servo_id_n']} at {one['baud_n']} bit/s, "
            f"model {one['model_n']}, firmware {one['firmware_version']}"
            for one in servos
        }
        present = f"{getattr(rotation, 'baud_n', '')}:{getattr(rotation, 'servo_id_n', '')}"
        which = self._one("servo.which", "Which servo turns the blade", names, present)
        found = next(one for one in servos if f"{one['baud_n']}:{one['servo_id_n']}" == which)
        self.write({"rotation": {"baud_n": found["baud_n"], "servo_id_n": found["servo_id_n"]}})
        client = self.daemon().client
        client.until(lambda status: status.axes["rotation"].measured is not None, HEARD_S * 4, "the servo")
        differences = client.service("rotation.verify_profile", SCAN_S)["differences"]
        wrong = [one for one in differences if one.get("kind") != "default"]
        for one in wrong:
            print_text(f"  not as its profile says: {json.dumps(one)[:200]}")
        return {**found, "differences_n": len(wrong)}

    def find_actuators(self) -> dict[str, Any]:
        """Who is heard on the bus, and at which address each of the three is."""
        client = self.daemon().client
        heard = self._heard(client)
        strangers = [] if all(heard.values()) else self._sources(client)
        addresses = {}
        for axis in ACTUATORS:
            section = getattr(self.config(), axis)
            present = getattr(section, "address_n", None)
            if present is None:
                continue  # another driver's, with an address of its own kind
            if heard[axis]:
                print_text(f"  {axis}: heard at address {present}")
            else:
                others = f"; on the bus: {', '.join(map(str, strangers))}" if strangers else "; nobody is on the bus"
                print_text(f"  {axis}: not heard at address {present}{others}")
            addresses[axis] = ask(f"{axis}.address", f"  Address of {axis}", _address, str(present))
        if len(set(addresses.values())) < len(addresses):
            cause = "two have one address"
            raise CliError("actuators", cause, "Wire address-select 1 of the right lift (20), then do it again")
        self.write({axis: {"address_n": address} for axis, address in addresses.items()})
        heard = self._heard(self.daemon().client)
        silent = [axis for axis, is_heard in heard.items() if not is_heard]
        if silent:
            cause = f"{' and '.join(silent)} not heard"
            raise CliError("actuators", cause, "Check supply, CAN-H and CAN-L, 60 Ω between them; graderd can dump")
        return addresses

    def calibrate_rotation(self) -> dict[str, Any] | None:
        """Zero, sign and limits, with the blade turned by hand."""
        if not self._wanted("rotation", "Find zero, sign and limits now, by turning the blade by hand?"):
            return None
        self.command("calibrate", "rotation", "--config", str(self.path))
        self._is_up = False
        rotation = self.config().rotation
        return rotation.model_dump(include={"zero_deg", "sign", "gear_ratio", "min_deg", "max_deg"})

    def test_stops(self) -> dict[str, Any]:
        """See :mod:`graderd.cli.stop_tests`."""
        from graderd.cli.stop_tests import tested_stops

        config = self.config()
        self._about_square(config)
        stops = tested_stops(self.daemon(), config.rotation.model_dump(mode="json"), config.stop_input.backend)
        _unlatched(self._daemon.client)  # the one that was started after the last test
        self._daemon.client.command("disarm")
        return {"stops": stops}

    def _about_square(self, config: Config) -> None:
        """With room to turn on both sides: the blade is brought there by hand where it is not."""
        from graderd.cli.stop_tests import rest

        client = self.daemon().client
        room_deg = min(SQUARE_DEG, config.rotation.max_deg / 2.0, -config.rotation.min_deg / 2.0)

        def inside(_: str) -> float:
            angle_deg = rest(client)[0]
            if abs(angle_deg) > room_deg:
                raise ValueError(f"it stands at {angle_deg:+.1f} deg; within {room_deg:.0f} deg of square, please")
            return angle_deg

        if abs(rest(client)[0]) > room_deg:
            question = "Turn the blade back to about square, by hand. Press Enter when it stands there"
            ask("stop.square", question, inside)

    def calibrate_lifts(self) -> dict[str, Any] | None:
        """Is the left lift the left one?"""
        from graderd.cli.stop_tests import arm

        if not self._wanted("lifts", "Look which lift is the left one now?"):
            return None
        while True:
            arm(self.daemon().client)
            agree("lifts.raise", f"The blade rises to {CLEAR_MM:g} mm above the ground. Is it clear?")
            self.command("jog", "height", f"{CLEAR_MM:g}mm")
            if self.command("calibrate", "lifts", "--config", str(self.path)) == ExitCode.OK:
                break
            self._is_up = False  # they were exchanged: once more, to see it
        self._daemon.client.command("disarm")
        return {axis: getattr(getattr(self.config(), axis), "address_n", None) for axis in LIFTS}

    def calibrate_camera(self) -> dict[str, Any] | None:
        """Where the camera sits."""
        from graderd.cli.stop_tests import arm

        if not self._wanted("camera", "Find out where the camera sits now? The blade is empty, the ground level"):
            return None
        client = self.daemon().client
        arm(client)
        agree("camera.lower", f"The blade sinks to {ABOVE_MM:g} mm above the ground. Is it clear?")
        self.command("jog", "height", f"{ABOVE_MM:g}mm")
        client.command("disarm")
        rotation = self.config().rotation
        most_deg = min(40.0, rotation.max_deg - 2.0, -rotation.min_deg - 2.0)
        angles = ",".join(f"{share * most_deg:.0f}" for share in (-1.0, -0.5, 0.0, 0.5, 1.0))
        picture = self.path.with_name("calibration.jpg")
        self.command(
            *("calibrate", "camera", "--config", str(self.path), "--save", str(picture), f"--angles-deg={angles}")
        )
        self._is_up = False
        calibration = self.config().camera.calibration
        return {"residual_mm": calibration.residual_mm, "residual_px": calibration.residual_px, "picture": str(picture)}

    def sign(self) -> None:
        """Put a name under the record, if all of it is there."""
        now = self.resolved()
        missing = [step.title for step in STEPS if not self.record.is_done(step.name, now)]
        if missing:
            print_text(f"\nNot signed; missing: {'; '.join(missing)}. 'graderd setup' goes on there.")
            raise typer.Exit(ExitCode.FAILED)
        if self.record.signature is not None and self.record.is_as_signed():
            print_text(f"\n{self.record.path}: signed by {self.record.signature['by']}")
            return
        name = ask("signed_by", "\nAll done. Your name, under the commissioning record", _name)
        sealed = self.record.sign(name, self.config().sha256())
        print_text(f"{self.record.path}: signed by {name}, sha256 {sealed[:16]}")

    # -- questions -----------------------------------------------------------------------------------------------------

    def _wanted(self, key: str, question: str) -> bool:
        return ask(key, question, _yes_or_no, "y")

    def _one(self, key: str, question: str, found: Mapping[str, str], present: str) -> str:
        """One of what was found; Enter takes the present one, else the first."""
        names = list(found)
        print_text(numbered(list(found.items())))
        return ask(key, f"{question}? number", choice(names), present if present in names else names[0])

    def _serial_port(self, what: str, present: str, ports: dict[str, str]) -> str:
        if not ports:
            raise CliError(what, "no serial adapter is plugged in", "Plug it in, then do it again")
        print_text(numbered(list(ports.items())))
        names = list(ports)
        default = present if present in names else names[0] if len(names) == 1 else UNPLUG
        question = f"Which is the {what}'s adapter? number, or '{UNPLUG}' to find it by its plug"
        answer = ask(f"{what}.port", question, choice(names, UNPLUG), default)
        return self._unplugged(what, names) if answer == UNPLUG else answer

    def _unplugged(self, what: str, names: list[str]) -> str:
        """The port that goes and comes back when the person pulls its plug."""
        print_text(f"Pull the {what}'s adapter out of the computer now (waiting {UNPLUG_S:g} s)")
        gone = self._wait(lambda: [name for name in names if name not in self.wires.serial_ports()])
        if len(gone) != 1:
            cause = "nothing was pulled" if not gone else f"{' and '.join(gone)} went together"
            raise CliError(f"{what}.port", cause, "Do it again, or give the number")
        print_text(f"It is {gone[0]}. Plug it in again")
        if not self._wait(lambda: [name for name in gone if name in self.wires.serial_ports()]):
            raise CliError(f"{what}.port", f"{gone[0]} did not come back", "Plug it in, then do it again")
        return gone[0]

    @staticmethod
    def _wait(look: Callable[[], list[str]]) -> list[str]:
        give_up_s = time.monotonic() + UNPLUG_S
        while not (found := look()) and time.monotonic() < give_up_s:
            time.sleep(POLL_S)
        return found

    def _can(self, config: Config, servo_port: str) -> tuple[str, str]:
        interfaces = self.wires.can_interfaces()
        ports = {port: told for port, told in self.wires.serial_ports().items() if port != servo_port}
        found = {**interfaces, **{port: f"{told} (slcan)" for port, told in ports.items()}}
        if not found:
            remedy = "Plug the CAN adapter in; sudo systemctl start graderd-can@can0"
            raise CliError("can", "there is no CAN interface and no other serial adapter", remedy)
        channel = self._one("can.channel", "Which is the actuators' bus", found, str(config.can.channel))
        return ("slcan" if channel in ports else "socketcan"), channel

    def _stop_loop(self, config: Config, taken: set[str]) -> dict[str, Any]:
        loops = self.wires.stop_loops()
        ports = [port for port in self.wires.serial_ports() if port not in taken]
        backends = {
            "none": "no loop: the emergency stop cuts the power, and graderd sees that",
            **{name: f"loop at {port}" for name, port in loops.items()},
            **({"serial": f"loop on the modem lines of {', '.join(ports)}"} if ports else {}),
        }
        present = config.stop_input.backend
        if present not in backends:
            backends[present] = "as it is configured"
        default = present if present != "none" or not loops else next(iter(loops))
        backend = self._one("stop_input.backend", "What stops the machine beside commands", backends, default)
        if backend in loops:
            return {"backend": backend, "port": loops[backend]}
        if backend == "serial" and ports:
            port = self._one("stop_input.port", "On which port", dict.fromkeys(ports, "serial adapter"), ports[0])
            return {"backend": backend, "port": port}
        return {"backend": backend}

    # -- the bus -------------------------------------------------------------------------------------------------------

    @staticmethod
    def _heard(client: Client) -> dict[str, bool]:
        """Which actuators' positions are known, after waiting a while for all."""
        give_up_s = time.monotonic() + HEARD_S
        while True:
            axes = client.get("/v1/status")["axes"]
            heard = {axis: axes[axis]["measured"] is not None for axis in ACTUATORS}
            if all(heard.values()) or time.monotonic() > give_up_s:
                return heard
            time.sleep(POLL_S)

    def _sources(self, client: Client) -> list[int]:
        """Addresses that are heard on the bus, but for our own."""
        give_up_s = time.monotonic() + BUS_S
        found: set[int] = set()
        with suppress(TimeoutError), client.bus_text("can") as texts:
            for text in texts:
                found |= sources_of(text)
                if time.monotonic() > give_up_s:
                    break
        return sorted(found - {self.config().can.source_address_n})


def _unlatched(client: Client) -> None:
    """A daemon that has just begun is stopped where its stop loop was not read yet: nothing moved, and nothing does.

    Raises:
        CliError: it stays stopped.
    """
    give_up_s = time.monotonic() + HEARD_S
    while (status := client.get("/v1/status"))["mode"] == "stopped":
        with suppress(RefusedError):
            client.reset()
        if time.monotonic() > give_up_s:
            cause = f"the machine stays stopped: {status['reason']}"
            raise CliError("stop input", cause, "Release it, look at its loop, then do it again")
        time.sleep(POLL_S)


def sources_of(candump: str) -> set[int]:
    """The J1939 source addresses in lines of candump: the last eight bits of a 29-bit identifier."""
    return {int(match[1], 16) for match in re.finditer(r"\b[0-9A-F]{6}([0-9A-F]{2})#", candump)}


@dataclass(frozen=True)
class Step:
    """``rests_on``: the keys of the configuration that the step found, or that what it found holds for. Where ``run``
    returns None, the person left it out."""

    name: str
    title: str
    rests_on: tuple[str, ...]
    run: Callable[[_Setup], dict[str, Any] | None]


_WIRES = ("rotation.port", "can.interface", "can.channel", "camera.source", "camera.serial_number", "camera.path")
_SERVO = ("rotation.port", "rotation.baud_n", "rotation.servo_id_n", "rotation.profile")
_SCALE = ("rotation.zero_deg", "rotation.sign", "rotation.gear_ratio")
_ADDRESSES = tuple(f"{axis}.address_n" for axis in ACTUATORS)
STEPS: Final = (
    Step("wires", "what is plugged in", (*_WIRES, "stop_input.backend", "stop_input.port"), _Setup.find_wires),
    Step("servo", "the servo's baud rate and id", _SERVO, _Setup.find_servo),
    Step("actuators", "the actuators' addresses", ("can.interface", "can.channel", *_ADDRESSES), _Setup.find_actuators),
    Step("rotation", "zero, sign and limits of the rotation", (*_SERVO, *_SCALE), _Setup.calibrate_rotation),
    Step(
        "stop",
        "the stop, three ways",
        (*_SERVO, "stop_input.backend", "stop_input.port", "rotation.watchdog_s", "rotation.speed_deg_per_s"),
        _Setup.test_stops,
    ),
    Step("lifts", "left and right", _ADDRESSES, _Setup.calibrate_lifts),
    Step(
        "camera",
        "where the camera sits",
        ("camera.source", "camera.serial_number", "camera.calibration.calibrated_at"),
        _Setup.calibrate_camera,
    ),
)


def _yes_or_no(text: str) -> bool:
    if text.lower() not in ("y", "yes", "n", "no"):
        raise ValueError(f"{text!r} is neither y nor n")
    return text.lower() in ("y", "yes")


def _address(text: str) -> int:
    if not text.isdecimal() or int(text) > 253:
        raise ValueError(f"{text!r} is no address from 0 to 253")
    return int(text)


def _name(text: str) -> str:
    if not text:
        raise ValueError("somebody answers for it: a name, please")
    return text
