"""``graderd config check | show``: the configuration file, judged and resolved. Needs no daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, cast

import typer

from graderd import places
from graderd.cli.console import CliError, ExitCode, Json, example, print_error, print_json, print_text

if TYPE_CHECKING:
    from graderd.config import Config

File = Annotated[Path | None, typer.Argument(help="Default: /etc/graderd/graderd.toml if it exists.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    config = typer.Typer(help="Check and show the configuration.", no_args_is_help=True)
    app.add_typer(config, name="config")

    @config.command(epilog=example("graderd config check /etc/graderd/graderd.toml"))
    def check(file: File = None, json: Json = False) -> None:
        """Say whether a configuration file is valid, and one this computer can run.

        Every mistake gets a line with place, cause and remedy.
        """
        from graderd.runtime.app import problems

        refusals = problems(load_or_refuse(file, json))
        if refusals:
            _refuse([f"{file or places.CONFIG}: {line}" for line in refusals], json)
        if json:
            print_json({"valid": True, "problems": []})
        else:
            print_text(f"{file or 'configuration'}: valid")

    @config.command(epilog=example("graderd config show", "graderd config show graderd.toml --json"))
    def show(file: File = None, json: Json = False) -> None:
        """Print the configuration as it takes effect, defaults included."""
        resolved = load_or_refuse(file, json).model_dump(mode="json")
        if json:
            print_json(resolved)
        else:
            print_text(_toml(resolved))


def load_or_refuse(file: Path | None, as_json: bool) -> Config:
    """The configuration; a command without a valid one ends with what is wrong with it."""
    from graderd.config import ConfigError, load

    try:
        return load(file)
    except ConfigError as error:
        _refuse(error.problems, as_json)


def _refuse(problems: list[str], as_json: bool) -> NoReturn:
    if as_json:
        print_json({"valid": False, "problems": problems})
        raise typer.Exit(ExitCode.FAILED)
    for problem in problems[:-1]:
        print_error("", problem, "", as_json=False)
    raise CliError("", problems[-1])


def _toml(resolved: dict[str, Any]) -> str:
    """As a configuration file; what is not set has no place in TOML and becomes a comment."""
    import tomlkit

    return cast("str", _section(tomlkit.document(), resolved).as_string()).rstrip()


def _section(table: Any, values: dict[str, Any]) -> Any:
    import tomlkit

    for name, value in values.items():
        if value is None:
            table.add(tomlkit.comment(f"{name}: not set"))
        elif not isinstance(value, dict):
            table.add(name, value)
    for name, value in values.items():
        if isinstance(value, dict):
            table.add(name, _section(tomlkit.table(), value))
    return table
