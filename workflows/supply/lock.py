"""The lock files: exact versions and the hashes of their files; how an installation differs from them.

requirements.lock has everything but torch, whose builds differ between package sources: requirements-torch.lock has its
version, and the hashes of the builds that are known.
"""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("requirements.lock", "requirements-torch.lock")
PIN = re.compile(r"(?P<name>[A-Za-z0-9][\w.-]*)==(?P<version>[\w.!+-]+)")
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


@dataclass(frozen=True, slots=True)
class Pinned:
    """One distribution: its name in the normal form of the index, its version, the SHA-256 of its files."""

    name: str
    version: str
    hashes: tuple[str, ...]


def normal(name: str) -> str:
    """Lower case, with single hyphens: the form in which names are compared."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_lock(path: Path) -> list[Pinned]:
    """The distributions of one lock file.

    Raises:
        UsageError: the file is not there, or a line is neither a pin, a hash nor a comment.
    """
    try:
        text = path.read_text()
    except OSError as e:
        raise _unusable(path, e) from e
    found: list[Pinned] = []
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
        said = line.partition(" #")[0].strip()
        if not said or said.startswith("#"):
            continue
        pin = PIN.match(said)
        if pin is None or HASH.sub("", said[pin.end() :]).strip():
            raise _unusable(path, f"entry {number}: {said[:60]!r}")
        found.append(Pinned(normal(pin["name"]), pin["version"], tuple(HASH.findall(said))))
    return found


def locked(root: Path = ROOT) -> list[Pinned]:
    """All that the program needs, by name."""
    return sorted((p for name in LOCKS for p in read_lock(root / name)), key=lambda p: p.name)


def installed() -> dict[str, str]:
    """Version of every distribution of this environment, by normal name."""
    return {normal(d.name): d.version for d in importlib.metadata.distributions() if d.name}


def differences(pins: Iterable[Pinned], here: Mapping[str, str]) -> list[str]:
    """What of `here` is not as the lock has it; a local label of a version ("+cpu") names the build and not the
    version. Distributions that are not in the lock do not matter."""
    out = []
    for pin in pins:
        version = here.get(pin.name)
        if version is None:
            out.append(f"{pin.name} {pin.version} is missing")
        elif version.partition("+")[0] != pin.version.partition("+")[0]:
            out.append(f"{pin.name} {version} in place of {pin.version}")
    return out


def _unusable(path: Path, why: object) -> UsageError:
    return UsageError(
        "a lock file can't be read",
        where=path,
        value=why,
        limit="lines NAME==VERSION with --hash=sha256:...",
        remedy="get it from the repository again, or make it with: make lock",
    )
