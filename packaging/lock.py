"""The part of ``requirements.lock`` that one target needs: a pip requirements file with hashes for every package."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from email.parser import Parser
from pathlib import Path

from packaging.markers import Marker, default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_PIN = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)==(?P<version>\S+)(?:\s*;\s*(?P<marker>[^\\]+?))?\s*\\?$")


@dataclass(frozen=True, slots=True)
class Pin:
    """One ``name==version`` of the lock file with its marker and its hashes."""

    name: str
    version: str
    marker: Marker | None
    hashes: tuple[str, ...]

    def line(self) -> str:
        """As pip reads it, without the marker: the choice is made here."""
        return f"{self.name}=={self.version} " + " ".join(f"--hash={value}" for value in self.hashes)


@dataclass(frozen=True, slots=True)
class Target:
    """A Python version on a machine: what decides which wheels fit."""

    python: str
    machine: str = "x86_64"
    environment: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        environment = {name: str(value) for name, value in default_environment().items()}
        environment.update(
            {
                "python_version": self.python,
                "python_full_version": f"{self.python}.0",
                "implementation_version": f"{self.python}.0",
                "platform_machine": self.machine,
                "platform_system": "Linux",
                "sys_platform": "linux",
                "os_name": "posix",
            }
        )
        object.__setattr__(self, "environment", environment)

    def applies(self, marker: Marker | None, extra: str = "") -> bool:
        """Whether a marker holds on this target."""
        return marker is None or marker.evaluate({**self.environment, "extra": extra})

    def pip_options(self) -> list[str]:
        """Options that make pip choose wheels for this target instead of for the machine it runs on."""
        platforms = [f"manylinux_2_{minor}_{self.machine}" for minor in range(36, 16, -1)]
        platforms += [f"manylinux2014_{self.machine}", f"linux_{self.machine}"]
        abi = f"cp{self.python.replace('.', '')}"
        options = ["--only-binary=:all:", "--implementation=cp", f"--python-version={self.python}"]
        options += [f"--abi={value}" for value in (abi, "abi3", "none")]
        return options + [f"--platform={platform}" for platform in platforms]


def read_lock(path: Path) -> list[Pin]:
    """All pins of a lock file written by ``make lock``.

    Raises:
        ValueError: a line that is neither a pin, nor a hash, nor a comment.
    """
    pins: list[Pin] = []
    hashes: list[str] = []
    head: re.Match[str] | None = None

    def finish() -> None:
        if head is not None:
            marker = Marker(head["marker"]) if head["marker"] else None
            pins.append(Pin(canonicalize_name(head["name"]), head["version"], marker, tuple(hashes)))

    for number, raw in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        if line.startswith("--hash="):
            hashes.append(line.removeprefix("--hash=").rstrip("\\ "))
        elif found := _PIN.match(line):
            finish()
            head, hashes = found, []
        else:
            raise ValueError(f"{path}:{number}: neither a pin nor a hash: {line}")
    finish()
    return pins


def roots(pyproject: Path, extras: tuple[str, ...]) -> list[Requirement]:
    """What the project itself asks for, with the given extras."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    texts = list(project["dependencies"])
    for extra in extras:
        texts += project["optional-dependencies"][extra]
    return [Requirement(text) for text in texts]


def select(pins: list[Pin], wanted: list[Requirement], site: list[Path], target: Target) -> list[Pin]:
    """The pins that ``wanted`` needs on ``target``, all the way down.

    The dependencies of each package are read from its installed metadata in the directories ``site`` (any version: the
    virtual environment of the project has every package of the lock file that fits this machine).

    Raises:
        LookupError: a needed package is not in the lock file.
    """
    requires = _installed_requirements(site)
    chosen: dict[str, Pin] = {}
    queue = [(requirement, "") for requirement in wanted]
    seen: set[tuple[str, str]] = set()
    while queue:
        requirement, parent_extra = queue.pop()
        if not target.applies(requirement.marker, parent_extra):
            continue
        name = canonicalize_name(requirement.name)
        pin = next((p for p in pins if p.name == name and target.applies(p.marker)), None)
        if pin is None:
            raise LookupError(f"{name} is needed and not in the lock file for {target.python} {target.machine}")
        chosen[name] = pin
        for extra in sorted(requirement.extras) or [""]:
            if (name, extra) not in seen:
                seen.add((name, extra))
                queue += [(Requirement(text), extra) for text in requires.get(name, [])]
    return sorted(chosen.values(), key=lambda pin: pin.name)


def _installed_requirements(site: list[Path]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for directory in site:
        for metadata in directory.glob("*.dist-info/METADATA"):
            message = Parser().parsestr(metadata.read_text(encoding="utf-8"), headersonly=True)
            found[canonicalize_name(str(message["Name"]))] = message.get_all("Requires-Dist") or []
    return found
