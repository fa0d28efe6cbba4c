"""``graderd guard``: make the machine safe after the daemon has died."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from graderd.cli.console import Json, print_json
from graderd.cli.epilog import example


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd guard --config /etc/graderd/graderd.toml"))
    def guard(
        config: Annotated[
            Path | None, typer.Option(help="Configuration file. Default: /etc/graderd/graderd.toml if it exists.")
        ] = None,
        json: Json = False,
    ) -> None:
        """Make the machine safe without a daemon.

        Sends motion-disable to the actuators and makes the servo safe. systemd runs it whenever the daemon has
        ended, whatever it ended of.
        """
        from graderd.runtime.app import run_guard

        log = logging.getLogger("graderd")
        log.addHandler(logging.StreamHandler())
        log.setLevel(logging.INFO)
        status = run_guard(config)
        if json:
            print_json({"safe": status == 0})
        raise typer.Exit(status)
