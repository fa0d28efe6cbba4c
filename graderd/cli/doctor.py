"""``graderd doctor`` and ``graderd bundle``: what is wrong here, and everything a bug report needs in one file."""

from __future__ import annotations

import io
import json
import pwd
import sys
import tarfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd import places
from graderd.cli.console import (
    DEFAULT_CONFIG,
    CliError,
    ExitCode,
    Json,
    client_of,
    example,
    print_json,
    print_table,
    print_text,
)
from graderd.cli.setup_daemon import SERVICE_USER
from graderd.client import ClientError
from graderd.hal.text import printable

if TYPE_CHECKING:
    from graderd.config import Config
    from graderd.doctor import Finding

File = Annotated[Path | None, typer.Option("--config", help=DEFAULT_CONFIG)]
SERVICE_S = 10.0
TAIL_BYTES = 2_000_000
"""So much of the newest recording: some minutes."""


def register(app: typer.Typer) -> None:
    """Add the commands."""

    @app.command(
        epilog=example("graderd doctor", "graderd doctor --json | jq '.findings[] | select(.verdict==\"fail\")'")
    )
    def doctor(context: typer.Context, config: File = None, json: Json = False) -> None:
        """Look the machine over, from top to bottom.

        Each check passes, warns or fails, with the command that repairs. It changes nothing and may run beside a
        daemon. Exit status 1 where something failed.
        """
        from graderd.doctor import Verdict, as_dict, worst

        findings = _examine(context, config)
        if json:
            print_json(as_dict(findings))
        else:
            rows = [(f.verdict.upper() if f.verdict == "fail" else f.verdict, f.check, f.seen) for f in findings]
            print_table("", ("", "check", "seen"), rows)
            for finding in findings:
                if finding.repair and finding.verdict in (Verdict.FAIL, Verdict.WARN):
                    print_text(f"{finding.check}: {printable(finding.repair)}")
        if worst(findings) is Verdict.FAIL:
            raise typer.Exit(ExitCode.FAILED)

    @app.command(epilog=example("sudo graderd bundle", "graderd bundle --out /tmp/report.tar.gz"))
    def bundle(
        context: typer.Context,
        out: Annotated[Path | None, typer.Option(help="Default: graderd-DATE.tar.gz here.")] = None,
        config: File = None,
        json: Json = False,
    ) -> None:
        """Put everything a bug report needs into one file, secrets removed.

        What the doctor says, status, configuration, log, the end of the newest recording, and versions.
        """
        path = out or Path(time.strftime("graderd-%Y%m%d-%H%M%S.tar.gz"))
        try:
            # Refuses before anything is collected, and never writes over a file.
            with path.open("xb") as file, tarfile.open(fileobj=file, mode="w:gz") as archive:
                names = [_add(archive, name, text) for name, text in _parts(context, config)]
        except FileExistsError:
            raise CliError(str(path), "there is such a file", "name another with --out", ExitCode.USAGE) from None
        if json:
            print_json({"bundle": str(path), "files": names})
        else:
            print_text(f"{path}: {', '.join(names)}")


def _examine(context: typer.Context, path: Path | None) -> list[Finding]:
    from graderd.doctor import Machine, examine

    config, refusals = _configuration(path)
    client = client_of(context)
    status: dict[str, Any] | None = None
    with suppress(ClientError):
        status = client.get("/v1/status")
    if status is not None:
        with suppress(ClientError, ValueError):
            config = _config_of(client.config())

    def service(name: str) -> Mapping[str, Any]:
        return client.service(name, SERVICE_S)

    asked = service if status is not None else None
    return examine(Machine(config, status=status, service=asked, user=_daemons_user(path)), refusals)


def _daemons_user(path: Path | None) -> str:
    """Who runs the daemon of this configuration: the service's user for the machine's, else who asks (empty)."""
    try:
        pwd.getpwnam(SERVICE_USER)
    except KeyError:
        return ""
    return SERVICE_USER if (path or places.config()) == places.CONFIG else ""


def _configuration(path: Path | None) -> tuple[Config, list[str]]:
    """The file's, and what keeps the daemon from running with it; where it is not valid, that and the defaults."""
    from graderd.config import Config, ConfigError, load
    from graderd.runtime.app import problems

    try:
        config = load(path)
    except ConfigError as error:
        return Config(), error.problems
    return config, problems(config)


def _config_of(resolved: dict[str, Any]) -> Config:
    """What the daemon that answers runs with."""
    from graderd.config import Config

    return Config.model_validate(resolved)


def _parts(context: typer.Context, path: Path | None) -> Iterator[tuple[str, str]]:
    from graderd.doctor import as_dict, run_command, without_secrets

    yield "doctor.json", json.dumps(as_dict(_examine(context, path)), indent=1)
    client = client_of(context)
    for name, ask in (("status.json", "/v1/status"), ("config-in-force.json", "/v1/config")):
        with suppress(ClientError):
            yield name, without_secrets(json.dumps(client.get(ask), indent=1))
    config, _ = _configuration(path)
    with suppress(OSError):
        yield "graderd.toml", without_secrets((path or places.config()).read_text("utf-8", "replace"))
    commands = {
        "journal.txt": ("journalctl", "--unit=graderd", "--lines=5000", "--output=short-iso-precise", "--no-pager"),
        "kernel.txt": ("journalctl", "--dmesg", "--lines=500", "--no-pager"),
        "usb.txt": ("lsusb", "-t"),
        "links.txt": ("ip", "-details", "-statistics", "link"),
        "packages.txt": (sys.executable, "-m", "pip", "list", "--disable-pip-version-check"),
    }
    for name, command in commands.items():
        told = run_command(*command)
        if told:
            yield name, without_secrets(told)
    if config.recording.directory:
        newest = max(
            Path(config.recording.directory).glob("graderd-*.jsonl"), default=None, key=lambda p: p.stat().st_mtime
        )
        if newest is not None:
            with newest.open("rb") as file:
                file.seek(max(0, newest.stat().st_size - TAIL_BYTES))
                yield f"recording-end-{newest.name}", without_secrets(file.read().decode("utf-8", "replace"))


def _add(archive: tarfile.TarFile, name: str, text: str) -> str:
    data = text.encode()
    entry = tarfile.TarInfo(f"graderd/{name}")
    entry.size, entry.mtime, entry.mode = len(data), int(time.time()), 0o600
    archive.addfile(entry, io.BytesIO(data))
    return name
