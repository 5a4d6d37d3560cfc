"""Cameras of held-out photos: registered one by one against the finished model, which stays as it is.

Features of a held-out photo are matched with those of fitted photos; where such a feature is an observation of a sparse
point, the match is one of the photo with the point. The pose follows from these (`register.py`). The lens is that of
the fitted photos by the same lens.
"""

from __future__ import annotations

from collections.abc import Sequence

from stages.poses.agreement import Points, judged
from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, detect_all, match_pairs
from stages.poses.feature_sets import FeatureSet, concatenated, matched
from stages.poses.mapper import Model
from stages.poses.matching import Pair, Verified, promising_pairs
from stages.poses.place import KEPT, place
from stages.poses.register import Registered, lens_of, register, sightings


def register_all(
    fitted: Sequence[Photo], held: Sequence[Photo], model: Model, sets: Sequence[FeatureSet], config: Config,
    progress: Progress,
) -> list[Registered | None]:  # fmt: skip
    """The camera of each photo of `held` in the world of the model of `fitted`; None where too few matches fit, or
    where the photo does not agree with the model.

    sets: features of `fitted`, as the model was made from. The model is not changed.
    """
    if not held:
        return []
    photos = [*fitted, *held]
    every = [FeatureSet(s.effort, (*s.features, *detect_all(held, config, s.effort, progress))) for s in sets]
    verified = matched(every, lambda s: _matches(photos, s, len(fitted), model, config, progress))
    features = concatenated(every)
    points, found = Points(model, features), []
    for number in range(len(fitted), len(photos)):
        photo = judged(number, photos, features)
        lens, seen = lens_of(photos[number], fitted, model), sightings(number, model, verified)
        own = register(photo.uv(seen), model.points[seen[:, 1]], lens, photo.size, config.seed)
        if own is None or points.agreement(photo, own.pose).score < KEPT:
            own = place(photo, points, seen, lens, config.seed)
        found.append(own)
    return found


def _matches(
    photos: Sequence[Photo], of: FeatureSet, fitted: int, model: Model, config: Config, progress: Progress
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches of placed photos (first of a pair) with held-out ones (second, after all fitted ones)."""
    near = promising_pairs(of.features, of.effort.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"))
    pairs = [(i, j) for i, j in near if i in model.poses and j >= fitted]
    return match_pairs(photos, of.features, pairs, config, of.effort, progress)
