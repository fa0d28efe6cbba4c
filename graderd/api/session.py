"""A browser's session: its token as a cookie that no script can read, typed or opened from a link once."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field

from graderd.api.http_routes import grant_of, is_local
from graderd.api.problem import Problem, ProblemError
from graderd.api.tcp_guard import TOKEN_COOKIE
from graderd.tokens import Right

YEAR_S = 365 * 86_400
_NONE: dict[int | str, dict[str, Any]] = {
    409: {"model": Problem, "description": "the unix socket's rights are its file's: there is no session"}
}


class Session(BaseModel):
    """Whose token it is, and what it is good for."""

    name: str = Field(description="the token's name")
    right: Right


def session_routes() -> APIRouter:
    """Over TCP; the guard has judged the token before."""
    router = APIRouter(prefix="/v1", tags=["session"])

    @router.get("/session", summary="Who asks, and with what right")
    async def who(request: Request) -> Session:
        return _session_of(request)

    @router.post("/session", summary="Keep the token of this request as a cookie", responses=_NONE)
    async def begin(request: Request, response: Response) -> Session:
        """Send the token as `Authorization: Bearer TOKEN`. The cookie goes to this machine's own pages alone
        (`SameSite=Strict`), and no script can read it (`HttpOnly`)."""
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if is_local(request) or scheme.lower() != "bearer":
            raise ProblemError(409, "there is no token to keep", "session", "send 'Authorization: Bearer TOKEN' by TCP")
        response.set_cookie(
            TOKEN_COOKIE.decode(),
            token.strip(),
            max_age=YEAR_S,
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return _session_of(request)

    @router.delete("/session", summary="Forget the cookie", status_code=204)
    async def end(response: Response) -> None:
        response.delete_cookie(TOKEN_COOKIE.decode(), httponly=True, samesite="strict")

    return router


def _session_of(request: Request) -> Session:
    grant = grant_of(request)
    assert grant is not None, "the guard lets nobody else in"
    return Session(name=grant.name, right=grant.right)
