"""``graderd classify``: say where the soil lies, frame by frame, in pictures, recordings and frame sets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, plain_table, print_error, print_json, print_text
from graderd.core.soil import Method, Mounting, SoilObservation, Zone
from graderd.hal.errors import DeviceError, ProtocolError

if TYPE_CHECKING:
    from graderd.hal.camera import Camera, Frame
    from graderd.perception.classifier import Classifier
    from graderd.perception.frame_set import Entry
    from graderd.perception.scoring import Score

READ_TIMEOUT_S = 5.0
JPEG_QUALITY = 90


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "graderd classify soil.jpg",
            "graderd classify photos/ --method paper --save annotated/",
            "graderd classify pass1.db3 --blade-angle-deg 30 --config /etc/graderd/graderd.toml",
            "graderd classify frame_set/ --method depth --json",
        )
    )
    def classify(
        source: Annotated[
            Path,
            typer.Argument(readable=False, help="Picture, folder of pictures, video, recording or frame set."),
        ],
        method: Annotated[
            Method | None, typer.Option(help="Default: depth where the source has it, else fast_color.")
        ] = None,
        config: Annotated[
            Path | None,
            typer.Option(help="Configuration with calibration and settings. Makes pictures use the calibration too."),
        ] = None,
        blade_angle_deg: Annotated[
            float | None,
            typer.Option(min=-90, max=90, help="Blade angle. Default: the frame set's own, else 0."),
        ] = None,
        mounting: Annotated[
            Mounting, typer.Option(help="Which way the camera faces, for pictures without a calibration.")
        ] = "facing_blade_from_front",
        save: Annotated[Path | None, typer.Option(metavar="DIR", help="Write annotated pictures here.")] = None,
        json: Json = False,
    ) -> None:
        """Say in which third before the blade the soil lies, for every frame of SOURCE.

        Left and right are the operator's, facing forward. Pictures and videos without --config carry no calibration:
        the thirds are then those of the whole picture.
        """
        try:
            run = Run(source, method, config, blade_angle_deg, mounting)
        except DeviceError as error:
            raise CliError(error.where, error.cause, error.remedy, ExitCode.USAGE) from None
        damaged = run.go(save, json)
        if damaged:
            raise typer.Exit(ExitCode.USAGE)


class Run:
    """One source, opened, with the classifier that fits it."""

    def __init__(
        self,
        source: Path,
        method: Method | None,
        config: Path | None,
        blade_angle_deg: float | None,
        mounting: Mounting,
    ) -> None:
        # Heavy imports wait until the command really runs.
        import cv2

        from graderd.perception import PerceptionSettings
        from graderd.perception.frame_set import FrameSetCamera
        from graderd.perception.scoring import Score
        from graderd.runtime.app.frame_sources import open_camera, settings_for_path

        cv2.setNumThreads(1)  # times are those of one core
        settings = settings_for_path(source)
        self._camera: Camera = open_camera(settings, real_time=False)
        self._camera.open()
        self._set = self._camera.set if isinstance(self._camera, FrameSetCamera) else None
        self._live = settings.source in ("recording", "video")
        self._angle_deg = blade_angle_deg
        self._method = method
        self._mounting = mounting
        self._score: Score = Score()
        self._perception = PerceptionSettings()
        self._calibration = None
        self._blade = None
        if config is not None:
            self._take_config(config)
        elif settings.source == "recording":
            self._take_nominal()
        if self._set is not None:
            self._calibration, self._blade = self._set.calibration, self._set.blade
        self._classifier: Classifier | None = None

    def _take_config(self, path: Path) -> None:
        from graderd.config.loader import ConfigError, load

        try:
            loaded = load(path)
        except ConfigError as error:
            raise CliError("", error.problems[0].removeprefix("graderd: "), "", ExitCode.USAGE) from None
        self._perception = loaded.perception
        self._calibration, self._blade = loaded.camera.calibration, loaded.blade

    def _take_nominal(self) -> None:
        from graderd.core.blade import BladeGeometry
        from graderd.perception import CameraCalibration

        self._calibration, self._blade = CameraCalibration(), BladeGeometry()

    def go(self, save: Path | None, as_json: bool) -> int:
        """Judge every frame; how many pictures were damaged."""
        if save is not None:
            try:
                save.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CliError(str(save), f"cannot be made ({error.strerror})", "", ExitCode.USAGE) from None
        damaged = 0
        for item in self._frames():
            if isinstance(item, DeviceError):
                damaged += 1
                print_error(item.where, item.cause, item.remedy, as_json)
                continue
            frame, entry = item
            observation = self._judge(frame, entry)
            ambiguous = entry is not None and entry.extra.get("ambiguous", "").strip().lower() in ("1", "true", "yes")
            self._score.add(entry.label if entry else None, observation, ambiguous)
            name = entry.id if entry else frame.name
            if save is not None:
                self._save(save, name, frame, observation)
            if as_json:
                print_json(frame_object(name, observation))
            else:
                print_text(frame_line(name, entry.label if entry else None, observation))
        self._camera.close()
        if self._score.labelled_n:
            summary = self._score.summary()
            if as_json:
                print_json({"summary": summary})
            else:
                print_text(summary_text(summary))
        return damaged

    def _frames(self) -> Iterator[tuple[Frame, Entry | None] | DeviceError]:
        from graderd.hal.camera import EndOfFrames
        from graderd.perception.frame_set import FrameSetCamera

        while True:
            try:
                frame = self._camera.read(READ_TIMEOUT_S)
            except EndOfFrames:
                return
            except ProtocolError as error:
                yield error
                if self._set is not None or self._live:
                    return
                continue
            except DeviceError as error:
                yield error
                return
            yield frame, self._camera.entry if isinstance(self._camera, FrameSetCamera) else None

    def _judge(self, frame: Frame, entry: Entry | None) -> SoilObservation:
        if self._classifier is None:
            self._classifier = self._classifier_for(frame)
        angle_deg = self._angle_deg
        if angle_deg is None:
            angle_deg = entry.blade_angle_deg if entry else 0.0
        if entry is None:
            return self._classifier.classify(frame, angle_deg, 0.0)
        return self._classifier.classify(frame, angle_deg, 0.0, entry.attitude)

    def _classifier_for(self, frame: Frame) -> Classifier:
        from graderd.core.blade import BladeGeometry
        from graderd.perception.classifier import make_classifier

        has_depth = frame.depth_mm is not None
        method = self._method
        if method is None:
            method = "depth" if has_depth else "fast_color"
        if method in ("depth", "fused") and not has_depth:
            raise CliError(
                self._camera.description,
                f"--method {method} needs depth, and this source has none",
                "Use --method paper or fast_color",
                ExitCode.USAGE,
            )
        settings = self._perception.model_copy(update={"method": str(method)})
        blade = self._blade or BladeGeometry()
        return make_classifier(settings, self._calibration, blade, self._live, self._mounting)

    def _save(self, folder: Path, name: str, frame: Frame, observation: SoilObservation) -> None:
        import cv2

        assert self._classifier is not None  # it has just judged this frame
        path = folder / f"{name.replace('#', '-')}.annotated.jpg"
        picture = self._classifier.annotate(frame, observation)
        coded, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        try:
            if coded:
                path.write_bytes(data.tobytes())
        except OSError as error:
            raise CliError(str(path), f"cannot be written ({error.strerror})", "", ExitCode.USAGE) from None


def frame_object(name: str, observation: SoilObservation) -> dict[str, Any]:
    """One frame's answer as plain data."""

    def rounded(value: float | None) -> float | None:
        return None if value is None else round(value, 3)

    return {
        "id": name,
        "zone": str(observation.zone),
        "confidence": rounded(observation.confidence),
        "share_left": rounded(observation.share_left),
        "share_center": rounded(observation.share_center),
        "share_right": rounded(observation.share_right),
        "volume_left_l": rounded(observation.volume_left_l),
        "volume_center_l": rounded(observation.volume_center_l),
        "volume_right_l": rounded(observation.volume_right_l),
        "cpu_ms": rounded(observation.cpu_ms),
        "reason": observation.reason,
    }


def frame_line(name: str, label: Zone | None, observation: SoilObservation) -> str:
    """One frame's answer as a line for people."""
    mark = "" if label is None else ("  ok" if label is observation.zone else f"  (label {label})")
    return (
        f"{name}  {observation.zone:<7} {observation.confidence * 100:3.0f} %  {observation.cpu_ms:6.2f} ms  "
        f"{observation.reason}{mark}"
    )


def summary_text(summary: dict[str, Any]) -> str:
    """The summary for people."""
    zones = [str(zone) for zone in Zone]
    rows = [(label, *(str(row[zone]) for zone in zones)) for label, row in summary["confusion"].items()]
    table = plain_table("label \\ answer", ("", *zones), rows)
    return (
        f"{table}\n"
        f"right {summary['accuracy'] * 100:.1f} % of the answers, answered {summary['answered_share'] * 100:.1f} % "
        f"({summary['answered_share_unambiguous'] * 100:.1f} % of the unambiguous), "
        f"left for right {summary['left_right_n']}, empty called pile {summary['false_pile_share'] * 100:.1f} %, "
        f"CPU {summary['cpu_ms_median']:.2f} ms median, {summary['cpu_ms_p99']:.2f} ms p99"
    )
