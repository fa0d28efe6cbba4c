"""``graderd calibrate camera``: find out where the camera sits, show it, and write it into the configuration."""

from __future__ import annotations

import base64
import os
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd import places
from graderd.cli import calibrate_color, calibrate_lifts, calibrate_rotation
from graderd.cli.asking import agree
from graderd.cli.console import (
    DEFAULT_CONFIG,
    CliError,
    ExitCode,
    Json,
    client_of,
    example,
    plain_table,
    print_json,
    print_text,
)
from graderd.hal.errors import DeviceError

if TYPE_CHECKING:
    from graderd.config.models import Config
    from graderd.perception.calibration import CalibrationResult
    from graderd.perception.frame_set import FrameSet

DEFAULT_ANGLES_DEG = "-40,-20,0,20,40"
LIVE_TIMEOUT_S = 120.0
FETCH_TIMEOUT_S = 10.0
POSE_NAMES = ("position_x_m", "position_y_m", "position_z_m", "pitch_down_deg", "yaw_deg", "roll_deg")
BLADE_NAMES = ("x_offset_m", "length_m", "height_m")


def register(app: typer.Typer) -> None:
    """Add the command group."""
    group = typer.Typer(help="Find out how this machine differs from the drawing, and write it down.")
    app.add_typer(group, name="calibrate")

    @group.callback()
    def calibrate() -> None:
        """Find out how this machine differs from the drawing, and write it down."""

    calibrate_color.register(group)
    calibrate_lifts.register(group)
    calibrate_rotation.register(group)

    @group.command(
        epilog=example(
            "graderd calibrate camera",
            "graderd calibrate camera --from empty_blade/ --config graderd.toml",
            "graderd calibrate camera --pose 0.8,0.03,0.55,35,0,0",
        )
    )
    def camera(
        context: typer.Context,
        source: Annotated[
            Path | None,
            typer.Option("--from", metavar="FRAME_SET", help="Recorded frames of the empty blade at known angles."),
        ] = None,
        pose: Annotated[
            str | None,
            typer.Option(
                metavar="X,Y,Z,PITCH,YAW,ROLL",
                help="Measured by hand: colour camera's place in m from the blade's axis on the ground, angles in deg. "
                "Alone it is written as it is; with frames the search starts there.",
            ),
        ] = None,
        angles_deg: Annotated[
            str, typer.Option(metavar="LIST", help="Blade angles to turn to, where the servo turns the blade.")
        ] = DEFAULT_ANGLES_DEG,
        config: Annotated[Path | None, typer.Option(help=f"Configuration to change. {DEFAULT_CONFIG}")] = None,
        save: Annotated[Path, typer.Option(metavar="FILE", help="Where the picture with the result goes.")] = Path(
            "calibration.jpg"
        ),
        live: Annotated[bool, typer.Option("--live", help="Turn the blade and take frames, also with --pose.")] = False,
        yes: Annotated[
            bool, typer.Option("--yes", help="Consent: turn the blade and write the result unasked.")
        ] = False,
        json: Json = False,
    ) -> None:
        """Solve where the camera sits from frames of the empty blade at known angles.

        Without --from and --pose the running daemon turns the blade (after you consented) and takes the frames. The
        result is shown on a picture with LEFT and RIGHT where the operator's left and right are. Nothing is written
        before you agree; the former file is kept as a dated backup. The machine's own configuration is root's: with
        sudo. Whoever may not write it learns that before anything moves.
        """
        if json and not yes:
            raise CliError("calibrate", "--json cannot ask", "Add --yes to consent", ExitCode.USAGE)
        path = config or places.config()
        settings = load_config(path, must_exist=config is not None)
        start_pose = _pose(pose)
        may_write(path)
        if source is None and start_pose is not None and not live:
            _by_hand(path, settings, start_pose, yes, json)
            return
        _may_save(save)
        with TemporaryDirectory(prefix="graderd-") as room:
            frames = _recorded(source or _live(context, Path(room), angles_deg, yes, json))
            result = _solve(settings, frames, start_pose)
            _picture(frames, result, save)
        if json:
            print_json(_result_object(settings, result, save))
        else:
            print_text(_result_text(settings, result, save))
        _agree(
            "camera.write", f"Do LEFT and RIGHT in {save} stand where yours are, facing forward? Write to {path}?", yes
        )
        backup = write_calibration(path, _changes(result))
        done(path, backup, json)


