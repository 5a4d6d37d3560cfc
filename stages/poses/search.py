"""The best solution of several attempts: each is checked, and what it lacks is tried once more by its own cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, detect_all
from stages.poses.feature_sets import FeatureSet
from stages.poses.features import DENOISED, PLAIN, Effort
from stages.poses.grow import checked, grown
from stages.poses.mapper import Model
from stages.poses.quality import GOOD_SCORE, better, score

GLOBAL_FROM = 200  # photos: from here on the global mapper, and no second try of single photos, which take hours


@dataclass(slots=True)
class Search:
    """best: the best solution so far; used: features that its `seen` refers to. sets: features by effort. tried: the
    solution that was grown last, and what came of it."""

    photos: Sequence[Photo]
    config: Config
    scratch: Path
    progress: Progress
    best: Model | None = None
    used: tuple[FeatureSet, ...] = ()
    sets: dict[Effort, FeatureSet] = field(default_factory=dict)
    tried: tuple[Model | None, Model | None] = (None, None)

    def features(self, effort: Effort) -> FeatureSet:
        """Of every photo, detected once."""
        if effort not in self.sets:
            found = detect_all(self.photos, self.config, effort, self.progress)
            self.sets[effort] = FeatureSet(effort, tuple(found))
        return self.sets[effort]

    def complete(self) -> bool:
        """Whether further attempts are not worth their time."""
        return score(self.best, self.photos) >= GOOD_SCORE

    def missing(self) -> list[int]:
        """Photos without a camera."""
        return [i for i in range(len(self.photos)) if self.best is None or i not in self.best.poses]

    def consider(self, found: Model | None, of: FeatureSet, by: float = 1.0) -> None:
        """Take a solution, without the photos that contradict it, if its score is better by this factor. If it is not
        good, it is grown, which counts if it makes it good: else another attempt is a better start. of: the features
        that `found` was made from."""
        if found is None:
            return
        own = checked(found, self.photos, (of,), self.progress)
        if self.best is not None and (
            better(self.best, own, self.photos) is self.best
            or score(own, self.photos) < by * score(self.best, self.photos)
        ):
            return
        self.best, self.used = own, (of,)
        if not self.complete():
            self.grow(GOOD_SCORE)

    def grow(self, least: float = 0.0) -> None:
        """Place the photos that have no camera, as far as they agree with the solution. Taken if the score is better,
        and at least `least`."""
        if self.best is None or len(self.photos) >= GLOBAL_FROM or not self.missing():
            return
        sets = tuple(self.features(effort) for effort in (PLAIN, DENOISED)[: self.config.attempts])
        if self.tried[0] is not self.best:
            self.tried = self.best, grown(self.best, self.photos, sets, self.config, self.scratch, self.progress)
        more = self.tried[1]
        if more is not None and better(self.best, more, self.photos) is more and score(more, self.photos) >= least:
            self.best, self.used = more, sets
