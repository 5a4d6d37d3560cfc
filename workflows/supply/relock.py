"""The last step of `make lock`: takes torch out of the locks that pip-compile made, into a lock of its own.

A package source may have a build of torch of its own, for the same version: one for CPUs, one for each CUDA. A lock
with the hash of one build refuses all others, and CUDA builds need packages that CPU builds do not. So torch's lock has
the hashes of the builds that this machine's source and PyPI have for Linux, and of those that were in it before with
the same version; what else a build needs is installed without hashes.

python -m workflows.supply.relock FOLDER
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from workflows.supply.lock import LOCKS, read_lock

MADE = ("requirements.lock", "requirements-dev.lock")  # by pip-compile
ENTRY = re.compile(r"^torch==(?P<version>[\w.]+)(\+\w+)?.*\n(?:[ \t]+.*\n)*", re.MULTILINE)
HEAD = "# Exact versions and hashes of what pyproject needs, without torch (requirements-torch.lock). By `make lock`.\n"
TORCH_HEAD = (
    "# torch: hashes of builds for Linux, PyPI's and the CPU build for x86-64, Python 3.11. By `make lock`.\n"
    "# Of another build: make setup TORCH_CHECK=\n"
)
BUILDS = [  # Python and platform of PyPI's builds
    (python, f"manylinux_2_28_{machine}") for python in ("3.11", "3.12") for machine in ("x86_64", "aarch64")
]


def without_torch(text: str) -> tuple[str, str]:
    """The text of a lock without torch and without older head lines, and torch's version ("" if it was not there)."""
    found = ENTRY.search(text)
    rest = ENTRY.sub("", text) if found else text
    return "".join(line for line in rest.splitlines(True) if not line.startswith("#")), found[
        "version"
    ] if found else ""


def torch_lock(version: str, hashes: Iterable[str]) -> str:
    """The text of torch's lock."""
    lines = [f"torch=={version}", *(f"    --hash=sha256:{h}" for h in sorted(set(hashes)))]
    return TORCH_HEAD + " \\\n".join(lines) + "\n"


def hash_of(version: str, options: Iterable[str], environment: dict[str, str]) -> str | None:
    """SHA-256 of the file that pip would install; None if the source has none or does not tell."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps", "--ignore-installed",
               "--report", "-", *options, f"torch=={version}"]  # fmt: skip
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True)
    if done.returncode != 0:
        return None
    info = json.loads(done.stdout)["install"][0]["download_info"]
    found: str | None = info.get("archive_info", {}).get("hashes", {}).get("sha256")
    return found


def known_hashes(version: str, folder: Path) -> list[str]:
    """Of this machine's source, of PyPI, and of the lock that there was."""
    before = folder / LOCKS[1]
    kept = [h for p in (read_lock(before) if before.is_file() else ()) if p.version == version for h in p.hashes]
    pypi = {"PIP_CONFIG_FILE": os.devnull, "PIP_FIND_LINKS": "", "PIP_EXTRA_INDEX_URL": ""}
    asked = [hash_of(version, (), {})]
    for python, platform in BUILDS:
        target = ("--python-version", python, "--platform", platform, "--only-binary", ":all:", "--target", "unused")
        asked.append(hash_of(version, target, pypi))
    return [*kept, *(h for h in asked if h is not None)]


def main(folder: Path) -> int:
    """Change the locks of `folder`."""
    versions = set()
    for name in MADE:
        text, version = without_torch((folder / name).read_text())
        (folder / name).write_text(HEAD + text)
        versions.add(version)
    if len(versions) != 1 or "" in versions:
        print(f"the locks have no torch in common: {sorted(versions)}", file=sys.stderr)
        return 1
    version = versions.pop()
    hashes = known_hashes(version, folder)
    (folder / LOCKS[1]).write_text(torch_lock(version, hashes))
    print(f"torch {version}: {len(set(hashes))} builds")
    return 0 if hashes else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
