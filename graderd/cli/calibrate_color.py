"""``graderd calibrate color``: what a colour method is worth on labelled frames of this site, and write it down.

Colour takes rust, plywood and shade for soil. By a colour method the daemon drives only where such a figure stands in
its configuration, and only as long as the settings are those that were measured.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from graderd import places
from graderd.cli.asking import agree
from graderd.cli.classify import summary_text
from graderd.cli.console import DEFAULT_CONFIG, CliError, ExitCode, Json, example, print_json, print_text
from graderd.core.soil import ColorMethod
from graderd.hal.errors import DeviceError


def register(group: typer.Typer) -> None:
    """Add the command to the group ``calibrate``."""

    @group.command(
        epilog=example(
            "graderd calibrate color --from site_frames/",
            "graderd calibrate color --from site_frames/ --method paper --config graderd.toml",
        )
    )
    def color(
        source: Annotated[
            Path, typer.Option("--from", metavar="FRAME_SET", help="Frames of this site, labelled in manifest.csv.")
        ],
        method: Annotated[ColorMethod, typer.Option(help="Which method to measure.")] = "fast_color",
        config: Annotated[Path | None, typer.Option(help=f"Configuration to change. {DEFAULT_CONFIG}")] = None,
        yes: Annotated[bool, typer.Option("--yes", help="Consent: write the result unasked.")] = False,
        json: Json = False,
    ) -> None:
        """Measure a colour method on labelled frames of this site, and let it drive if it is good enough.

        Judged with the colour and decision settings of the configuration. Asked are 20 frames of each bed (left,
        center, right, even, none), 95 % of them answered, 98 % of the answers right, no side taken for the other, and
        less than 1 % of the empty beds called a pile. Where it falls short nothing is written, and the exit status is
        1.
        """
        if json and not yes:
            raise CliError("calibrate", "--json cannot ask", "Add --yes to consent", ExitCode.USAGE)
        _color(source, method, config, yes, json)


def _color(source: Path, method: ColorMethod, config: Path | None, yes: bool, as_json: bool) -> None:
    # Heavy imports wait until the command really runs.
    import cv2

    from graderd.cli.calibrate import done, load_config, may_write, write_calibration
    from graderd.perception.classifier import make_classifier
    from graderd.perception.frame_set import FrameSet
    from graderd.perception.scoring import Score, site_figure

    cv2.setNumThreads(1)
    path = config or places.config()
    settings = load_config(path, must_exist=config is not None).perception
    settings = settings.model_copy(update={"method": method})
    may_write(path)
    score = Score()
    try:
        frames = FrameSet(source)
        judge = make_classifier(settings, frames.calibration, frames.blade, live=False)
        for entry, frame in frames.frames():
            score.add(entry.label, judge.classify(frame, entry.blade_angle_deg, 0.0, entry.attitude))
    except DeviceError as error:
        raise CliError(error.where, error.cause, error.remedy, ExitCode.USAGE) from None
    figure = site_figure(score, settings, f"{datetime.now(UTC):%Y-%m-%d %H:%M} from {frames.folder.name}")
    short = figure.falls_short()
    if as_json:
        print_json({**figure.model_dump(), "falls_short": short})
    elif score.labelled_n:
        print_text(summary_text(score.summary()))
    if short:
        raise CliError(
            "calibrate color", short, 'Nothing was changed. Drive with method = "depth", which needs no light'
        )
    if not yes:
        agree("color.write", f"Are these frames of this site, in its light? Write to {path}?", "Add --yes to consent")
    backup = write_calibration(path, {"perception": {"color": {"site_figure": figure.model_dump()}}})
    done(path, backup, as_json)
