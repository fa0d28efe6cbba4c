"""What a client gets when something did not work: the same three fields everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket


class Problem(BaseModel):
    """Why a request was not served, where the reason lies, and what to do about it."""

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "error": "moving by hand needs manual mode; the machine is disarmed",
                    "where": "jog",
                    "remedy": "arm first",
                }
            ]
        },
    )

    error: str = Field(description="why, in plain words")
    where: str = Field("", description="the command, service, header or body field the reason lies in")
    remedy: str = Field("", description="what to do about it")


class ProblemError(Exception):
    """A request ends with this problem and HTTP status."""

    def __init__(self, status_code: int, error: str, where: str = "", remedy: str = "") -> None:
        super().__init__(error)
        self.status_code = status_code
        self.problem = Problem(error=error, where=where, remedy=remedy)


def problem_of_validation(errors: Sequence[Any]) -> Problem:
    """One problem out of pydantic's list of errors; the first is told in full, the others are counted.

    The offending input is never echoed: it may be huge, or not representable in JSON.
    """
    first = errors[0]
    path = ".".join(str(part) for part in first["loc"] if part != "body") or "body"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return Problem(
        error=f"{first['msg']}{more}",
        where=path[:200],
        remedy="the request's form is described at /v1/openapi.json",
    )


async def answer(
    status_code: int,
    problem: Problem,
    scope: Scope,
    receive: Receive,
    send: Send,
    headers: dict[str, str] | None = None,
) -> None:
    """Answer an HTTP request or a WebSocket handshake with a problem."""
    response = JSONResponse(problem.model_dump(), status_code, headers)
    if scope["type"] == "websocket":
        await WebSocket(scope, receive, send).send_denial_response(response)
    else:
        await response(scope, receive, send)
