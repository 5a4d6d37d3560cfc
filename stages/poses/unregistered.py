"""Why a photo found no place, in plain words, and which photos fit among themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from stages.poses.matching import MIN_INLIERS, Pair, Verified

FEW_FEATURES = 0.25  # of the capture's median: a photo with fewer shows little that can be found again
SOFT = 0.5  # of the median detail: the capture stage drops what has less than 0.2, motion blur begins here


def linked(verified: Iterable[Pair], photos: int) -> list[list[int]]:
    """Photos that hang together by pairs that match, the largest group first; photos without a pair are not named."""
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
    """Groups of two photos or more, each photo in the first that has it; the first stays first, the largest follow.

    COLMAP's solutions overlap where it began anew from photos that it had placed before.
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
    """A short sentence for each of the `missing` photos.

    groups: of photos that fit among themselves, but not with the placed ones. counts: features of every photo. details:
    its `pipeline.sharpness.detail`.
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
            out[i] = (f"other group: it fits {_photos(more, 'more ')} without a place, but not the {len(placed)} that "
                      "have one")  # fmt: skip
        elif few:
            out[i] = f"few features: {counts[i]} spots to match by, the photos have {usual:.0f} in the median"
        elif soft:
            out[i] = f"blurred: it has {details[i] / sharp:.0%} of the fine detail that the photos have in the median"
        elif partners:
            out[i] = (f"weak match: it matches {_photos(partners)}, {most} spots at best; too few of these tie it "
                      "to the photos that have a place")  # fmt: skip
        else:
            out[i] = f"no match: no other photo shares {MIN_INLIERS} spots with it that fit one geometry"
    return out


def _photos(n: int, more: str = "") -> str:
    return f"{n} {more}photo{'s' if n > 1 else ''}"
