"""Which photos of a solution share enough points: a mapper that accepts few matches may register photos wrongly."""

from __future__ import annotations

from collections.abc import Mapping, Set

MIN_SHARED = 30  # points that a photo, or a group, must share with the rest: COLMAP's default to register a photo


def well_supported(seen: Mapping[int, Set[int]], least: int = MIN_SHARED) -> list[int]:
    """The largest group of photos that share at least `least` points, ascending.

    seen: points by photo. Two groups are merged if they share `least` points over all their photos. So two rings of
    cameras may be linked by a few matches of many photos, but not by a few matches of one photo.
    """
    groups = [({photo}, set(points)) for photo, points in sorted(seen.items())]
    merged = True
    while merged:
        merged = False
        for i in range(len(groups)):
            members, points = groups[i]
            for j in range(len(groups) - 1, i, -1):
                if len(points & groups[j][1]) >= least:
                    members |= groups[j][0]
                    points |= groups[j][1]
                    del groups[j]
                    merged = True
            if merged:
                break
    largest = max(groups, key=lambda g: (len(g[0]), len(g[1]), -min(g[0])), default=(set(), set()))
    return sorted(largest[0])