def load_config(path: Path, must_exist: bool) -> Config:
    """The configuration to change; a new one's defaults where it may be new.

    Raises:
        CliError: it is not valid.
    """
    from graderd.config.loader import ConfigError, load
    from graderd.config.models import Config as Model

    try:
        return load(path) if must_exist or os.path.lexists(path) else Model()
    except ConfigError as error:
        raise CliError("", error.problems[0], "", ExitCode.USAGE) from None


def _pose(text: str | None) -> dict[str, float] | None:
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(POSE_NAMES) or not all(abs(value) < 400 for value in values) or abs(values[3]) >= 89:
        raise CliError(
            "--pose",
            f"{text!r} is not six numbers x,y,z,pitch,yaw,roll",
            "For example 0.8,0.03,0.55,35,0,0",
            ExitCode.USAGE,
        )
    return dict(zip(POSE_NAMES, values, strict=True))


def _by_hand(path: Path, settings: Config, pose: dict[str, float], yes: bool, as_json: bool) -> None:
    from graderd.perception.calibration import with_pose

    calibration = with_pose(settings.camera.calibration, pose).model_copy(
        update={"calibrated_at": f"{datetime.now(UTC):%Y-%m-%d %H:%M} by hand", "residual_mm": 0.0, "residual_px": 0.0}
    )
    _agree("camera.write", f"Write this pose to {path}?", yes)
    backup = write_calibration(path, {"camera": {"calibration": calibration.model_dump()}})
    done(path, backup, as_json)


def _recorded(source: Path) -> FrameSet:
    from graderd.perception.frame_set import FrameSet

    try:
        return FrameSet(source)
    except DeviceError as error:
        raise CliError(error.where, error.cause, error.remedy, ExitCode.USAGE) from None


def _live(context: typer.Context, room: Path, angles_deg: str, yes: bool, as_json: bool) -> Path:
    """Have the daemon turn the blade and take the frames, and fetch them into a frame set in ``room``."""
    try:
        angles = [float(part) for part in angles_deg.split(",")]
    except ValueError:
        raise CliError("--angles-deg", f"{angles_deg!r} is not a list of numbers", "", ExitCode.USAGE) from None
    daemon = client_of(context)
    if not as_json:
        print_text(
            f"The blade will turn to {', '.join(f'{angle:+g}' for angle in angles)} degrees, one after the other."
        )
    _agree(
        "camera.clear",
        "Is the blade empty and just above level ground, and is everybody clear of it? Turn it now?",
        yes,
    )
    answer = daemon.maneuver("camera.calibrate", LIVE_TIMEOUT_S, consent=True, angles_deg=angles)
    folder = room / _plain(answer["frame_set"])
    folder.mkdir()
    for name in answer["files"]:
        picture = folder / _plain(name)
        content = daemon.service("camera.calibration_file", FETCH_TIMEOUT_S, file=name)["base64"]
        picture.write_bytes(base64.b64decode(content))
    return folder


def _plain(name: str) -> str:
    """A name the daemon gave, where it stays in its folder: root shall not write where the daemon says."""
    if name != Path(name).name or name in ("", ".", ".."):
        raise CliError("camera.calibrate", f"the daemon names a file {name!r}", "See its log")
    return name


def _solve(settings: Config, frames: FrameSet, start_pose: dict[str, float] | None) -> CalibrationResult:
    from graderd.perception.calibration import CalibrationError, EmptyBlade, calibrate, with_pose

    start = settings.camera.calibration
    # Lens data belong to the frames; where the frames say nothing better, so does the place to start from.
    start = start.model_copy(
        update={
            "color": _with_lens(start.color, frames.calibration.color),
            "depth": _with_lens(start.depth, frames.calibration.depth),
        }
    )
    if start_pose is not None:
        start = with_pose(start, start_pose)
    try:
        views = [EmptyBlade(frame, entry.blade_angle_deg, entry.attitude) for entry, frame in frames.frames()]
        return calibrate(views, start, settings.blade, f"{datetime.now(UTC):%Y-%m-%d %H:%M} from {frames.folder.name}")
    except DeviceError as error:
        raise CliError(error.where, error.cause, error.remedy, ExitCode.USAGE) from None
    except CalibrationError as error:
        raise CliError("calibration", str(error), "Nothing was changed") from None


