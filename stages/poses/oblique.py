"""Features of simulated oblique views (ASIFT) of photos that lack a camera and of those that may show the same; ten
times slower than others, so not of all photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, detect_all, match_pairs
from stages.poses.feature_sets import FeatureSet, concatenated
from stages.poses.features import ASIFT, MORE_ASIFT, Features
from stages.poses.matching import (
    MIN_INLIERS,
    REPEAT,
    Pair,
    Verified,
    joined,
    promising_pairs,
    without_repeats,
)


def oblique_set(
    photos: Sequence[Photo], features: Sequence[Features], config: Config, progress: Progress, lost: Sequence[int]
) -> FeatureSet:
    """ASIFT features of the `lost` photos and their most similar neighbours; the others have none.

    features: other ones of every photo, by which neighbours are found.
    """
    most = MORE_ASIFT * config.max_features
    wanted = sorted({i for p in _pairs(features, config, progress, lost) for i in p})
    found = detect_all([photos[i] for i in wanted], config.changed(max_features=most), ASIFT, progress)
    nothing = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    every = [nothing] * len(photos)
    for i, own in zip(wanted, found, strict=True):
        every[i] = own
    return FeatureSet(ASIFT, tuple(every), most)


def with_oblique(
    photos: Sequence[Photo], of: FeatureSet, verified: dict[Pair, Verified], config: Config, progress: Progress,
    lost: Sequence[int],
) -> tuple[FeatureSet, dict[Pair, Verified]]:  # fmt: skip
    """The features and matches so far, with ASIFT features and matches of the `lost` photos."""
    more = oblique_set(photos, of.features, config, progress, lost)
    pairs = _pairs(of.features, config, progress, lost)
    found = match_pairs(photos, more.features, pairs, config, ASIFT, progress)
    single = {}
    for (i, j), pair in found.items():
        cell = REPEAT * max(photos[i].width, photos[i].height)
        kept = without_repeats(pair, more.features[i], more.features[j], cell)
        if len(kept.matches) >= MIN_INLIERS:
            single[i, j] = kept
    both = FeatureSet(of.effort, concatenated((of, more)), of.most)
    return both, joined(verified, single, [len(f.uv) for f in of.features])


def _pairs(features: Sequence[Features], config: Config, progress: Progress, lost: Sequence[int]) -> list[Pair]:
    near = promising_pairs(features, ASIFT.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"))
    return [p for p in near if set(p) & set(lost)]
