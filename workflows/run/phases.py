"""How far a stage is, as one number that never falls, from the progress that it tells of its parts.

A stage tells its progress part by part: 40 of 40 photos read, then 0 of 3,000 steps. `SHARES` says which part of the
stage's time each of them is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

# Stage -> the start of a part's message -> where it begins and ends, of the stage's time. Measured: the demo in draft
# on two cores without a GPU.
SHARES: dict[str, dict[str, tuple[float, float]]] = {
    "capture": {"checking": (0.0, 1.0)},
    "poses": {"detecting features": (0.0, 0.13), "checking the cameras": (0.13, 1.0)},
    "masks": {"masking": (0.0, 0.77), "checking masks": (0.77, 0.79), "detecting faces": (0.79, 1.0)},
    "inverse_rendering": {
        "reading photos": (0.0, 0.01),
        "visual hull": (0.01, 0.03),
        "initial geometry": (0.03, 0.35),
        "fitting": (0.35, 0.97),
        "held-out views": (0.97, 1.0),
    },
}
ONLY = 0.9  # of a stage without a line: its first part, most often the only one
UNKNOWN = 0.5  # of what is left of a stage: a part that has no share


@dataclass(slots=True)
class Parts:
    """The parts of one stage, in the order in which they come. share: of the stage that is done, 0..1."""

    shares: Mapping[str, tuple[float, float]]
    share: float = 0.0
    _part: str | None = None
    _span: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, stage: str) -> Parts:
        """Those of a stage, of which nothing is done yet."""
        return cls(SHARES.get(stage, {}))

    def tell(self, done: int, total: int, message: str) -> float:
        """The share that is done when the stage tells `done` of `total`. It never falls."""
        part = part_of(message)
        if part != self._part:
            self._span, self._part = self._span_of(part), part
        begin, end = self._span
        within = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        self.share = max(self.share, begin + (end - begin) * within)
        return self.share

    def _span_of(self, part: str) -> tuple[float, float]:
        known = next((span for start, span in self.shares.items() if part.startswith(start)), None)
        if known is not None:
            return known
        of_the_rest = ONLY if self._part is None and not self.shares else UNKNOWN
        return self.share, self.share + of_the_rest * (1.0 - self.share)


def part_of(message: str) -> str:
    """The message without what counts in it: "photo 3 of 40" and "photo 4 of 40" are of one part."""
    words = [w for w in message.split() if not any(c.isdigit() for c in w)]
    return " ".join(words)