def _with_lens(stream: Any, lens: Any) -> Any:
    names = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion_n")
    return stream.model_copy(update={name: getattr(lens, name) for name in names})


def _picture(frames: FrameSet, result: CalibrationResult, path: Path) -> None:
    import cv2
    import numpy as np

    from graderd.perception.annotate import calibration_picture

    middle = min(frames.entries, key=lambda entry: abs(entry.blade_angle_deg))
    widest = max(frames.entries, key=lambda entry: entry.blade_angle_deg)
    pictures = [
        calibration_picture(frames.frame(entry).color_bgr, result, entry.blade_angle_deg) for entry in (middle, widest)
    ]
    coded, data = cv2.imencode(path.suffix or ".jpg", np.vstack(pictures))
    try:
        if coded:
            path.write_bytes(data.tobytes())
    except OSError as error:
        raise CliError(str(path), f"cannot be written ({error.strerror})", "Name another with --save") from None


def _rows(settings: Config, result: CalibrationResult) -> list[tuple[str, float, float, float]]:
    old, new = settings.camera.calibration.color, result.calibration.color
    rows = [(n, float(getattr(old, n)), float(getattr(new, n)), result.uncertainty[n]) for n in POSE_NAMES]
    blade = settings.blade
    return rows + [
        (f"blade.{n}", float(getattr(blade, n)), float(getattr(result.blade, n)), result.uncertainty[n])
        for n in BLADE_NAMES
    ]


def _result_text(settings: Config, result: CalibrationResult, save: Path) -> str:
    rows = [(n, f"{old:.4f}", f"{new:.4f}", f"{sigma:.4f}") for n, old, new, sigma in _rows(settings, result)]
    table = plain_table("", ("", "before", "found", "1 sigma"), rows)
    fits = [
        f"{value:.1f} {unit}"
        for value, unit in ((result.residual_mm, "mm"), (result.residual_px, "px"))
        if value is not None
    ]
    return f"{table}\nfits to {' and '.join(fits)} over {result.frames_n} frames; picture: {save}"


def _result_object(settings: Config, result: CalibrationResult, save: Path) -> dict[str, Any]:
    return {
        "residual_mm": result.residual_mm,
        "residual_px": result.residual_px,
        "frames_n": result.frames_n,
        "picture": str(save),
        "found": {
            name: {"before": old, "found": round(new, 5), "sigma": round(sigma, 5)}
            for name, old, new, sigma in _rows(settings, result)
        },
    }


def _changes(result: CalibrationResult) -> dict[str, Any]:
    return {
        "camera": {"calibration": result.calibration.model_dump()},
        "blade": {name: round(float(getattr(result.blade, name)), 5) for name in BLADE_NAMES},
    }


def _agree(key: str, question: str, yes: bool) -> None:
    if not yes:
        agree(key, question, "Add --yes to consent beforehand")


def write_calibration(path: Path, changes: dict[str, Any]) -> Path | None:
    """Put ``changes`` (tables of tables) into the configuration; the backup of the former file, None if there was none.

    Raises:
        CliError: it cannot be read or written, or would not be a valid configuration; the file is as it was.
    """
    from graderd.config.loader import ConfigError
    from graderd.config.rewrite import merged, rewrite

    try:
        return rewrite(path, lambda text: merged(text, changes), create=True)
    except ConfigError as error:
        raise CliError("", error.problems[0]) from None


def may_write(path: Path) -> None:
    """Learn now what would keep the result from being written: before the blade turns, and before the person waits."""
    from graderd.config.loader import ConfigError
    from graderd.config.rewrite import check_rights

    try:
        check_rights(path)
    except ConfigError as error:
        raise CliError("", error.problems[0]) from None


def _may_save(picture: Path) -> None:
    if not os.access(picture if picture.exists() else picture.parent, os.W_OK):
        raise CliError(str(picture), "cannot be written", "Name another with --save")


def done(path: Path, backup: Path | None, as_json: bool) -> None:
    """Say what was written."""
    if as_json:
        print_json({"written": str(path), "backup": str(backup) if backup else None})
        return
    kept = f"; the former file is {backup}" if backup else ""
    print_text(f"written to {path}{kept}. Restart the daemon to use it")
