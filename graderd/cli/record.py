"""``graderd record``: what was recorded, and what the running daemon is to record."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd import places
from graderd.cli.asking import agree
from graderd.cli.console import (
    CliError,
    ExitCode,
    Json,
    client_of,
    error_line,
    example,
    print_json,
    print_table,
    print_text,
)
from graderd.client import NoDaemonError
from graderd.hal.errors import DeviceError

if TYPE_CHECKING:
    from graderd.config import Config
    from graderd.record.layout import Gap, Unreadable
    from graderd.record.store import Entry, Store

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="Whose recordings. Default: the running daemon's, else the installed.")
]
Folder = Annotated[Path | None, typer.Option("--dir", help="Look in this folder instead.")]


class Raw(StrEnum):
    """How many raw frames go with a run."""

    OFF = "off"
    REDUCED = "reduced"
    FULL = "full"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Recordings: list, export, prune; and mark, start, stop on the running daemon.")
    _reading(group)
    _running(group)
    app.add_typer(group, name="record", no_args_is_help=True)


def _reading(group: typer.Typer) -> None:
    @group.command("list", epilog=example("graderd record list", "graderd record list --json"))
    def list_(
        context: typer.Context,
        verify: Annotated[
            bool, typer.Option("--verify", help="Read all of each, and say where it is damaged.")
        ] = False,
        config: ConfigFile = None,
        folder: Folder = None,
        json: Json = False,
    ) -> None:
        """List the recordings, newest last, and forecast how long the room lasts.

        With --json it prints one object a recording. --verify takes about a second for every hour that was recorded;
        exit status 1 where something is damaged.
        """
        settings, store = _store(context, config, folder)
        told = [(entry, told_of(entry, verify=verify)) for entry in store.entries()]
        is_damaged = any(found["gaps"] for _, found in told)
        if json:
            for _, found in told:
                print_json(found)
            if is_damaged:
                raise typer.Exit(ExitCode.FAILED)
            return
        rows = [
            (
                Path(found["file"]).name,
                found["kind"],
                f"{found['duration_s']:.0f} s" if found["duration_s"] is not None else "?",
                f"{found['size_mb']:.1f} MB",
                state_of(found),
                found["reason"],
            )
            for _, found in told
        ]
        print_table("", ("file", "kind", "length", "size", "state", "reason"), rows)
        forecast = forecast_of([found for _, found in told], settings)
        total_mb = sum(found["size_mb"] for _, found in told)
        print_text(
            f"{len(told)} recordings, {total_mb:.0f} of {settings.recording.max_mb:g} MB (recording.max_mb). "
            f"A run takes {forecast['mb_per_hour']:.0f} MB an hour ({forecast['from']}): "
            f"{forecast['hours']:.0f} hours fit. With every raw frame about {forecast['raw_mb_per_hour']:.0f} MB an "
            f"hour more ({forecast['raw_from']}), with one of {settings.recording.raw_every_n} about "
            f"{forecast['raw_mb_per_hour'] / settings.recording.raw_every_n:.0f}."
        )
        for _, found in told:
            for gap in found["gaps"]:
                print_text(gap["text"])
        if is_damaged:
            raise typer.Exit(ExitCode.FAILED)
        if not verify:
            print_text("None was read through; --verify does, and says where one is damaged.")

    @group.command(epilog=example("graderd record export graderd-20260102T030405Z-000.mcap --to monday"))
    def export(
        context: typer.Context,
        file: Annotated[Path, typer.Argument(help="A recording, by its path or its name in the list.")],
        to: Annotated[Path, typer.Option("--to", help="Folder to make.")],
        config: ConfigFile = None,
        json: Json = False,
    ) -> None:
        """Write a recording as ordinary files: table, pictures, wires, log, raw frames as a frame set.

        recording.mcap in the folder is the same recording with an end and an index, also where it was cut off. What is
        not as graderd writes it is left out of the other files and told, each channel in a line: exit status 1.
        """
        from graderd.record.export import export as write
        from graderd.record.export import gaps_of

        recording = _opened(path_of(context, file, config))
        try:
            found = write(recording, to)
        except FileExistsError:
            raise CliError(str(to), "is there already", "name a folder that is not", ExitCode.USAGE) from None
        gaps, unreadable = gaps_of(recording), recording.unreadable
        tell_lacking(gaps, unreadable)
        if json:
            print_json({"event": "exported", "folder": str(to), **found, **lacking(gaps, unreadable)})
        else:
            parts = ", ".join(f"{number} {name.removesuffix('_n').replace('_', ' ')}" for name, number in found.items())
            print_text(f"{to}: {parts}")
        if unreadable:
            raise typer.Exit(ExitCode.FAILED)

    @group.command(epilog=example("graderd record prune --keep-mb 500", "graderd record prune --older-days 30 --yes"))
    def prune(
        context: typer.Context,
        keep_mb: Annotated[float | None, typer.Option(min=0, help="Keep the newest that take so much.")] = None,
        older_days: Annotated[float | None, typer.Option(min=0, help="Remove what is older.")] = None,
        incidents: Annotated[bool, typer.Option("--incidents", help="Incidents too; else they are kept.")] = False,
        yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
        config: ConfigFile = None,
        folder: Folder = None,
        json: Json = False,
    ) -> None:
        """Remove recordings, oldest first."""
        if (keep_mb is None) == (older_days is None):
            raise CliError("record prune", "give either --keep-mb or --older-days", "see --help", ExitCode.USAGE)
        _, store = _store(context, config, folder)
        gone = _to_prune(store.entries(), keep_mb, older_days, incidents)
        size_mb = sum(entry.size_n for entry in gone) / 1e6
        if gone and not yes:
            agree("record.prune", f"Remove {len(gone)} recordings, {size_mb:.1f} MB, for good?", "Give --yes")
        for entry in gone:
            entry.path.unlink(missing_ok=True)
        if json:
            print_json({"event": "pruned", "files": [entry.path.name for entry in gone], "size_mb": size_mb})
        else:
            print_text(f"{len(gone)} recordings removed, {size_mb:.1f} MB")


def _running(group: typer.Typer) -> None:
    @group.command(epilog=example('graderd record mark "the windrow ran over"'))
    def mark(
        context: typer.Context,
        text: Annotated[str, typer.Argument(help="What to remember of this moment.")],
        json: Json = False,
    ) -> None:
        """Put a word into the recording; the black box keeps half a minute before and ten seconds after it."""
        client = client_of(context)
        found = client.service("recording.mark", text=text, client=client.name)
        if json:
            print_json({"event": "marked", **found})
        else:
            print_text(f"marked; kept in {found['directory']}")

    @group.command(epilog=example("graderd record start", "graderd record start --raw full"))
    def start(
        context: typer.Context,
        raw: Annotated[
            Raw, typer.Option(help="Raw frames with it, by which perception can be judged again.")
        ] = Raw.OFF,
        json: Json = False,
    ) -> None:
        """Record the run from now on; what the daemon does from its start is in the configuration."""
        found = client_of(context).service("recording.start", raw=raw.value)
        if json:
            print_json({"event": "recording_started", **found})
        else:
            print_text(f"recording to {found['directory']}" + (f", raw frames {raw}" if raw is not Raw.OFF else ""))

    @group.command(epilog=example("graderd record stop"))
    def stop(context: typer.Context, json: Json = False) -> None:
        """Record runs no more. The black box stays on."""
        found = client_of(context).service("recording.stop")
        if json:
            print_json({"event": "recording_stopped", **found})
        else:
            print_text("runs are recorded no more; the black box stays on")


def tell_lacking(gaps: Iterable[Gap], unreadable: Iterable[Unreadable] = ()) -> None:
    """A line on stderr for each part of a recording that cannot be read."""
    for each in (*gaps, *unreadable):
        typer.echo(error_line("", str(each)), err=True)


def lacking(gaps: Iterable[Gap], unreadable: Iterable[Unreadable]) -> dict[str, Any]:
    """The same for programs."""
    return {
        "gaps": [gap.model_dump() for gap in gaps],
        "unreadable": [{**each.model_dump(), "text": str(each)} for each in unreadable],
    }


def state_of(told: dict[str, Any]) -> str:
    """What is wrong with a file, for a line of the list."""
    if told["problem"]:
        return str(told["problem"])
    damaged = f"damaged in {len(told['gaps'])} places" if told["gaps"] else ""
    return ", ".join(filter(None, (damaged, "" if told["ended"] else "no end: cut off, or being written")))


def told_of(entry: Entry, *, verify: bool = False) -> dict[str, Any]:
    """What ``record list`` says of a file; ``verify``: read all of it."""
    from graderd.record.reader import Recording

    found: dict[str, Any] = {
        "file": str(entry.path),
        "kind": entry.kind,
        "size_mb": round(entry.size_n / 1e6, 3),
        "started": None,
        "duration_s": None,
        "ended": False,
        "reason": "",
        "version": "",
        "config_sha256": "",
        "calibration_id": "",
        "gap_before": "",
        "every_n": "1",
        "problem": "",
        "verified": verify,
        "gaps": [],
    }
    try:
        recording = Recording(entry.path)
    except DeviceError as error:
        return found | {"problem": error.cause}
    kept = ("started", "version", "config_sha256", "calibration_id", "reason", "gap_before", "every_n")
    extent = recording.extent
    gaps = recording.gaps if verify else ()
    return (
        found
        | {name: recording.head[name] for name in kept if name in recording.head}
        | {"duration_s": round(extent.duration_s, 3), "ended": extent.is_ended}
        | {"gaps": [{**gap.model_dump(), "text": str(gap)} for gap in gaps]}
    )


ASSUMED_MB_PER_HOUR = 65.0
"""A run without pictures at 50 Hz on the simulated grader."""
ASSUMED_PICTURE_MB = 0.036
_COLOR_SHARE, _DEPTH_SHARE = 0.45, 0.35
"""What lossless PNG leaves of a picture's bytes."""


