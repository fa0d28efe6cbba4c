"""``graderd token create | list | revoke``: who may use the interface by TCP. A running daemon notices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graderd import places
from graderd.cli.config import load_or_refuse
from graderd.cli.console import DEFAULT_CONFIG, Json, example, print_json, print_table, print_text
from graderd.tokens import Right, create_token, read_tokens, revoke_token

if TYPE_CHECKING:
    from graderd.config import Config

Name = Annotated[str, typer.Argument(help="Whose it is, as the log tells it: up to 32 of a-z 0-9 _ . -")]
File = Annotated[Path | None, typer.Option("--config", help=DEFAULT_CONFIG)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    token = typer.Typer(help="Say who may use the interface by TCP.", no_args_is_help=True)
    app.add_typer(token, name="token")

    @token.command(epilog=example("sudo graderd token create tablet --right command"))
    def create(
        name: Name,
        right: Annotated[Right, typer.Option(help="read: look on, and stop. command: everything.")] = Right.READ,
        config: File = None,
        json: Json = False,
    ) -> None:
        """Make a token and print it, once.

        Only its hash is kept. The address that is printed beside it opens the operator page and logs it in.
        """
        from graderd.config import Config

        found = load_or_refuse(config, json)
        made = create_token(_file(found), name, right)
        address = _page(found)
        if json:
            print_json({"name": name, "right": right, "token": made, "page": f"{address}/#{made}" if address else None})
            return
        print_text(made)
        if address:
            print_text(f"{address}/#{made}")
        else:
            usual = Config.model_validate({"api": {"tcp": {}}}).api.tcp
            assert usual is not None
            port = f"graderd config set api.tcp.port_n {usual.port_n}"
            where = f" --config {config}" if config else ""
            print_text(f"nobody listens on TCP yet: {port}{where}, then restart the daemon")

    @token.command("list", epilog=example("graderd token list"))
    def list_(config: File = None, json: Json = False) -> None:
        """List names and rights."""
        known = read_tokens(_file(load_or_refuse(config, json)))
        if json:
            print_json({"tokens": [{"name": t.name, "right": t.right, "made": t.made} for t in known]})
        elif known:
            print_table("", ("name", "right", "made"), [(t.name, t.right, t.made) for t in known])
        else:
            print_text("no tokens")

    @token.command(epilog=example("sudo graderd token revoke tablet"))
    def revoke(name: Name, config: File = None, json: Json = False) -> None:
        """Make a token worthless.

        A running daemon closes its streams within a second, and what it moves by hand holds.
        """
        revoke_token(_file(load_or_refuse(config, json)), name)
        if json:
            print_json({"revoked": name})
        else:
            print_text(f"revoked: {name}")


def _file(config: Config) -> Path:
    return config.api.tcp.token_file if config.api.tcp is not None else places.tokens()


def _page(config: Config) -> str:
    """Where the operator page is; empty where nobody serves it."""
    tcp = config.api.tcp
    if tcp is None:
        return ""
    host = next(iter(tcp.allowed_hosts), tcp.host)
    return f"{'http' if tcp.certificate_file is None else 'https'}://{host}:{tcp.port_n}"
