"""The requests: status, commands, stop, configuration, preview, services."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Coroutine
from enum import IntEnum
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Body, Path, Query, Request, Response
from pydantic import BaseModel, Field, StrictBool, create_model
from starlette.requests import HTTPConnection

from graderd.api.http_head import SENT_AHEAD
from graderd.api.limiter import HEARD_S
from graderd.api.port import DaemonPort, ServiceError
from graderd.api.problem import Problem, ProblemError
from graderd.api.settings import ApiLimits
from graderd.api.stop import StopLane
from graderd.api.tcp_guard import Grant
from graderd.core.commands import AnyCommand, Command, Jog, Preset, Release, Renew, Reply, Stop
from graderd.core.status import Status
from graderd.hal.device import DeviceService
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


NEEDS_CONSENT = """Wants `consent: true`, a disarmed machine, and no other such service under way."""
NEEDS_UPGRADE = """ It moves the blade for as long as it runs, so it is a WebSocket of the same path: the first message
is this body, every further one renews the lease, the last that comes is `{"result": ...}` or a `Problem`. It ends, and
the blade holds, when the connection ends or is silent for half a second."""
PICTURE_AGE = "Picture-Age-S"
PICTURE_AGE_SCHEMA = {"description": "seconds since the picture was taken", "schema": {"type": "number"}}
TIMING = "Server-Timing"
TIMING_SCHEMA = {
    "description": "how long the answer was made (`answer;dur=MS`); what else a client waited, it lay on its way",
    "schema": {"type": "string"},
}
UPGRADE = "open it as a WebSocket, or use the client or 'graderd'"
T = TypeVar("T")
log = logging.getLogger(__name__)
NAMES_N = 1000
"""More than connections can be open."""
STOP_BODY: dict[str, Any] = {
    "requestBody": {
        "required": False,
        "description": "may be left out; whatever it is, never a reason to refuse the stop",
        "content": {
            "application/json": {
                "schema": {
                    "anyOf": [
                        {
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
                        {"description": "anything else: what is text of it is the reason"},
                    ]
                },
                "example": {"reason": "person near the blade"},
            }
        },
    }
}


class Width(IntEnum):
    """Few, so that many who look on share the same pictures."""

    W320 = 320
    W480 = 480
    W640 = 640
    W960 = 960


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
        connection that asked for it: the daemon names connections, and `client` is only what people read. Nothing
        moves for requests sent before the last one was answered (pipelining): they would count when they are read. The
        WebSocket `/v1/jog` does that too, and gives the lease back at once when the connection ends.
        """
        if isinstance(command, Jog | Preset | Renew) and getattr(request.state, SENT_AHEAD, False):
            remedy = "wait for each answer, or use the WebSocket"
            raise ProblemError(409, "sent ahead of the answers on its connection", command.command, remedy)
        asked = command.model_copy(update={"client": names.of(command.client, request)})
        return accepted(await obey(port, asked, limits, asker_of(request), request.scope[HEARD_S]))

    @router.post("/stop", tags=["commands"], summary="End motion at once", openapi_extra=STOP_BODY)
    async def stop(request: Request) -> Reply:
        """Wins over everything, latches, may be repeated; served ahead of every other request and never refused. The
        request line is the stop: motion ends whatever the body is, which only says why; what was not understood of it
        is told in `message`. Every other method does the same."""
        return await stops.serve(request.receive, asker_of(request))

    @router.get("/config", tags=["status"], summary="The configuration in force")
    async def config() -> dict[str, Any]:
        return port.config()

    @router.get(
        "/preview.jpg",
        tags=["status"],
        summary="The newest picture with the three zones drawn on it",
        response_class=Response,
        responses={
            200: {"content": {"image/jpeg": {}}, "headers": {PICTURE_AGE: PICTURE_AGE_SCHEMA, TIMING: TIMING_SCHEMA}},
            404: {"model": Problem, "description": "no picture yet"},
        },
    )
    async def preview(
        labels: Annotated[bool, Query(description="with names and numbers in the picture, not lines alone")] = True,
        width_px: Annotated[Width | None, Query(description="no wider than that; none: as the camera gives it")] = None,
    ) -> Response:
        asked_s = time.monotonic()
        try:
            picture, age_s = await port.preview_jpeg(labels=labels, width_px=width_px)
        except ServiceError as error:
            raise ProblemError(404, error.message, "preview", error.remedy) from error
        told = {PICTURE_AGE: f"{age_s:.3f}", TIMING: f"answer;dur={(time.monotonic() - asked_s) * 1e3:.1f}"}
        return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-store", **told})

    for name, offered in port.services().items():
        _add_service(router, port, name, offered)

    @router.post("/services/{name}", include_in_schema=False)
    async def unknown_service(
        name: Annotated[str, Path(max_length=80, pattern=r"^[a-z_.]+$")], request: Request
    ) -> dict[str, Any]:
        return await _served(port, name, {}, asker_of(request))

    return router