def forecast_of(told: list[dict[str, Any]], config: Config) -> dict[str, Any]:
    """How much a run takes an hour and how many hours fit: by what was recorded, else by what is known."""

    def measured(kind: str) -> float | None:
        known = [f for f in told if f["kind"] == kind and (f["duration_s"] or 0.0) > 10.0][-5:]
        hours = sum(f["duration_s"] for f in known) / 3600.0
        return sum(f["size_mb"] * _every_n(f) for f in known) / hours if known else None

    camera, own = config.camera, config.recording
    a_run, raw = measured("run"), measured("frames")
    assumed = ASSUMED_MB_PER_HOUR + own.pictures_hz * 3600.0 * ASSUMED_PICTURE_MB
    color_n = camera.color_width_px * camera.color_height_px * 3 * _COLOR_SHARE
    depth_n = camera.depth_width_px * camera.depth_height_px * 2 * _DEPTH_SHARE
    mb_per_hour = assumed if a_run is None else a_run
    return {
        "mb_per_hour": mb_per_hour,
        "from": "estimated" if a_run is None else "measured",
        "hours": own.max_mb / mb_per_hour if mb_per_hour else 0.0,
        "raw_mb_per_hour": (color_n + depth_n) * camera.rate_hz * 3600.0 / 1e6 if raw is None else raw,
        "raw_from": "estimated" if raw is None else "as recorded last",
    }


