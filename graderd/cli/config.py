"""``graderd config``: the configuration file made, judged, shown, changed and put back. Needs no daemon."""

from __future__ import annotations

import os
import pwd
import syslog
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, cast

import typer

from graderd import places
from graderd.cli.console import (
    DEFAULT_CONFIG,
    CliError,
    ExitCode,
    Json,
    client_of,
    example,
    print_error,
    print_json,
    print_table,
    print_text,
)
from graderd.hal.text import printable

if TYPE_CHECKING:
    from graderd.config import Config

File = Annotated[Path | None, typer.Argument(help=DEFAULT_CONFIG)]
Which = Annotated[Path | None, typer.Option("--config", help=DEFAULT_CONFIG)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    config = typer.Typer(help="Make, check, show and change the configuration.", no_args_is_help=True)
    app.add_typer(config, name="config")
    _looking(config)
    _changing(config)


def _looking(config: typer.Typer) -> None:

    @config.command(epilog=example("graderd config check /etc/graderd/graderd.toml"))
    def check(file: File = None, json: Json = False) -> None:
        """Say whether a configuration file is valid, and one this computer can run.

        Every mistake gets a line with place, cause and remedy. What 'run' would refuse is refused here.
        """
        _runs(load_or_refuse(file, json), file or places.config(), json)
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

    @config.command(epilog=example("graderd config diff", "graderd config diff --running"))
    def diff(
        context: typer.Context,
        file: File = None,
        running: Annotated[bool, typer.Option(help="Against what the daemon runs with, not the defaults.")] = False,
        json: Json = False,
    ) -> None:
        """Print what a file has otherwise than the defaults.

        With --running: otherwise than the daemon that runs now, which takes a change at its next start.
        """
        from graderd.config import Config

        ours = _flat(load_or_refuse(file, json).model_dump(mode="json"))
        other = _flat(client_of(context).config() if running else Config().model_dump(mode="json"))
        rows = [(key, ours.get(key), other.get(key)) for key in {**other, **ours} if ours.get(key) != other.get(key)]
        if json:
            print_json({"differences": [{"key": key, "file": mine, "other": theirs} for key, mine, theirs in rows]})
        elif rows:
            header = ("key", "file", "running" if running else "default")
            print_table("", header, [(key, _value(mine), _value(theirs)) for key, mine, theirs in rows])
        else:
            print_text("no difference")

    @config.command(epilog=example("graderd config schema > graderd.schema.json"))
    def schema() -> None:
        """Print the JSON Schema of the configuration, for editors that know TOML."""
        from graderd.config import Config

        print_json(Config.model_json_schema())


def _changing(config: typer.Typer) -> None:

    @config.command(epilog=example("graderd config init", "sudo graderd config init", "graderd config init new.toml"))
    def init(file: File = None, json: Json = False) -> None:
        """Write a configuration file to begin with: every key with its meaning and its default.

        Written where 'graderd run' of the same user reads it; what a user's own daemon keeps goes to
        ~/.local/state/graderd. A file that is there is left as it is.
        """
        from graderd.config.template import begin

        path = file or places.config()
        try:
            begin(path)
        except FileExistsError:
            remedy = "change it with 'graderd config set', or name another file"
            raise CliError(str(path), "there is such a file", remedy) from None
        _told("init", path, "")
        _print_done(path, None, json)

    @config.command("set", epilog=example("sudo graderd config set rotation.max_deg 45"))
    def set_(
        context: typer.Context,
        key: Annotated[str, typer.Argument(help="Dotted: rotation.max_deg.")],
        value: Annotated[str, typer.Argument(help="As in TOML; a word needs no quotes.")],
        config: Which = None,
        json: Json = False,
    ) -> None:
        """Change one key of the file; comments stay, the former file is kept beside it.

        What 'run' would refuse is not written. The daemon takes it at its next start, which begins disarmed.
        """
        del context
        from graderd.config import ConfigError, parse
        from graderd.config.rewrite import merged, rewrite

        path = config or places.config()
        change: Any = _given(value)
        for part in reversed(key.split(".")):
            change = {part: change}

        def changed(text: str) -> str:
            import tomllib

            new = merged(text, change)
            _runs(parse(tomllib.loads(new), path, new), path, json)
            return new

        try:
            backup = rewrite(path, changed)
        except ConfigError as error:
            _refuse(error.problems, json)
        _told("set", path, f"{key} = {value}")
        _print_done(path, backup, json)

    @config.command(epilog=example("graderd config restore --list", "sudo graderd config restore"))
    def restore(
        file: File = None,
        to: Annotated[str, typer.Option(help="The backup's date, such as 20261128-210000. Default: the newest.")] = "",
        list_: Annotated[bool, typer.Option("--list", help="List the backups, and change nothing.")] = False,
        json: Json = False,
    ) -> None:
        """Put a former file back; the present one becomes a backup itself."""
        from graderd.config import ConfigError
        from graderd.config.loader import decode
        from graderd.config.rewrite import backups_of, rewrite

        path = file or places.config()
        backups = backups_of(path)
        if list_:
            names = [backup.name for backup in reversed(backups)]
            if json:
                print_json({"backups": names})
            else:
                print_text("\n".join(names) or "no backups")
            return
        wanted = [backup for backup in backups if f".{to}" in backup.name] if to else backups[-1:]
        if len(wanted) != 1:
            why = f"{len(wanted)} backups of {path} match '{to}'" if to else f"there is no backup of {path}"
            raise CliError("config restore", why, "see graderd config restore --list")
        try:
            backup = rewrite(path, lambda _: decode(wanted[0].read_bytes(), wanted[0]))
        except ConfigError as error:
            _refuse(error.problems, json)
        _told("restore", path, wanted[0].name)
        _print_done(path, backup, json)


def _runs(config: Config, path: Path, as_json: bool) -> None:
    """End with what keeps a valid configuration from running here, where something does."""
    from graderd.runtime.app import problems

    refusals = problems(config)
    if refusals:
        _refuse([f"{path}: {line}" for line in refusals], as_json)


def _told(what: str, path: Path, change: str) -> None:
    """Into the event log, beside the daemon's own entries: who changed the configuration."""
    uid = int(os.environ.get("SUDO_UID", os.getuid()))
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = str(uid)
    syslog.openlog("graderd", facility=syslog.LOG_DAEMON)
    syslog.syslog(syslog.LOG_NOTICE, printable(f"config {what} by {user}: {path} {change}".strip()))


def _print_done(path: Path, backup: Path | None, as_json: bool) -> None:
    if as_json:
        print_json({"file": str(path), "backup": None if backup is None else str(backup)})
    else:
        kept = f" (before: {backup.name})" if backup is not None else ""
        print_text(f"{path}: written{kept}; restart the daemon to run with it")


def _given(text: str) -> Any:
    """What somebody typed, as TOML understands it; a word that is no TOML value is text."""
    import tomllib

    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _flat(values: dict[str, Any], under: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict) and value:
            found |= _flat(value, f"{under}{name}.")
        else:
            found[f"{under}{name}"] = value
    return found


def _value(value: Any) -> str:
    import json

    return "not set" if value is None else json.dumps(value, ensure_ascii=False)


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
        raise typer.Exit(ExitCode.USAGE)
    for problem in problems[:-1]:
        print_error("", problem, "", as_json=False)
    raise CliError("", problems[-1], exit_code=ExitCode.USAGE)


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
