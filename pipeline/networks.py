"""OpenCV's networks in several threads.

A network contains the buffers of its last run, so each thread has its own. Only one is read at a time: in one of 60
processes, eight threads that read at once caused a crash (OpenCV 5.0.0), and one run failed because the importer had
not registered its operators ("Unsupported operator type RELU").
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

_local = threading.local()
_reading = threading.Lock()


def network(path: Path, read: Callable[[str], Any]) -> Any:
    """This thread's network of a file. On first use it is read by `read` (cv2.dnn.readNet...)."""
    nets: dict[Path, Any] = _local.__dict__.setdefault("nets", {})
    if path not in nets:
        with _reading:
            nets[path] = read(str(path))
    return nets[path]