def _every_n(told: dict[str, Any]) -> int:
    """One frame of how many was kept; whatever a stranger's file says."""
    every_n = str(told["every_n"])
    return int(every_n) if every_n.isascii() and every_n.isdigit() and len(every_n) < 7 else 1


def _to_prune(entries: list[Entry], keep_mb: float | None, older_days: float | None, incidents: bool) -> list[Entry]:
    open_to_it = [entry for entry in entries if incidents or entry.kind != "incident"]
    if older_days is not None:
        before_ns = (datetime.now(UTC) - timedelta(days=older_days)).timestamp() * 1e9
        return [entry for entry in open_to_it if entry.changed_ns < before_ns]
    assert keep_mb is not None  # one of the two is given
    total_n, gone = sum(entry.size_n for entry in open_to_it), []
    for entry in open_to_it:
        if total_n <= keep_mb * 1e6:
            break
        gone.append(entry)
        total_n -= entry.size_n
    return gone


def _store(context: typer.Context, config: Path | None, folder: Path | None) -> tuple[Config, Store]:
    """The configuration and the folder that are meant."""
    from graderd.record.store import Store, directory_of

    settings = settings_of(context, config)
    directory = folder or directory_of(settings.recording.directory) or places.STATE / "recordings"
    own = settings.recording
    return settings, Store(directory, own.max_mb, own.min_free_mb)


def settings_of(context: typer.Context, path: Path | None) -> Config:
    """The file's, else the running daemon's, else the installed one's.

    Raises:
        CliError: the file cannot be read, or is not valid.
    """
    from graderd.config import Config, ConfigError, load

    if path is None:
        try:
            return Config.model_validate(client_of(context).config())
        except NoDaemonError:
            pass
    try:
        return load(path)
    except ConfigError as error:
        raise CliError("", error.problems[0], "", ExitCode.USAGE) from None


def path_of(context: typer.Context, file: Path, config: Path | None) -> Path:
    """A recording by its path, or by its name in the folder."""
    if file.exists() or file.parent != Path():
        return file
    _, store = _store(context, config, None)
    found = store.directory / file
    return found if found.exists() else file


def _opened(path: Path) -> Any:
    from graderd.record.reader import Recording

    return Recording(path)
