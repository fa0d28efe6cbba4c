"""What a client may ask for. The same models serve the state machine, the HTTP interface and the CLI."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictBool

from graderd.core.axes import JogName
from graderd.hal.text import printable

ClientText = Annotated[str, AfterValidator(printable)]
"""What a client writes and others read: in status, log, journal, records and on their terminals. Made printable where
it comes in, so that nobody further on has to think of it."""


def _told_apart(schema: dict[str, Any]) -> None:
    """A command has to say which it is; here it has a default, which a schema takes for leave to omit it."""
    schema["required"] = ["command", *schema.get("required", [])]


def _never_refused(schema: dict[str, Any]) -> None:
    """Whatever else a stop says, it is one."""
    _told_apart(schema)
    schema["additionalProperties"] = True
    for name in ("client", "reason"):
        kept = schema["properties"][name]
        schema["properties"][name] = {
            "description": f"text; more than {kept['maxLength']} characters are cut off, anything else is left out"
        }


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, json_schema_extra=_told_apart)

    client: ClientText = Field("", max_length=80, description="who asks; one client commands at a time")


class Arm(_Command):
    """Power the devices and hold; refused while a mandatory requirement is unmet."""

    command: Literal["arm"] = "arm"


class Disarm(_Command):
    """Hold, then take power away as configured."""

    command: Literal["disarm"] = "disarm"


class Stop(_Command):
    """End motion at once and latch. Wins over everything; idempotent."""

    model_config = ConfigDict(json_schema_extra=_never_refused)

    command: Literal["stop"] = "stop"
    reason: ClientText = Field("stop command", max_length=200)


class Reset(_Command):
    """Leave the latched stop for disarmed. It clears the stop it names and none that came after it."""

    command: Literal["reset"] = "reset"
    stop_n: int = Field(strict=True, ge=0, description="number of the stop that is cleared, as status tells it")


class Auto(_Command):
    """Let the rule turn the blade by what the camera sees; refused while a fault is active that ends it."""

    command: Literal["auto"] = "auto"


class Manual(_Command):
    """Hold and take jogs."""

    command: Literal["manual"] = "manual"


class Jog(_Command):
    """Move one axis while the lease is renewed.

    ``axis``: rotate (deg), lift (mm of both lifts), tilt (mm), height (mm at the blade's centre), slope (deg),
    pitch (deg). ``relative``: the value is added to where the blade is now.
    """

    command: Literal["jog"] = "jog"
    axis: JogName
    value: Annotated[float, Field(strict=True, allow_inf_nan=False, description="in the axis's unit: deg or mm")]
    relative: StrictBool = False


class Preset(_Command):
    """Move to a named pose from the configuration while the lease is renewed."""

    command: Literal["preset"] = "preset"
    name: ClientText = Field(max_length=80)


class Renew(_Command):
    """Keep the lease of the jog in progress."""

    command: Literal["renew"] = "renew"


class Release(_Command):
    """Give the lease back: hold where the blade is."""

    command: Literal["release"] = "release"


Command = Arm | Disarm | Stop | Reset | Auto | Manual | Jog | Preset | Renew | Release
AnyCommand = Annotated[Command, Field(discriminator="command")]


STOP_CAME_FIRST = "a stop came first"
STOP_REMEDY = "read its reason, reset that stop, then ask again"
"""Told of what was asked before a stop and not done yet."""


class Reply(BaseModel):
    """Answer to one command: what happened, and what to do where it was refused."""

    model_config = ConfigDict(frozen=True)

    command: str
    accepted: bool
    message: str
    remedy: str = ""
