"""Cameras from photos alone by structure from motion: features, matches, mappers, and further attempts.

Only fitted photos are solved; held-out ones are registered afterwards (`held_out.py`).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.sharpness import detail
from stages.poses.bundle_adjustment import Refine
from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, detect_all, match_all
from stages.poses.feature_sets import FeatureSet
from stages.poses.features import DENOISED, PLAIN, Features, grey8
from stages.poses.mapper import MIN_POINTS, Lens, Mapper, Model, reconstruct
from stages.poses.matching import (
    Pair,
    Verified,
    homography_share,
)
from stages.poses.oblique import with_oblique
from stages.poses.quality import GOOD_SCORE, better, quality, score
from stages.poses.search import GLOBAL_FROM, Search
from stages.poses.triangulate import triangulate
from stages.poses.unregistered import disjoint, linked, reasons

POOR_SCORE = 0.75  # below this score, a separate lens for each photo is tried
SEEDS = 2  # further seeds for the mapper if the first solution has a trust below 1
ONE_SPOT_SHARE, HARDLY = 0.9, 0.1
DETAIL_EDGE = 1000  # pixels, longest edge at which the photos' sharpness is compared
BETTER_BY = 1.05  # a solution with a lens for each photo has more freedom, so its score must be better by this factor


@dataclass(frozen=True, slots=True)
class Solution:
    """The best model, None if no two photos fit together. left_out: reasons by index of each photo without a camera.
    groups: of photos that fit together; the first is the model's, the others follow by size. sets: features of every
    photo, from which the model was made.
    """

    model: Model | None
    left_out: dict[int, str]
    groups: tuple[tuple[int, ...], ...]
    sets: tuple[FeatureSet, ...]


def solve(
    photos: Sequence[Photo], config: Config, in_order: bool, scratch: Path, progress: Progress
) -> Solution:  # fmt: skip
    """The solution with the highest score (`quality`) of all attempts. Photos of equal size and EXIF share a lens,
    unless the score is poor and separate lenses are better. in_order: the photos are in order, as frames of a video.

    Raises:
        StageError: the photos were taken from one spot.
    """
    own = Search(photos, config, scratch, progress)
    for effort in (PLAIN, DENOISED)[: config.attempts]:
        of = own.features(effort)
        verified = match_all(photos, of.features, config, effort, progress, in_order)
        own.consider(_place(photos, of.features, verified, config, True, scratch, progress), of)
        if own.complete():
            break
    if config.attempts >= 3 and not own.complete():
        of, verified = with_oblique(photos, of, verified, config, progress, own.missing())
        own.consider(_place(photos, of.features, verified, config, True, scratch, progress), of)
    if score(own.best, photos) < POOR_SCORE:
        own.consider(_place(photos, of.features, verified, config, False, scratch, progress), of, BETTER_BY)
    own.grow()
    best = own.best
    if best is None or len(best.poses) < 0.5 * len(photos) or _hardly_moved(best):
        _not_from_one_spot(photos, of.features, verified, config.seed)
    counts = [len(f.uv) for f in own.features(PLAIN).features]
    return Solution(best, *_explained(best, photos, counts, verified), own.used)


def _explained(
    model: Model | None, photos: Sequence[Photo], counts: Sequence[int], verified: dict[Pair, Verified]
) -> tuple[dict[int, str], tuple[tuple[int, ...], ...]]:
    """A reason for each photo without a camera, and the groups of photos that fit together."""
    placed = sorted(model.poses) if model is not None else []
    missing = [i for i in range(len(photos)) if i not in placed]
    groups = disjoint([placed, *(model.others if model is not None else ())])
    if not missing:
        return {}, tuple(map(tuple, groups))
    details = [detail(grey8(p.pixels(), DETAIL_EDGE)) for p in photos]
    others = groups[1:] if placed else groups
    return reasons(missing, placed, others, counts, details, verified), tuple(map(tuple, groups))


def triangulate_given(
    photos: Sequence[Photo], cameras: Sequence[Camera], config: Config, in_order: bool, scratch: Path,
    progress: Progress, *, refine: bool, deviation: float,
) -> tuple[Model, list[int]] | None:  # fmt: skip
    """Sparse points from given cameras, and with `refine` refined poses; None if no point is visible in two photos.
    Second: the views that could not be refined. deviation: of the given centres, in the world's unit."""
    features = detect_all(photos, config, PLAIN, progress)
    verified = match_all(photos, features, config, PLAIN, progress, in_order)
    if not verified:
        return None
    progress(0, 1, "triangulating points")
    folder = scratch / "mapper"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        return triangulate(folder, cameras, features, verified, refine=refine, deviation=deviation, seed=config.seed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _hardly_moved(model: Model) -> bool:
    """Whether the cameras' spread is small relative to their distance from the points."""
    if len(model.points) < MIN_POINTS:
        return True
    centres = np.stack([p.world_from_cam[:3, 3] for p in model.poses.values()])
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    away = float(np.linalg.norm(np.median(model.points, axis=0) - np.median(centres, axis=0)))
    return spread < HARDLY * away


def _not_from_one_spot(
    photos: Sequence[Photo], features: Sequence[Features], verified: dict[Pair, Verified], seed: int
) -> None:  # fmt: skip
    """Raises StageError if nearly all matches fit homographies: photos from one spot differ by homographies only."""
    shares = []
    for (i, j), pair in verified.items():
        edge = max(photos[i].width, photos[i].height)
        shares.append(homography_share(features[i], features[j], pair, edge, seed))
    if len(shares) >= len(photos) / 2 and float(np.median(shares)) > ONE_SPOT_SHARE:
        raise StageError(
            "the photos seem to be taken from one spot",
            where="poses",
            value=f"{np.median(shares):.0%} of the matches of two photos fit a camera that only rotates",
            limit=f"at most {ONE_SPOT_SHARE:.0%}",
            remedy="walk around the subject instead of turning the camera or zooming; take each photo from another "
            "place",
        )


def _place(
    photos: Sequence[Photo], features: Sequence[Features], verified: dict[Pair, Verified], config: Config,
    shared: bool, scratch: Path, progress: Progress,
) -> Model | None:  # fmt: skip
    if not verified:
        return None
    groups = list(dict.fromkeys(p.group for p in photos)) if shared else []
    lens_of = [groups.index(p.group) for p in photos] if shared else list(range(len(photos)))
    lenses = []
    for lens in range(max(lens_of) + 1):
        members = [p for p, of in zip(photos, lens_of, strict=True) if of == lens]
        focals = [p.focal for p in members if p.focal is not None]
        lenses.append(Lens(members[0].width, members[0].height, float(np.median(focals)) if focals else None))
    folder = scratch / "mapper"
    stopped: list[BaseException] = []
    placed = 0
    together = set(next(iter(linked(verified, len(photos))), []))

    def next_image() -> bool:
        """An exception must not pass through COLMAP's C++ frames: it is stored and raised after COLMAP returns."""
        nonlocal placed
        try:
            progress(min(placed, len(photos) - 1), len(photos), "registering photos")
        except BaseException as e:
            stopped.append(e)
        placed += 1
        return bool(stopped)

    def attempt(mapper: Mapper, seed: int, loose: bool) -> Model | None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        found = reconstruct(
            folder, lenses, lens_of, features, verified, camera_model=config.camera_model, mapper=mapper,
            refine=Refine(), seed=(config.seed + seed) % 2**31, next_image=next_image, loose=loose,
        )  # fmt: skip
        shutil.rmtree(folder, ignore_errors=True)
        if stopped:
            raise stopped[0]
        return found

    return best_of(attempt, photos, together, mappers(len(photos), config.mapper))


def best_of(
    attempt: Callable[[Mapper, int, bool], Model | None], photos: Sequence[Photo], together: Set[int],
    ways: Sequence[Mapper],
) -> Model | None:  # fmt: skip
    """The best solution of the same matches; further attempts only if they can help.

    attempt(mapper, number added to the seed, loose). together: photos linked by matches. If some of these have no
    camera, a mapper that accepts fewer matches is tried; if lenses, points or errors are out of range, other seeds.
    Both only for fewer than GLOBAL_FROM photos: with more, each attempt takes long.
    """
    best: Model | None = None
    for mapper in ways:
        best = better(best, attempt(mapper, 0, False), photos)
        if score(best, photos) >= GOOD_SCORE:
            return best
    if "incremental" in ways and len(photos) < GLOBAL_FROM and together - set(best.poses if best else ()):
        best = better(best, attempt("incremental", 1, True), photos)
    for seed in range(2, 2 + SEEDS):
        if len(photos) >= GLOBAL_FROM or best is None or quality(best, photos).trust >= 1:
            break
        best = better(best, attempt(ways[0], seed, False), photos)
    return best


def mappers(photos: int, wanted: Literal["auto", "incremental", "global"]) -> tuple[Mapper, ...]:
    """The mappers for so many photos, in the order of use; the next one is used if the score is low."""
    if wanted != "auto":
        return (wanted,)
    return ("global", "incremental") if photos >= GLOBAL_FROM else ("incremental",)
