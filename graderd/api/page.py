"""The operator page: files of ``web/``, read once and served as they are; there is nothing in them to hide."""

from __future__ import annotations

import base64
import hashlib
import re
from importlib.resources import files

from fastapi import APIRouter, Response

KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json"}
INLINE = re.compile(r"<(script|style)>(.*?)</\1>", re.DOTALL)


def page_routes() -> APIRouter:
    """``/`` and what it loads from ``/page/``."""
    router = APIRouter(include_in_schema=False)
    found = {
        path.name: path.read_bytes() for path in files("graderd.web").iterdir() if path.name.endswith(tuple(KINDS))
    }
    index = found.pop("index.html")
    # Named, not "unsafe-inline": what stops before anything else has loaded is the one script in the page itself.
    hashes: dict[str, list[str]] = {"script": [], "style": []}
    for kind, text in INLINE.findall(index.decode()):
        hashes[kind].append(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'")
    headers = {
        "Content-Security-Policy": "; ".join(
            (
                "default-src 'none'; connect-src 'self'; img-src 'self' blob: data:; form-action 'self'",
                f"script-src 'self' {' '.join(hashes['script'])}",
                f"style-src 'self' {' '.join(hashes['style'])}",
                "base-uri 'none'; frame-ancestors 'none'",
            )
        ),
        "Referrer-Policy": "same-origin",  # "no-referrer" would make the form's Origin "null"
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }
    _serve(router, "/", index, KINDS[".html"], headers)
    for name, data in found.items():
        _serve(router, f"/page/{name}", data, KINDS[name[name.rindex(".") :]], headers)
    return router


def _serve(router: APIRouter, path: str, data: bytes, kind: str, headers: dict[str, str]) -> None:
    async def file() -> Response:
        return Response(data, media_type=kind, headers=headers)

    router.add_api_route(path, file, methods=["GET", "HEAD"])