def service_request(name: str, offered: DeviceService) -> type[BaseModel]:
    """What a request for a service holds: its arguments, and consent where it may move or unpower something."""
    consent: Any = (StrictBool, Field(False, description="somebody has looked and nobody is near the blade"))
    fields = {} if offered.only_reads else {"consent": consent}
    return create_model(
        f"{name.title().replace('.', '').replace('_', '')}Request", __base__=offered.arguments, **fields
    )


def _add_service(router: APIRouter, port: DaemonPort, name: str, offered: DeviceService) -> None:
    """The route of one service, with its arguments as it describes them."""
    model = service_request(name, offered)

    async def service(request: Request, arguments: Any = None) -> dict[str, Any]:
        if offered.moves:
            raise ProblemError(426, f"{name} moves the blade for as long as its client renews", name, UPGRADE)
        given = {} if arguments is None else arguments.model_dump(exclude_unset=True)
        return await _while_connected(request, _served(port, name, given, asker_of(request)))

    service.__annotations__ = {
        "request": Request,
        "arguments": Annotated[model | None, Body()],
        "return": dict[str, Any],
    }
    service.__doc__ = "" if offered.only_reads else NEEDS_CONSENT + NEEDS_UPGRADE * offered.moves
    responses: dict[int | str, dict[str, Any]] = {number: PROBLEMS[number] for number in (409, 422, 503)}
    if offered.moves:
        responses[426] = {"model": Problem, "description": "asked for without a WebSocket upgrade"}
    router.add_api_route(
        f"/services/{name}",
        service,
        methods=["POST"],
        tags=["services"],
        summary=offered.summary,
        responses=responses,
        operation_id=f"service_{name.replace('.', '_')}",
    )


async def _served(port: DaemonPort, name: str, arguments: dict[str, Any], by: str) -> dict[str, Any]:
    log.info("service %s by %s", name, by)
    try:
        return await port.service(name, arguments)
    except ServiceError as error:
        raise ProblemError(409, error.message, name, error.remedy) from error


async def _while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of ``work``, which is cancelled, and waited for, when the client goes."""
    working = asyncio.create_task(work, name=f"api {request.url.path}")
    connected = asyncio.create_task(_disconnected(request), name=f"api {request.url.path} client")
    try:
        await asyncio.wait((working, connected), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ProblemError(409, "the client went away", request.url.path)
        return working.result()
    finally:
        for task in (working, connected):
            task.cancel()
        await asyncio.gather(working, connected, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


class ConnectionNames:
    """The names that leases go by: what a client called itself first on its connection, the name of its token, and the
    number of that connection; the two are the daemon's to give and nobody else's."""

    def __init__(self) -> None:
        self._names: OrderedDict[int, str] = OrderedDict()

    def of(self, given: str, connection: HTTPConnection) -> str:
        """The name of whoever speaks on this connection."""
        number = connection.client.port if connection.client is not None else 0
        if number not in self._names:
            grant = grant_of(connection)
            at = f"@{grant.name}" if grant is not None and not is_local(connection) else ""
            self._names[number] = f"{printable(given) or 'client'}{at}#{number}"
            if len(self._names) > NAMES_N:
                self._names.popitem(last=False)
        return self._names[number]


def grant_of(connection: HTTPConnection) -> Grant | None:
    """Who asks, and with what right; None: anybody, for the page's own files."""
    grant: Grant | None = getattr(connection.state, "grant", None)
    return grant


def is_local(connection: HTTPConnection) -> bool:
    """Whether it came by the unix socket."""
    return connection.client is not None and connection.client.host == "unix"


def asker_of(connection: HTTPConnection) -> str:
    """Who asks, for the log: the name of the token or the user, and where from."""
    grant = grant_of(connection)
    return f"{grant.name if grant else 'nobody'} at {connection.client.host if connection.client else '-'}"


async def obey(port: DaemonPort, command: Command, limits: ApiLimits, by: str, heard_s: float) -> Reply:
    """Hand a command over and wait for its reply, not for ever. What was asked, ``by`` whom, and what came of it goes
    into the log; keeping a lease does not. ``heard_s``: when it came, by the event loop's clock.

    Raises:
        ProblemError: 504, the control tick did not answer.
    """
    if isinstance(command, Stop):
        reply = port.stop(command)
    else:
        reply = await _answered(port, command, limits, heard_s)
    if not isinstance(command, Renew | Release):
        what = f"refused: {reply.message}" if not reply.accepted else reply.message
        log.info("%s by %s (%s): %s", _words(command), command.client, by, what, extra={"client": command.client})
    return reply


def _words(command: Command) -> str:
    given = command.model_dump(exclude={"command", "client"}, exclude_defaults=True)
    return " ".join((command.command, *(f"{name}={value}" for name, value in given.items())))


async def _answered(port: DaemonPort, command: Command, limits: ApiLimits, heard_s: float) -> Reply:
    waited_s = asyncio.get_running_loop().time() - heard_s
    try:
        async with asyncio.timeout(limits.command_timeout_s):
            return await port.command(command, waited_s)
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
