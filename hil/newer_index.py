"""A package index that offers, beside what the real one has, version 9999 of everything that is locked.

What today's newest version is must not matter to anything that is built or installed from a lock; this is the day on
which each of them has a newer one.
"""

from __future__ import annotations

import re
import urllib.error
import urllib.request
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from threading import Thread
from types import TracebackType
from typing import Final, Self

UPSTREAM: Final = "https://pypi.org/simple"
NEWER: Final = "9999"
_PINNED: Final = re.compile(r"^([A-Za-z0-9._-]+)==", re.MULTILINE)


def newer_wheel(name: str) -> bytes:
    """An empty wheel of that project, version 9999."""
    project = name.replace("-", "_")
    info = f"{project}-{NEWER}.dist-info"
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {NEWER}\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return content.getvalue()


class NewerIndex:
    """The index, served on this machine while the context is open; ``lock`` is the text of a requirements file."""

    def __init__(self, lock: str) -> None:
        self.names = {re.sub(r"[-_.]+", "-", name).lower() for name in _PINNED.findall(lock)}
        self.offered_n = 0
        """To how many questions for a project a newer version was in the answer."""
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._thread = Thread(target=self._server.serve_forever, name="newer index")

    @property
    def url(self) -> str:
        """What pip calls --index-url."""
        return f"http://127.0.0.1:{self._server.server_port}/simple/"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def page(self, name: str) -> bytes:
        """The real index's list of files for a project, and one more.

        Raises:
            urllib.error.URLError: the real index does not answer.
        """
        request = urllib.request.Request(f"{UPSTREAM}/{name}/", headers={"Accept": "text/html"})
        with urllib.request.urlopen(request, timeout=60) as answer:
            page: bytes = answer.read()
        if name not in self.names:
            return page
        self.offered_n += 1
        wheel = f"{name.replace('-', '_')}-{NEWER}-py3-none-any.whl"
        address = f"http://127.0.0.1:{self._server.server_port}/files/{name}/{wheel}"
        return page.replace(b"</body>", f'<a href="{address}">{wheel}</a><br/>\n</body>'.encode(), 1)

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        index = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                kind, name = (*self.path.strip("/").split("/"), "", "")[:2]
                try:
                    content = newer_wheel(name) if kind == "files" else index.page(name)
                except urllib.error.URLError as error:
                    self.send_error(502, str(error))
                    return
                self.send_response(200)
                self.send_header("Content-Type", "application/octet-stream" if kind == "files" else "text/html")
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        return Handler
