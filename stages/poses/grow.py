"""More photos for a solution, and wrong ones out of it.

The mapper registers a photo by features that already are points of two others. Photos of hair, or at a step of 20
degrees, have few of them. With guided matches (`guided.py`) the placed photos have five to ten times as many points,
and each photo without a camera is tried anew (`place.py`). It is accepted if it agrees with the model far better than
chance does (`agreement.py`). The same test removes photos that the mapper has registered wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stages.poses.agreement import Points, judged
from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, match_pairs
from stages.poses.feature_sets import FeatureSet, concatenated, matched
from stages.poses.features import Features
from stages.poses.guided import guided_pairs, near_pairs
from stages.poses.mapper import Model, Pose
from stages.poses.matching import Pair, Verified, promising_pairs
from stages.poses.place import KEPT, place
from stages.poses.register import lens_of, sightings
from stages.poses.rematch import ROUNDS as LAST_ROUNDS
from stages.poses.rematch import reconstructed

FEWEST_PHOTOS = 3  # of a model
SMALL = 0.1  # of the median score; the lowest of right cameras was .29 of it (a made-up person by phone)
CANDIDATES = 20  # photos that one without a camera is compared with
WEAK = 10  # matches of such a pair that fit one fundamental matrix
ROUNDS = 8  # of new photos
WIDENED = (4.0, 2.0, 1.0)  # factors of the band in which an added photo's partners are searched


@dataclass(slots=True)
class Growth:
    """The photos, and their guided matches by pair, which are kept while photos are added. features: of all sets.
    added: photos placed by this growth."""

    photos: Sequence[Photo]
    sets: Sequence[FeatureSet]
    config: Config
    scratch: Path
    progress: Progress
    features: Sequence[Features]
    matches: dict[Pair, Verified] = field(default_factory=dict)
    added: set[int] = field(default_factory=set)

    def rematched(self, model: Model, rounds: int = 1) -> Model:
        """The model from guided matches of its photos; as it was if these give no points, or lose a photo.

        Matches of added photos are made anew in narrowing bands: in a narrow one around a line that is pixels off, only
        wrong matches are found, and these confirm the camera.
        """
        wanted = near_pairs(model.poses)
        uncertain = [p for p in wanted if self.added & set(p)]
        self._match(model, [p for p in wanted if p not in self.matches and not self.added & set(p)])
        for widened in WIDENED if uncertain else WIDENED[-1:]:
            self._match(model, uncertain, widened)
            self.tick("refining cameras")
            found = reconstructed(
                model, self.photos, self.features, {p: self.matches[p] for p in wanted if p in self.matches},
                self.config.camera_model, self.scratch / "rematch", self.config.seed, rounds,
            )  # fmt: skip
            model = model if found is None or set(found.poses) != set(model.poses) else found
        return model

    def _match(self, model: Model, pairs: Sequence[Pair], widened: float = 1.0) -> None:
        """Match these pairs by their cameras, anew if they have matches."""
        for p in pairs:
            self.matches.pop(p, None)
        self.matches |= matched(
            self.sets, lambda s: guided_pairs(model.poses, self.photos, s.features, pairs, self.tick, widened)
        )

    def tick(self, message: str = "matching by cameras") -> None:
        """Show progress; raises to stop."""
        self.progress(0, 1, message)


def checked(model: Model, photos: Sequence[Photo], sets: Sequence[FeatureSet], progress: Progress) -> Model:
    """The model without the photos that agree with the others hardly better than chance, or far worse than most do; the
    worst goes first, because it spoils the scores of its neighbours. Cameras and points of the others stay.

    sets: those that the model was made from.
    """
    features = concatenated(sets)
    while len(model.poses) > FEWEST_PHOTOS:
        points, scores = Points(model, features), dict[int, float]()
        for i, pose in model.poses.items():
            progress(0, 1, "checking cameras")
            scores[i] = points.agreement(judged(i, photos, features), pose).score
        worst = min(scores, key=lambda i: (scores[i], i))
        if scores[worst] >= max(KEPT, SMALL * float(np.median(list(scores.values())))):
            break
        model = _without(model, worst)
    return model


def _without(model: Model, photo: int) -> Model:
    """The model without the camera of this photo; points that only it and one other photo show go, too."""
    track = model.track.copy()
    track[model.seen[photo][:, 1]] -= 1
    return _with_points(
        replace(
            model, poses={i: p for i, p in model.poses.items() if i != photo}, track=track,
            seen={i: own for i, own in model.seen.items() if i != photo},
            view_error_px={i: e for i, e in model.view_error_px.items() if i != photo},
        ), track >= 2,
    )  # fmt: skip


def only_of_three(model: Model) -> Model:
    """The model without points that two photos show alone: any two matches on epipolar lines make one, right or wrong,
    and the mapper has none of them either."""
    return _with_points(model, model.track >= 3)


def _with_points(model: Model, kept: npt.NDArray[np.bool_]) -> Model:
    """The model with these of its points (M,), numbered anew."""
    number = np.cumsum(kept) - 1
    seen = {}
    for i, own in model.seen.items():
        left = own[kept[own[:, 1]]]
        seen[i] = np.stack([left[:, 0], number[left[:, 1]]], 1)
    return replace(model, seen=seen, track=model.track[kept], points=model.points[kept],
                   error_px=model.error_px[kept])  # fmt: skip


def grown(
    model: Model, photos: Sequence[Photo], sets: Sequence[FeatureSet], config: Config, scratch: Path, progress: Progress
) -> Model | None:
    """The model from guided matches, with those of the other photos that it can place; None if it can place none.

    sets: of every photo; need not be those that the model was made from. `seen` of the result refers to these.
    """
    features = concatenated(sets)
    own = Growth(photos, sets, config, scratch, progress, features)
    missing = [i for i in range(len(photos)) if i not in model.poses]
    links = matched(sets, lambda s: _links(own, s, missing))
    before, model = len(model.poses), own.rematched(model)
    for _ in range(ROUNDS):
        points, found = Points(model, features), dict[int, Pose]()
        for i in (i for i in missing if i not in model.poses):
            own.tick("placing more photos")
            placed = place(judged(i, photos, features), points, sightings(i, model, links),
                           lens_of(photos[i], photos, model), config.seed)  # fmt: skip
            if placed is not None:
                found[i] = placed.pose
        if not found:
            break
        own.added |= set(found)
        model = own.rematched(replace(model, poses=dict(sorted({**model.poses, **found}.items()))))
    if len(model.poses) == before:
        return None
    return only_of_three(checked(own.rematched(model, LAST_ROUNDS), photos, sets, progress))


def _links(own: Growth, of: FeatureSet, missing: Sequence[int]) -> dict[Pair, Verified]:
    """Matches of photos without a camera with all photos that may show the same."""
    near = promising_pairs(of.features, of.effort.ratio, CANDIDATES, lambda: own.tick("comparing photos"))
    pairs = [p for p in near if set(p) & set(missing)]
    return match_pairs(own.photos, of.features, pairs, own.config, of.effort, own.progress, WEAK)
