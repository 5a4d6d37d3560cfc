"""Reasons why a photo has no camera, and groups of photos that fit together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from stages.poses.matching import MIN_INLIERS, Pair, Verified

FEW_FEATURES = 0.25  # of the capture's median: a photo with fewer has too few to match
SOFT = 0.5  # of the median detail: a photo with less is blurred; the capture stage drops photos with less than 0.2


def linked(verified: Iterable[Pair], photos: int) -> list[list[int]]:
    """Connected components of the photos that match, the largest first; photos without a match are not included."""
    group = list(range(photos))

    def of(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    for i, j in verified:
        group[max(of(i), of(j))] = min(of(i), of(j))
    members: dict[int, list[int]] = {}
    for i in range(photos):
        members.setdefault(of(i), []).append(i)
    return sorted((m for m in members.values() if len(m) > 1), key=lambda m: (-len(m), m[0]))


def disjoint(groups: Iterable[Iterable[int]]) -> list[list[int]]:
    """Groups of at least two photos, each photo in the first group that has it; the first stays first, the others
    follow by size.

    COLMAP's models overlap: it may start a new one from photos that it registered before.
    """
    taken: set[int] = set()
    out = []
    for g in groups:
        own = sorted(set(g) - taken)
        taken |= set(own)
        out.append(own)
    return [g for g in out[:1] if g] + sorted((g for g in out[1:] if len(g) > 1), key=lambda g: (-len(g), g[0]))


def reasons(
    missing: Sequence[int], placed: Sequence[int], groups: Sequence[Sequence[int]], counts: Sequence[int],
    details: Sequence[float], verified: Mapping[Pair, Verified],
) -> dict[int, str]:  # fmt: skip
    """A short reason for each of the `missing` photos.

    groups: of photos that fit together, but not with the `placed` ones. counts: features of every photo. details:
    `pipeline.sharpness.detail` of every photo.
    """
    inside = {i: g for g in groups for i in g}
    best: dict[int, tuple[int, int]] = {}  # by photo: the photos that it matches, the most matches of one pair
    for (i, j), pair in verified.items():
        for one in (i, j):
            partners, most = best.get(one, (0, 0))
            best[one] = (partners + 1, max(most, len(pair.matches)))
    usual, sharp = float(np.median(counts)), float(np.median(details))
    out = {}
    for i in missing:
        partners, most = best.get(i, (0, 0))
        few, soft = counts[i] < FEW_FEATURES * usual, details[i] < SOFT * sharp
        if i in inside:
            more = len(inside[i]) - 1
            out[i] = (f"other group: it fits {_photos(more, 'more ')} without a camera, but not the {len(placed)} that "
                      "have one")  # fmt: skip
        elif few:
            out[i] = f"few features: it has {counts[i]}, the median of the photos is {usual:.0f}"
        elif soft:
            out[i] = f"blurred: it has {details[i] / sharp:.0%} of the median fine detail of the photos"
        elif partners:
            out[i] = (f"weak match: it matches {_photos(partners)}, with at most {most} features; too few of them link "
                      "it to the photos that have a camera")  # fmt: skip
        else:
            out[i] = f"no match: no other photo has {MIN_INLIERS} consistent matches with it"
    return out


def _photos(n: int, more: str = "") -> str:
    return f"{n} {more}photo{'s' if n > 1 else ''}"
