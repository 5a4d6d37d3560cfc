"""What a finished capture was made from, in a few letters: whether a batch has to look at it again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from stages import registry
from stages.capture.readers.facescape_scale import NAME as SCALE
from workflows.run.published import LIST
from workflows.run.request import RunRequest
from workflows.server.access import named_paths

Stats = list[tuple[str, int, int]]  # path, size, time of the last change
NOT_READ = ("capture", "root", "out", "store")  # the capture is walked, the others are results


def fingerprint(request: RunRequest) -> str:
    """Of a request, the stages' versions, and names, sizes and times of the files that a run would read.

    It only decides whether a finished capture is looked at again; what is reused then, the store decides by content.
    """
    asked = request.model_dump(mode="json", exclude={"stage_limit", "fit_slots", "store", "device", "strict"})
    named = {Path(text).absolute() for name, text in named_paths(asked) if name not in NOT_READ}
    versions = [(s.name, s.version) for s in registry.REGISTRY]
    parts = [asked, versions, _of_capture(request), [_stats(p, _below(p, ())) for p in sorted(named)]]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]


def _of_capture(request: RunRequest) -> Stats:
    """Of a video, or of every file below the folder: photos also lie in images/, clean_plate/ or olat/. With the file
    of FaceScape's scales, which lies up to two folders above."""
    capture = Path(request.capture).absolute()
    results = (Path(request.out).absolute(), request.store_path.absolute())
    beside = [folder / SCALE for folder in capture.parents[:2]]
    return _stats(capture, (*_below(capture, results), *beside))


def _below(top: Path, results: Iterable[Path]) -> Iterator[Path]:
    """The file itself, or the files below a folder. Hidden ones are no part of a capture, nor are results inside it:
    they would change with every run. Links to folders are followed, as the readers do, each folder once."""
    if not top.is_dir():
        yield top
        return
    seen = {os.path.realpath(p) for p in results}
    for folder, below, names in os.walk(top, followlinks=True):
        place = os.path.realpath(folder)
        if place in seen or (Path(folder) != top and LIST in names):
            below.clear()
            continue
        seen.add(place)
        below[:] = sorted(b for b in below if not b.startswith("."))
        yield from (Path(folder, n) for n in names if not n.startswith("."))


def _stats(top: Path, files: Iterable[Path]) -> Stats:
    found = ((os.path.relpath(p, top.parent), p.stat()) for p in files if p.is_file())
    return sorted((name, s.st_size, s.st_mtime_ns) for name, s in found)
