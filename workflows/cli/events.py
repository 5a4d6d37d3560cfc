"""`--json`: what happens in a run as one JSON object per line, for programs that start `neuface` and follow it.

Every line has `event` and `time` (s since the command began). docs/running.md lists the events and their fields.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, TextIO

PROGRESS_EVERY = 1.0  # seconds between two events of one stage's progress


class Events:
    """Writes events to a stream. A reader that is gone stops nothing: the run goes on without events."""

    def __init__(self, stream: TextIO, clock: Callable[[], float]) -> None:
        self.stream: TextIO | None = stream
        self.clock, self.begun = clock, clock()

    def tell(self, event: str, **fields: Any) -> None:
        """Write one line."""
        if self.stream is None:
            return
        line = {"event": event, "time": round(self.clock() - self.begun, 2), **fields}
        try:
            self.stream.write(json.dumps(line, default=str) + "\n")
            self.stream.flush()
        except OSError:
            self.stream = None
