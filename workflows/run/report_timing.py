"""The report's files with the seconds of a run: the store's are the same on every machine, times are not."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

TIMED = ("index.html", "metrics.json")  # of the report: they get the seconds of the run


def report_hash(folder: Path, path: str, timing: Mapping[str, float]) -> str:
    """sha256 of a report's file as a run with these seconds published it."""
    content = (folder / path).read_bytes()
    return hashlib.sha256(with_seconds(path, content, timing) if path in TIMED else content).hexdigest()


def with_seconds(path: str, content: bytes, timing: Mapping[str, float]) -> bytes:
    """A file of the report as a run with these seconds shows it."""
    if path == "metrics.json":
        return json.dumps({**json.loads(content), "timing": dict(timing)}, indent=1).encode()
    from stages.report.page import with_timing

    return with_timing(content.decode(), timing).encode()
