"""The requests: status, commands, stop, configuration, preview, services."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Request, Response
from pydantic import JsonValue
from starlette.requests import HTTPConnection

from graderd.api.port import DaemonPort, ServiceError
from graderd.api.problem import Problem, ProblemError
from graderd.api.settings import ApiLimits
from graderd.api.stop import StopLane
from graderd.core.commands import AnyCommand, Command, Reply, Stop
from graderd.core.status import Status
from graderd.hal.text import printable

COMMAND_EXAMPLES: dict[str, Any] = {
    "arm": {"summary": "Power the devices and hold", "value": {"command": "arm", "client": "cab"}},
    "stop": {"summary": "End motion at once", "value": {"command": "stop", "reason": "person near the blade"}},
    "reset": {"summary": "Leave the latched stop", "value": {"command": "reset"}},
    "auto": {"summary": "Let the rule turn the blade", "value": {"command": "auto"}},
    "manual": {"summary": "Hold and take jogs", "value": {"command": "manual"}},
    "jog": {
        "summary": "Turn the blade 5° counter-clockwise; renew within the lease",
        "value": {"command": "jog", "axis": "rotate", "value": 5.0, "relative": True, "client": "cab"},
    },
    "renew": {"summary": "Keep the lease", "value": {"command": "renew", "client": "cab"}},
    "preset": {"summary": "Go to a named pose", "value": {"command": "preset", "name": "transport", "client": "cab"}},
}
PROBLEMS: dict[int | str, dict[str, Any]] = {
    409: {"model": Problem, "description": "understood and refused; the machine is as it was"},
    422: {"model": Problem, "description": "malformed; the machine is as it was"},
    503: {"model": Problem, "description": "too many requests; stop is served all the same"},
    504: {"model": Problem, "description": "the control tick did not answer in time"},
}


NAMES_N = 1000
"""More than connections can be open."""
STOP_BODY: dict[str, Any] = {
    "requestBody": {
        "required": False,
        "description": "may be left out; never a reason to refuse the stop",
        "content": {
            "application/json": {
                "schema": {
                    "type": "object",
                    "properties": {
                        "client": {"type": "string", "maxLength": 80, "description": "who asks"},
                        "reason": {
                            "type": "string",
                            "maxLength": 200,
                            "description": "kept as the reason of the stop; more is cut off",
                        },
                    },
                },
                "example": {"reason": "person near the blade"},
            }
        },
    }
}


class StatusTexts:
    """The newest status as JSON, made once however many clients look on."""

    def __init__(self) -> None:
        self._status: Status | None = None
        self._text = ""

    def text(self, status: Status) -> str:
        if status is not self._status:
            self._status, self._text = status, status.model_dump_json()
        return self._text


def http_routes(port: DaemonPort, limits: ApiLimits, texts: StatusTexts, stops: StopLane) -> APIRouter:
    """The routes over ``port``; ``stops`` carries out what asks for a stop."""
    router = APIRouter(prefix="/v1")
    names = ConnectionNames()

    @router.get("/status", tags=["status"], summary="Everything at the last control tick", response_model=Status)
    async def status() -> Response:
        return Response(texts.text(port.status()), media_type="application/json")

    @router.post("/commands", tags=["commands"], summary="Send one command", responses=PROBLEMS)
    async def command(
        command: Annotated[AnyCommand, Body(openapi_examples=COMMAND_EXAMPLES)], request: Request
    ) -> Reply:
        """The reply comes after the control tick that took the command.

        A jog or preset moves only while its lease is renewed (`renew`, at least every 0.3 s, 0.1 s advised) on the
        connection that asked for it: the daemon names connections, and `client` is only what people read. The
        WebSocket `/v1/jog` does that too, and gives the lease back at once when the connection ends.
        """
        asked = command.model_copy(update={"client": names.of(command.client, request)})
        return accepted(await obey(port, asked, limits))

    @router.post("/stop", tags=["commands"], summary="End motion at once", openapi_extra=STOP_BODY)
    async def stop(request: Request) -> Reply:
        """Wins over everything, latches, may be repeated; served ahead of every other request and never refused. The
        request line is the stop: motion ends whatever the body is, which only says why; what was not understood of it
        is told in `message`. Every other method does the same."""
        return await stops.serve(request.receive)

    @router.get("/config", tags=["status"], summary="The configuration in force")
    async def config() -> dict[str, Any]:
        return port.config()

    @router.get(
        "/preview.jpg",
        tags=["status"],
        summary="The newest picture with the three zones drawn on it",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}}, 404: {"model": Problem, "description": "no picture yet"}},
    )
    async def preview() -> Response:
        try:
            picture = await port.preview_jpeg()
        except ServiceError as error:
            raise ProblemError(404, error.message, "preview", error.remedy) from error
        return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    @router.post(
        "/services/{name}",
        tags=["services"],
        summary="A device service outside the control loop",
        responses={409: PROBLEMS[409], 422: PROBLEMS[422], 503: PROBLEMS[503]},
    )
    async def service(
        name: Annotated[str, Path(max_length=80, pattern=r"^[a-z_.]+$", examples=["rotation.verify_profile"])],
        arguments: Annotated[
            dict[str, JsonValue] | None,
            Body(openapi_examples={"reboot": {"summary": "Reboot the servo", "value": {"consent": True}}}),
        ] = None,
    ) -> dict[str, Any]:
        """`rotation.verify_profile`, `rotation.reboot`, `rotation.step_response`, `camera.calibrate` (its pictures:
        `camera.calibration_file`, once each). Those that move a device or take its power want `consent: true`: somebody
        has looked and nobody is near the blade."""
        try:
            return await port.service(name, dict(arguments or {}))
        except ServiceError as error:
            raise ProblemError(409, error.message, name, error.remedy) from error

    return router


class ConnectionNames:
    """The names that leases go by: what a client called itself first on its connection, and the number of that
    connection, which is the daemon's to give and nobody else's."""

    def __init__(self) -> None:
        self._names: OrderedDict[int, str] = OrderedDict()

    def of(self, given: str, connection: HTTPConnection) -> str:
        """The name of whoever speaks on this connection."""
        number = connection.client.port if connection.client is not None else 0
        if number not in self._names:
            self._names[number] = f"{printable(given) or 'client'}#{number}"
            if len(self._names) > NAMES_N:
                self._names.popitem(last=False)
        return self._names[number]


async def obey(port: DaemonPort, command: Command, limits: ApiLimits) -> Reply:
    """Hand a command over and wait for its reply, not for ever.

    Raises:
        ProblemError: 504, the control tick did not answer.
    """
    if isinstance(command, Stop):
        return port.stop(command)
    try:
        async with asyncio.timeout(limits.command_timeout_s):
            return await port.command(command)
    except TimeoutError as error:
        raise ProblemError(
            504,
            f"the control tick did not answer within {limits.command_timeout_s:g} s",
            command.command,
            "look at the daemon's log; use the emergency stop if the blade moves",
        ) from error


def accepted(reply: Reply) -> Reply:
    """The reply, if the command was accepted.

    Raises:
        ProblemError: 409, it was refused.
    """
    if not reply.accepted:
        raise ProblemError(409, reply.message, reply.command, reply.remedy)
    return reply
