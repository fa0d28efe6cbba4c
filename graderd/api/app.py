"""The interface as a FastAPI application over a :class:`~graderd.api.port.DaemonPort`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.routing import Match

from graderd.api.http_routes import StatusTexts, http_routes
from graderd.api.limiter import Closing, Limiter
from graderd.api.metrics import metrics_routes
from graderd.api.page import page_routes
from graderd.api.port import DaemonPort
from graderd.api.problem import Problem, ProblemError, problem_of_validation
from graderd.api.session import session_routes
from graderd.api.settings import ApiLimits
from graderd.api.sockets import socket_routes
from graderd.api.stop import StopLane

DESCRIPTION = """\
The daemon's one interface, for the command line, the operator's page and any other client.

It is served on a unix socket, whose file rights decide who may use it, and on TCP only where the configuration asks
for it. Lengths are millimetres, angles degrees counter-clockwise seen from above, times seconds; the unit is part of
every field's name, or stands in the field `unit` beside it.

Anything that is refused is answered with the same three fields: `error` (why), `where` (which command, field or
header) and `remedy` (what to do).

Three paths are WebSockets: `/v1/stream`, `/v1/jog` and `/v1/bus/{name}`. Messages are JSON texts, those of
`/v1/bus/{name}` lines of a wire's traffic.
"""


EVERYWHERE = {
    "400": "no HTTP at all",
    "401": "TCP: no token, or not the right one",
    "403": "TCP: a foreign Host or Origin, or a token that may only read",
    "404": "there is no such path, or nothing there now",
    "405": "not this method",
    "408": "the body took too long",
    "413": "the body is too large",
    "422": "malformed; the machine is as it was",
    "431": "the head of the request is too long",
    "503": "too many requests; stop is served all the same",
}
"""What any request may be answered with, beside what its route says of itself."""
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
SECURITY = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "a token that 'graderd token create' made (TCP)"},
    "cookie": {"type": "apiKey", "in": "cookie", "name": "graderd_token", "description": "set by POST /v1/session"},
}


def make_app(port: DaemonPort, limits: ApiLimits | None = None) -> FastAPI:
    """The application. ``app.state.closing`` is its :class:`Closing`; whoever serves it tells it when to end.
    ``app.state.stops`` carries out stops, ``app.state.stop_socket`` those of the socket that serves nothing else."""
    limits = limits or ApiLimits()
    app = FastAPI(
        title="graderd",
        version=_version(),
        description=DESCRIPTION,
        openapi_url="/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        servers=[{"url": "http://localhost", "description": "over the unix socket"}],
    )
    app.state.closing = Closing()
    app.state.stops = StopLane(port, limits)
    app.state.stop_socket = StopLane(port, limits)
    texts = StatusTexts()
    app.include_router(http_routes(port, limits, texts, app.state.stops))
    app.include_router(socket_routes(port, limits, texts, app.state.closing, app.state.stops))
    app.include_router(session_routes())
    app.include_router(metrics_routes(port))
    app.include_router(page_routes())
    app.add_middleware(Limiter, limits=limits, closing=app.state.closing)
    for kind, handler in _handlers().items():
        app.add_exception_handler(kind, handler)
    described = app.openapi
    app.openapi = lambda: _completed(described())  # type: ignore[method-assign]
    return app


def _completed(description: dict[str, Any]) -> dict[str, Any]:
    """The description with what holds for every request: who may ask, and what anybody may be answered."""
    if "securitySchemes" in description["components"]:
        return description
    description["components"]["securitySchemes"] = SECURITY
    problem = {"application/json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for operations in description["paths"].values():
        for operation in operations.values():
            operation["security"] = [{name: []} for name in SECURITY]
            for status_code, text in EVERYWHERE.items():
                if status_code == "422":
                    # FastAPI describes a form of its own, which nobody is ever answered with.
                    operation["responses"].pop("422", None)
                operation["responses"].setdefault(status_code, {"description": text, "content": problem})
    for unused in ("HTTPValidationError", "ValidationError"):
        description["components"]["schemas"].pop(unused, None)
    return description


def _handlers() -> dict[type[Exception], Callable[[Request, Exception], Awaitable[JSONResponse]]]:
    """Every way a request can fail, brought to a problem."""

    async def refused(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, ProblemError)
        return JSONResponse(error.problem.model_dump(), error.status_code)

    async def malformed(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return JSONResponse(problem_of_validation(error.errors()).model_dump(), 422)

    async def http_error(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        # FastAPI answers a body that is no JSON with 400; for a client that is one more malformed request.
        status_code = 422 if error.status_code == 400 else error.status_code
        problem = Problem(
            error=str(error.detail), where=request.url.path[:200], remedy="the paths are listed at /v1/openapi.json"
        )
        headers = {"Allow": _allowed(request)} if status_code == 405 else error.headers
        return JSONResponse(problem.model_dump(), status_code, headers)

    async def crashed(request: Request, _: Exception) -> JSONResponse:
        problem = Problem(
            error="an internal error, written to the daemon's log",
            where=request.url.path[:200],
            remedy="report it with the log",
        )
        return JSONResponse(problem.model_dump(), 500)

    return {
        ProblemError: refused,
        RequestValidationError: malformed,
        HTTPException: http_error,
        Exception: crashed,
    }


def _allowed(request: Request) -> str:
    """The methods of a path: a router that has a route for each tells those of the first alone."""
    scopes = {method: {**request.scope, "method": method} for method in METHODS}
    routes = request.app.routes
    return ", ".join(m for m, scope in scopes.items() if any(r.matches(scope)[0] is Match.FULL for r in routes))


def _version() -> str:
    try:
        return version("graderd")
    except PackageNotFoundError:
        return "0"
