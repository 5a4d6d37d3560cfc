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


def with_oblique(
    photos: Sequence[Photo], of: FeatureSet, verified: dict[Pair, Verified], config: Config, progress: Progress,
    lost: Sequence[int],
) -> tuple[FeatureSet, dict[Pair, Verified]]:  # fmt: skip
    """The features and matches so far, with ASIFT features and matches of the `lost` photos and their most similar
    neighbours; the others get none."""
    near = promising_pairs(of.features, ASIFT.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"))
    pairs = [p for p in near if set(p) & set(lost)]
    wanted = sorted({i for p in pairs for i in p})
    many = config.changed(max_features=MORE_ASIFT * config.max_features)
    found = dict(zip(wanted, detect_all([photos[i] for i in wanted], many, ASIFT, progress), strict=True))
    nothing = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    more = FeatureSet(ASIFT, tuple(found.get(i, nothing) for i in range(len(photos))))
    single = {}
    for (i, j), pair in match_pairs(photos, more.features, pairs, config, ASIFT, progress).items():
        cell = REPEAT * max(photos[i].width, photos[i].height)
        kept = without_repeats(pair, more.features[i], more.features[j], cell)
        if len(kept.matches) >= MIN_INLIERS:
            single[i, j] = kept
    both = FeatureSet(of.effort, concatenated((of, more)))
    return both, joined(verified, single, [len(f.uv) for f in of.features])
