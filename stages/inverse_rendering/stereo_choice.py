"""The start from stereo: a sweep along the hull's normals, depth maps, or each of them where it is better.

Some views are kept aside to decide. Both starts are built without them and compared on them (stereo_scores.py), place
by place (stereo_blend.py). Short sweeps of all views follow, along normals that are right by now.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stages.inverse_rendering.dense_stereo import DepthMaps, depth_maps
from stages.inverse_rendering.depth_fusion import fused
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView, evenly_spaced
from stages.inverse_rendering.stereo import SWEEPS, Sweep, start_from_photos
from stages.inverse_rendering.stereo_blend import blended, share_of_maps
from stages.inverse_rendering.stereo_scores import mean_score, shown_by, validation_of

Facts = dict[str, str | float | bool]
log = logging.getLogger("neuface.inverse_rendering")
VALIDATION, MIN_VIEWS = 12, 8  # validation views at most; with fewer views than MIN_VIEWS: the sweep
SHORT = SWEEPS[1:]  # sweeps of a surface whose normals are right: they add what fusion smoothed


def stereo_start(
    hull: Start,
    views: list[PhotoView],
    kind: str,
    device: str,
    check: Callable[[], None] = lambda: None,
    sweeps: tuple[Sweep, ...] = SWEEPS,
) -> tuple[Start, Facts]:
    """The start from stereo, and its figures. kind: auto, sweep or dense. sweeps: those along the hull's normals."""
    if kind == "sweep" or (kind == "auto" and len(views) < MIN_VIEWS):
        why = "setting" if kind == "sweep" else f"fewer than {MIN_VIEWS} views"
        return start_from_photos(hull, views, device, check, sweeps), {"start": "sweep", "why": why}
    if kind == "dense":
        whole = fused(hull, depth_maps(hull, views, check), check)
        return start_from_photos(whole, views, device, check, SHORT), {"start": "dense", "why": "setting"}
    return _both(hull, views, device, check, sweeps)


def _both(
    hull: Start, views: list[PhotoView], device: str, check: Callable[[], None], sweeps: tuple[Sweep, ...]
) -> tuple[Start, Facts]:
    """The start of sweep and depth maps, each where it shows the validation views better."""

    def swept(start: Start, seen: list[PhotoView], steps: tuple[Sweep, ...] = SHORT) -> Start:
        return start_from_photos(start, seen, device, check, steps)

    waiting = validation_views(len(views))
    seen = [v for n, v in enumerate(views) if n not in waiting]
    validation = validation_of(hull, views, waiting)
    sweep = swept(hull, seen, sweeps)
    maps = depth_maps(hull, views, check, waiting)
    dense = swept(fused(hull, without(maps, waiting), check), seen)
    one, two = shown_by(sweep, validation, check), shown_by(dense, validation, check)
    share = share_of_maps(one, two, validation, hull)
    start = blended(sweep, swept(fused(hull, maps, check), views), share)
    start = swept(start, views, sweeps[1:] or sweeps)
    facts: Facts = {
        "start": "both",
        "sweep_correlation": round(mean_score(one, validation), 4),
        "dense_correlation": round(mean_score(two, validation), 4),
        "start_correlation": round(mean_score(shown_by(start, validation, check), validation), 4),
        "dense_share": round(float(share[np.abs(start.values) < start.cell].mean()), 3),
    }
    log.info("start from stereo: %s", facts)
    return start, {**facts, "why": "each where the photos agree better on validation views"}


def validation_views(views: int) -> tuple[int, ...]:
    """Positions of the validation views, evenly spaced."""
    return evenly_spaced(views, min(VALIDATION, views // 4))


def without(maps: DepthMaps, left_out: tuple[int, ...]) -> DepthMaps:
    """The same maps, some of which get no vote."""
    weight = maps.weight.copy()
    weight[list(left_out)] = 0
    return replace(maps, weight=weight)
