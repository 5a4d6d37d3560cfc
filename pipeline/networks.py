"""OpenCV's networks for code that runs in several threads.

A network holds the buffers of its last run, so each thread has its own. They are read one at a time: of 60 processes in
which eight threads read at once one died (OpenCV 5.0.0), and a run was ended by an importer that did not know its
operators yet ("Unsupported operator type RELU").
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

_local = threading.local()
_reading = threading.Lock()


def network(path: Path, read: Callable[[str], Any]) -> Any:
    """This thread's network of a file, read by `read` (cv2.dnn.readNet...) when it is asked for first."""
    nets: dict[Path, Any] = _local.__dict__.setdefault("nets", {})
    if path not in nets:
        with _reading:
            nets[path] = read(str(path))
    return nets[path]
