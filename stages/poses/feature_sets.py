"""Features of all photos, of one detection effort or of several side by side.

A spot found by two efforts has two features with nearly the same descriptor, which would fail the ratio test. So each
set is matched on its own, and the matches are put together afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stages.poses.features import Effort, Features
from stages.poses.matching import Pair, Verified, joined


@dataclass(frozen=True, slots=True)
class FeatureSet:
    """Features of every photo, detected with one effort."""

    effort: Effort
    features: tuple[Features, ...]


def concatenated(sets: Sequence[FeatureSet]) -> tuple[Features, ...]:
    """The features of every photo, those of the first set first."""
    return tuple(_together(of_photo) for of_photo in zip(*(s.features for s in sets), strict=True))


def _together(parts: Sequence[Features]) -> Features:
    if len(parts) == 1:
        return parts[0]
    return Features(np.concatenate([f.uv for f in parts]), np.concatenate([f.descriptors for f in parts]))


def matched(
    sets: Sequence[FeatureSet], find: Callable[[FeatureSet], dict[Pair, Verified]]
) -> dict[Pair, Verified]:  # fmt: skip
    """Matches of `find` in each set, as indices into `concatenated`."""
    out: dict[Pair, Verified] = {}
    counts = [0] * (len(sets[0].features) if sets else 0)
    for own in sets:
        out = joined(out, find(own), counts)
        counts = [n + len(f.uv) for n, f in zip(counts, own.features, strict=True)]
    return out
