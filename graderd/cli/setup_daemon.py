"""The daemon that ``graderd setup`` runs for itself: of this configuration, on a socket of its own, ended with it."""

from __future__ import annotations

import ctypes
import os
import pwd
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final, Self

from graderd.cli.console import CliError
from graderd.client import Client, ClientError, NoDaemonError

START_S: Final = 90.0
"""A busy computer starts Python slowly; one that ends is told at once."""
END_S: Final = 10.0
POLL_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
SERVICE_USER: Final = "graderd"


class SetupDaemon:
    """``graderd run`` with ``config``, started anew after each change of it. Root starts it as the service's user, so
    that rights that the service lacks are found now.

    It ends with the program that started it, whatever ended that: the blade then holds.
    """

    def __init__(self, config: Path) -> None:
        self._config = config
        self._room = Path(tempfile.mkdtemp(prefix="graderd-setup-"))
        self._process: subprocess.Popen[bytes] | None = None
        self.socket = self._room / "graderd.sock"
        self.log = self._room / "daemon.log"
        self.client = Client(self.socket, name="setup", timeout_s=20.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        shutil.rmtree(self._room, ignore_errors=True)

    def restart(self) -> Client:
        """Run with the configuration as it is now; returns once it answers.

        Raises:
            CliError: it does not.
        """
        self.end()
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "graderd", "--socket", str(self.socket), "run", "--config", self._config],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={
                    name: value
                    for name, value in os.environ.items()
                    if name not in ("NOTIFY_SOCKET", "STATE_DIRECTORY")
                },
                start_new_session=True,  # Ctrl-C is ours, and ends it in order
                preexec_fn=_end_with_parent,
                **_service_user(self._room),
            )
        give_up_s = time.monotonic() + START_S
        while True:
            try:
                self.client.get("/v1/status")
                return self.client
            except NoDaemonError:
                if self._process.poll() is not None or time.monotonic() > give_up_s:
                    raise self._why_not() from None
            time.sleep(POLL_S)

    def kill(self) -> None:
        """End it as a crash does: nothing is said to any device."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End it in order, if it runs."""
        process, self._process = self._process, None
        if process is None or process.poll() is not None:
            return
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _why_not(self) -> CliError:
        said = self.log.read_text("utf-8", "replace").strip().splitlines()
        last = said[-1] if said else "it said nothing"
        return CliError("setup", f"the daemon does not run with {self._config}: {last}", "See graderd config check")


def _end_with_parent() -> None:
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _service_user(room: Path) -> dict[str, Any]:
    """For root: to be the service's user and groups, where the package has made them."""
    if os.geteuid() != 0:
        return {}
    try:
        user = pwd.getpwnam(SERVICE_USER)
    except KeyError:
        return {}
    os.chown(room, user.pw_uid, user.pw_gid)
    return {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": os.getgrouplist(SERVICE_USER, user.pw_gid)}


def is_running(client: Client) -> bool:
    """Whether another daemon answers, and so has the wires."""
    try:
        client.get("/v1/status")
    except ClientError:
        return False
    return True
