"""A rig, a daemon and a headless browser on its operator page: once for all tests here (`make web-test`)."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from graderd.client import Client
from graderd.simulator.control_client import RigControl
from graderd.tokens import Right, create_token
from tests.rig_process import running_rig

WAIT_S = 30.0
expect.set_options(timeout=WAIT_S * 1000)
SHOTS = Path(__file__).parents[2] / "var" / "web"
CONFIG = """
[api]
socket = "{directory}/graderd.sock"

[api.tcp]
port_n = {port_n}
token_file = "{directory}/tokens"
allowed_hosts = ["127.0.0.1:{proxy_n}"]

[camera]
rate_hz = 15.0

[rule]
pass_m = 0.5
pass_s = 2.0
dwell_s = 0.5
"""


@dataclass
class Wire:
    """A TCP proxy before the daemon: it can keep what one kind of connection says to itself, or drop all."""

    target_n: int
    listener: socket.socket
    held: set[str] = field(default_factory=set)
    open: list[tuple[str, socket.socket]] = field(default_factory=list)

    def run(self) -> None:
        while True:
            try:
                near, _ = self.listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(near,), daemon=True).start()

    def _serve(self, near: socket.socket) -> None:
        try:
            first = near.recv(65_536)
            path = first.split(b" ", 2)[1].decode() if first.count(b" ") > 1 else ""
            far = socket.create_connection(("127.0.0.1", self.target_n))
            self.open += [(path, near), (path, far)]
            self._wait(path)
            far.sendall(first)
            threading.Thread(target=self._pipe, args=(path, far, near), daemon=True).start()
            self._pipe(path, near, far)
        except OSError:
            near.close()

    def _pipe(self, path: str, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65_536):
                self._wait(path)
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            end.close()

    def _wait(self, path: str) -> None:
        while any(path.startswith(part) for part in self.held):
            time.sleep(0.01)

    def drop(self, path: str = "") -> None:
        """End every connection whose first request began with ``path``."""
        for opened, end in self.open:
            if opened.startswith(path):
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        self.open = [entry for entry in self.open if not entry[0].startswith(path)]


@dataclass
class Cab:
    """The whole machine, its page's address, and what a test asks of both."""

    directory: Path
    url: str
    wire: Wire
    tokens: dict[Right, str]
    client: Client
    browser: Browser

    def rig(self, command: str, **fields: Any) -> dict[str, Any]:
        """Ask something of the simulated grader."""

        async def ask() -> dict[str, Any]:
            async with RigControl(self.directory / "control.sock") as rig:
                return await rig.request(command, **fields)

        answer: dict[str, Any] = in_thread(lambda: asyncio.run(ask()))
        return answer

    def status(self) -> dict[str, Any]:
        status: dict[str, Any] = self.client.get("/v1/status")
        return status

    def until(self, reached: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        """The first status that is as wanted."""
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            status = self.status()
            if reached(status):
                return status
            time.sleep(0.02)
        raise AssertionError(f"not reached: {what}: {json.dumps(self.status())[:2000]}")

    def measured(self, axis: str = "rotation") -> float:
        return float(self.until(lambda s: s["axes"][axis]["measured"] is not None, axis)["axes"][axis]["measured"])

    def calm(self) -> None:
        """Disarmed, at rest, no faults of the rig's."""
        self.wire.held.clear()
        self.rig("clear_faults")
        self.until(lambda s: not any(f["reaction"] in ("stop", "disarm") and f["present"] for f in s["faults"]), "calm")
        status = self.status()
        if status["mode"] == "stopped":
            self.client.command("reset", stop_n=status["stop_n"])
        elif status["mode"] != "disarmed":
            self.client.command("disarm")
        self.until(lambda s: s["mode"] == "disarmed", "disarmed")

    def manual(self) -> None:
        """Armed."""
        ready = lambda s: all(r["met"] for r in s["readiness"] if r["mandatory"])  # noqa: E731
        self.until(ready, "ready")
        end_s = time.monotonic() + WAIT_S
        while True:
            try:
                self.client.command("arm")
                break
            except Exception:
                assert time.monotonic() < end_s
                time.sleep(0.1)
        self.until(lambda s: s["mode"] == "manual", "armed")

    def page(self, right: Right | None = Right.COMMAND, **context: Any) -> Page:
        """A page of its own browser session, logged in and live."""
        made = self.browser.new_context(**{"viewport": {"width": 1280, "height": 800}, "has_touch": True, **context})
        page = made.new_page()
        page.set_default_timeout(WAIT_S * 1000)
        page.problems = []
        page.on("pageerror", lambda error: page.problems.append(str(error)))
        page.on("console", lambda said: page.problems.append(said.text) if "Content Security" in said.text else None)
        page.goto(self.url + (f"/#{self.tokens[right]}" if right else "/"))
        if right is not None:
            page.wait_for_selector("body:not([data-stale])")
            page.wait_for_selector("#work:not([hidden])")
        return page


def in_thread(call: Callable[[], Any]) -> Any:
    """Playwright's loop runs in this one."""
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(call()))
    thread.start()
    thread.join()
    return found[0]


def free_ports(count: int) -> list[int]:
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return ports


@pytest.fixture(scope="session")
def cab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cab]:
    directory = tmp_path_factory.mktemp("cab")
    if os.geteuid() == 0:
        os.nice(-15)  # the service has such a place too: what is not heard in time ends a motion, and should
    SHOTS.mkdir(parents=True, exist_ok=True)
    listener = socket.create_server(("127.0.0.1", 0))
    proxy_n = listener.getsockname()[1]
    (port_n,) = free_ports(1)
    wire = Wire(port_n, listener)
    threading.Thread(target=wire.run, daemon=True).start()
    config = directory / "graderd.toml"
    config.write_text(CONFIG.format(directory=directory, port_n=port_n, proxy_n=proxy_n), encoding="utf-8")
    tokens = {right: create_token(directory / "tokens", right, right) for right in Right}
    command = [sys.executable, "-m", "graderd", "run", "--config", str(config), "--rig-dir", str(directory)]
    log = (directory / "daemon.log").open("wb")
    chromium = os.environ.get("GRADERD_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    assert chromium, "no Chromium: see 'make web-test'"
    with running_rig(directory, "--seed", "3"), log, sync_playwright() as playwright:
        daemon = subprocess.Popen(command, stderr=log)
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        client = Client(directory / "graderd.sock", name="test", timeout_s=10.0)
        made = Cab(directory, f"http://127.0.0.1:{proxy_n}", wire, tokens, client, browser)
        try:
            client.until(lambda status: status.soil.frames_per_s > 0, 60, "pictures")
            yield made
        finally:
            browser.close()
            listener.close()
            daemon.terminate()
            daemon.wait(20)


@pytest.fixture(autouse=True)
def calm(cab: Cab) -> Iterator[None]:
    """Every test begins and ends with a machine at rest, and leaves no page open."""
    cab.calm()
    yield
    for context in cab.browser.contexts:
        for page in context.pages:
            assert page.problems == []
        context.close()
    cab.calm()


def shot(page: Page, name: str) -> None:
    """A picture of the page in var/web, for people to look at."""
    assert re.fullmatch(r"[a-z0-9-]+", name)
    page.screenshot(path=SHOTS / f"{name}.png")
