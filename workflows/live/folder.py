"""OUT/live: small files of the run at work, for whoever looks at it. Removed when the run has published its results.

A file gets its name when it is whole. `.published.json` in the folder lists our files with their hashes, as in OUT; a
file of the user's is never replaced or removed, and where one has a name that is needed it is renamed. Nothing is
flushed to the disk: after a power failure nobody needs these files.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.store import read_object
from workflows.run.published import LIST, is_ours, listed
from workflows.run.replace import free_side

FOLDER = "live"
STATE = "state.json"
ASK = "ask.json"
PICTURES = ("cameras.svg", "masks.jpg", "fit.jpg", "mesh.jpg", "maps.jpg", "asset.jpg")
FORMAT = 1  # of state.json
MAX_BYTES = 1 << 20  # of state.json and of a wish, for whoever reads them


class LiveFolder:
    """The folder of the run that holds the lock of `out`. notify: told of a file of the user's that had to move.

    Raises:
        OSError: it can't be written, or what has its name is no folder of ours.
    """

    def __init__(self, out: Path, notify: Callable[[str], None] = lambda text: None) -> None:
        self.folder, self.notify = out / FOLDER, notify
        if self.folder.is_symlink() or (self.folder.exists() and not self.folder.is_dir()):
            raise NotADirectoryError(f"{self.folder} is no folder")
        self.folder.mkdir(exist_ok=True)
        self._known: dict[str, tuple[str, ...]] = {}
        remove_ours(self.folder)
        for name in (STATE, ASK, *PICTURES):
            self._make_way(name)

    def write(self, name: str, data: bytes) -> None:
        """Replace FOLDER/NAME as a whole."""
        digest = hashlib.sha256(data).hexdigest()
        if name != STATE:  # that one says itself what it is, and is written every second
            self._known[name] = (*self._known.get(name, ())[-1:], digest)
            files = {n: sorted(set(hashes)) for n, hashes in self._known.items()}
            put_whole(self.folder / LIST, json.dumps({"files": files}).encode())
        put_whole(self.folder / name, data)

    def state(self, content: dict[str, Any]) -> None:
        """Write state.json."""
        self.write(STATE, json.dumps({"format": FORMAT, "what": "neuface live", **content}).encode())

    def remove(self) -> None:
        """Remove what is ours, and the folder if nothing else lies in it."""
        remove_ours(self.folder)
        with suppress(OSError):
            self.folder.rmdir()

    def _make_way(self, name: str) -> None:
        path = self.folder / name
        if os.path.lexists(path):
            aside = free_side(self.folder, name)
            path.rename(self.folder / aside)
            self.notify(f"{path} is yours: kept as {self.folder / aside}")


def remove_ours(folder: Path) -> None:
    """Remove our files of a folder that a run left."""
    for path in ours_in(folder):
        path.unlink(missing_ok=True)


def ours_in(folder: Path) -> list[Path]:
    """Our files of a folder that a run left: as we wrote them, no links."""
    if not folder.is_dir() or folder.is_symlink():
        return []
    known = listed(folder)
    found = [folder / n for n in PICTURES if is_ours(folder / n, known.get(n, ()))]
    for name, ours in ((STATE, is_state), (ASK, is_wish)):
        found += [folder / name] if ours(read_small(folder / name)) else []
    found += [folder / LIST, *folder.glob(".*.new-????????")]
    return [p for p in found if p.is_file() and not p.is_symlink()]


def is_state(content: dict[str, Any]) -> bool:
    """Whether this is a state.json of ours."""
    return content.get("what") == "neuface live"


def is_wish(content: dict[str, Any]) -> bool:
    """Whether this is an ask.json of ours."""
    return content.keys() == {"run", "number", "wish"}


def read_small(path: Path) -> dict[str, Any]:
    """The JSON object in a small file; empty where there is none."""
    try:
        return read_object(path) if path.stat().st_size <= MAX_BYTES else {}
    except OSError:
        return {}


def put_whole(path: Path, data: bytes) -> None:
    """Write a file that is never seen half-written."""
    made = path.with_name(f".{path.name}.new-{secrets.token_hex(4)}")
    try:
        made.write_bytes(data)
        made.replace(path)
    finally:
        made.unlink(missing_ok=True)
