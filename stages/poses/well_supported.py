"""Which photos of a solution hold together: a mapper that accepts few matches is not to be believed on them alone."""

from __future__ import annotations

from collections.abc import Mapping, Set

HELD = 30  # points that a photo, or a group, must share with the rest: what COLMAP by itself asks before it places one


def well_supported(seen: Mapping[int, Set[int]], least: int = HELD) -> list[int]:
    """Photos that hang together by `least` points or more, ascending: the largest such group.

    seen: points by photo. Two groups are one as soon as they share so many points, over all their photos; so a ring of
    photos may hang on another by a few matches of many photos, but neither a photo nor a ring by a few of one.
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
