"""``graderd replay``: look at a recording, or have it decided again."""

from __future__ import annotations

from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, print_json, print_text
from graderd.cli.record import path_of, tell_lacking

if TYPE_CHECKING:
    from graderd.record.replay import Check, Difference

SHOWN_N = 50


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "graderd replay graderd-20260102T030405Z-000.mcap --check",
            "graderd replay graderd-20260102T030405Z-000.mcap --serve /tmp/monday.sock --speed 4",
            "graderd replay incident.mcap --check --config candidate.toml",
        )
    )
    def replay(
        context: typer.Context,
        file: Annotated[Path, typer.Argument(help="A recording, by its path or its name in `graderd record list`.")],
        check: Annotated[
            bool, typer.Option("--check", help="Decide everything again and list what differs, worst first.")
        ] = False,
        config: Annotated[
            Path | None, typer.Option("--config", help="With --check: by this configuration instead of its own.")
        ] = None,
        serve: Annotated[
            Path | None, typer.Option("--serve", metavar="SOCKET", help="Play it to clients at this socket.")
        ] = None,
        port: Annotated[
            int | None, typer.Option("--port", min=1, max=65534, help="With --serve: on loopback TCP too.")
        ] = None,
        speed: Annotated[float, typer.Option(min=0.01, max=100, help="With --serve: times real time.")] = 1.0,
        from_s: Annotated[float, typer.Option("--from-s", min=0, help="With --serve: begin so far in.")] = 0.0,
        json: Json = False,
    ) -> None:
        """Put a recording through today's perception and tick, or play it to clients.

        --check: what was recorded goes in, raw frames included where there are some; what would have been sent, decided
        or said otherwise is listed, and what could not be compared: where the recording is damaged, up to the next
        memory. Exit status 1 where something differs, is damaged, or nothing could be compared; with --config
        differences are what was asked for.

        --serve: the daemon's own interface, read only, until Ctrl-C. Look with `graderd --socket SOCKET status` or any
        other client; the services replay.play, replay.pause and replay.seek control it.
        """
        if check == (serve is not None):
            raise CliError("replay", "give either --check or --serve", "see graderd replay --help", ExitCode.USAGE)
        path = path_of(context, file, None)
        if serve is None:
            _check(path, config, json)
        else:
            _serve(path, serve, port, speed, from_s, json)


def _serve(path: Path, socket: Path, port: int | None, speed: float, from_s: float, as_json: bool) -> None:
    # Heavy imports wait until the command really runs.
    from graderd.record.reader import Recording
    from graderd.runtime.app import serve_recording

    recording = Recording(path)
    tell_lacking(recording.gaps)

    def ready(duration_s: float) -> None:
        if as_json:
            print_json(
                {
                    "event": "replay_ready",
                    "socket": str(socket),
                    "duration_s": duration_s,
                    "gaps_n": len(recording.gaps),
                }
            )
        else:
            print_text(f"{path.name}, {duration_s:.0f} s: graderd --socket {socket} status; Ctrl-C ends it")

    try:
        serve_recording(recording, socket, port, speed, from_s, ready)
    finally:
        tell_lacking((), recording.unreadable)
    if recording.unreadable:
        raise typer.Exit(ExitCode.FAILED)


def _check(path: Path, config: Path | None, as_json: bool) -> None:
    # Heavy imports wait until the command really runs.
    from graderd.config import load
    from graderd.config.loader import ConfigError
    from graderd.record.reader import Recording
    from graderd.record.replay import check

    try:
        found = check(Recording(path), None if config is None else load(config))
    except ConfigError as error:
        raise CliError("", "; ".join(error.problems), "", ExitCode.USAGE) from None
    if as_json:
        for difference in found.differences:
            print_json({"event": "difference", **asdict(difference)})
        for broken in found.breaks:
            gap = broken.gap and broken.gap.model_dump()
            print_json({"event": "not_compared", **asdict(replace(broken, gap=None)), "gap": gap})
        for lacking in found.picture_gaps:
            print_json({"event": "pictures_missing", "text": str(lacking), "gap": lacking.model_dump()})
        for each in found.unreadable:
            print_json({"event": "unreadable", **each.model_dump(), "text": str(each)})
        print_json(
            {
                "event": "replay_finished",
                "ticks_n": found.ticks_n,
                "differences_n": len(found.differences),
                "frames_n": found.frames_n,
                "skipped_n": found.skipped_n,
                "missing_n": sum(broken.missing_n or 0 for broken in found.breaks),
                "breaks_n": len(found.breaks),
                "unreadable_n": sum(max(1, each.messages_n) for each in found.unreadable),
                "damaged": found.is_damaged,
                "warm_ups_n": found.warm_ups_n,
            }
        )
    else:
        _tell(found)
    if found.is_damaged or not found.ticks_n or (found.differences and config is None):
        raise typer.Exit(ExitCode.FAILED)


def _tell(found: Check) -> None:
    for difference in found.differences[:SHOWN_N]:
        print_text(
            f"{_when(difference)}  {difference.text}" + (f" ({difference.ticks_n} ticks)" * (difference.ticks_n > 1))
        )
    if len(found.differences) > SHOWN_N:
        print_text(f"... and {len(found.differences) - SHOWN_N} more; --json prints all")
    for broken in found.breaks[:SHOWN_N]:
        missing = "nobody knows how many" if broken.missing_n is None else str(broken.missing_n)
        again = "none after that could be" if broken.again_s is None else f"compared again from {broken.again_s:.3f} s"
        print_text(f"{broken.text}; ticks missing: {missing}; {broken.skipped_n} more not compared, {again}")
    if len(found.breaks) > SHOWN_N:
        print_text(f"... and {len(found.breaks) - SHOWN_N} more such places; --json prints all")
    tell_lacking((), found.unreadable)
    for gap in found.picture_gaps:
        print_text(f"{gap}; for the ticks of these pictures stands what was seen then")
    frames = f" and {found.frames_n} raw frames" if found.frames_n else ""
    print_text(f"{found.ticks_n} ticks{frames} decided again: {len(found.differences) or 'no'} differences")
    if not found.ticks_n:
        print_text(
            "Nothing could be compared: after no memory of the tick that today's takes up did enough ticks follow"
        )
    if found.warm_ups_n:
        print_text(
            f"The tick's memory is another version's: {found.skipped_n} ticks after each beginning were not judged"
        )


def _when(difference: Difference) -> str:
    if not difference.log_ns:
        return f"{difference.at_s:.3f} s"
    return datetime.fromtimestamp(difference.log_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]
