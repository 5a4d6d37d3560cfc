"""Cameras from photos alone: features, matches, structure from motion, and more effort if that is not enough.

Held-out views take part here: their cameras have to come from somewhere, and no pixel of theirs reaches the fit.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.sharpness import detail
from stages.poses.bundle_adjustment import Refine
from stages.poses.config import Config
from stages.poses.features import ASKEW, MORE_ASKEW, PATIENT, PLAIN, Effort, Features, detect, grey8
from stages.poses.mapper import MIN_POINTS, Lens, Mapper, Model, reconstruct
from stages.poses.matching import (
    MIN_INLIERS,
    Pair,
    Verified,
    homography_share,
    joined,
    match,
    promising_pairs,
    verify,
    without_repeats,
)
from stages.poses.quality import GOOD_SCORE, better, quality, score
from stages.poses.triangulate import triangulate
from stages.poses.unregistered import disjoint, linked, reasons

WORKERS = 2  # the result does not depend on it: each photo, and each pair, is a task of its own
SEEDS = 2  # more tries of the mapper where the first solution is doubted for more than the photos that it lacks
POOR_SCORE = 0.75  # below it is worth doubting that the photos share a lens
REPEAT = 2 / 640  # of the longest edge: matches nearer than this at both ends are one
ONE_SPOT_SHARE, HARDLY = 0.9, 0.1
CHUNK = 64  # pairs between two looks at whether to stop
DETAIL_EDGE = 1000  # pixels, at which the photos' sharpness is compared
GLOBAL_FROM = 200  # photos: from here on all are placed at once, which takes minutes where one by one takes hours
BETTER_BY = 1.05  # a try with a lens for each photo must have so many times the score: it is the looser model


class Photo(Protocol):
    """One photo: how to read it, and what is known of its lens."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def focal(self) -> float | None:
        """Pixels, if known."""
        ...

    @property
    def group(self) -> str:
        """Photos of one lens have the same."""
        ...

    def pixels(self) -> npt.NDArray[np.generic]:
        """(H, W, C) as stored."""
        ...

    def inside(self) -> npt.NDArray[np.float32] | None:
        """(H, W) alpha of the subject, or None."""
        ...


Progress = Callable[[int, int, str], None]  # done, total, message; raises to stop


@dataclass(frozen=True, slots=True)
class Solution:
    """The best model, if any two photos fit together. left_out: why, by number of each photo without a place. groups:
    of photos that fit among themselves; the first is that of the model, the others follow by size.
    """

    model: Model | None
    left_out: dict[int, str]
    groups: tuple[tuple[int, ...], ...]


def solve(
    photos: Sequence[Photo], config: Config, in_order: bool, scratch: Path, progress: Progress
) -> Solution:  # fmt: skip
    """The solution with the highest score (`quality`) of all tries. Photos of equal size and EXIF share a lens, unless
    the score doubts it and far more photos fit without. in_order: the photos follow each other, as a film's frames do.

    Raises:
        StageError: the photos were taken from one spot.
    """
    best: Model | None = None
    counts = [0] * len(photos)
    for effort in (PLAIN, PATIENT)[: config.attempts]:
        features = detect_all(photos, config, effort, progress)
        counts = counts if any(counts) else [len(f.uv) for f in features]
        verified = match_all(photos, features, config, effort, progress, in_order)
        best = better(best, _place(photos, features, verified, config, True, scratch, progress), photos)
        if score(best, photos) >= GOOD_SCORE:
            break
    if config.attempts >= 3 and score(best, photos) < GOOD_SCORE:
        lost = [i for i in range(len(photos)) if best is None or i not in best.poses]
        features, verified = _oblique(photos, features, verified, config, progress, lost)
        best = better(best, _place(photos, features, verified, config, True, scratch, progress), photos)
    if score(best, photos) < POOR_SCORE:
        separate = _place(photos, features, verified, config, False, scratch, progress)
        if best is None or score(separate, photos) >= BETTER_BY * score(best, photos):
            best = separate
    if best is None or len(best.poses) < 0.5 * len(photos) or _hardly_moved(best):
        _not_from_one_spot(photos, features, verified, config.seed)
    return _explained(best, photos, counts, verified)


def _explained(
    model: Model | None, photos: Sequence[Photo], counts: Sequence[int], verified: dict[Pair, Verified]
) -> Solution:
    """The model, and a reason for each photo that it lacks."""
    placed = sorted(model.poses) if model is not None else []
    missing = [i for i in range(len(photos)) if i not in placed]
    groups = disjoint([placed, *(model.others if model is not None else ())])
    if not missing:
        return Solution(model, {}, tuple(map(tuple, groups)))
    details = [detail(grey8(p.pixels(), DETAIL_EDGE)) for p in photos]
    others = groups[1:] if placed else groups
    return Solution(model, reasons(missing, placed, others, counts, details, verified), tuple(map(tuple, groups)))


def triangulate_given(
    photos: Sequence[Photo], cameras: Sequence[Camera], config: Config, in_order: bool, scratch: Path,
    progress: Progress, *, refine: bool, deviation: float,
) -> tuple[Model, list[int]] | None:  # fmt: skip
    """Sparse points from given cameras, and with `refine` better poses; None if no point is seen twice. Second: the
    views that were not mended. deviation: of the given centres, in the world's unit."""
    features = detect_all(photos, config, PLAIN, progress)
    verified = match_all(photos, features, config, PLAIN, progress, in_order)
    if not verified:
        return None
    progress(0, 1, "finding points")
    folder = scratch / "mapper"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        return triangulate(folder, cameras, features, verified, refine=refine, deviation=deviation, seed=config.seed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _oblique(
    photos: Sequence[Photo], features: list[Features], verified: dict[Pair, Verified], config: Config,
    progress: Progress, lost: Sequence[int],
) -> tuple[list[Features], dict[Pair, Verified]]:  # fmt: skip
    """The features and matches so far, and those of the `lost` photos and their likeliest neighbours seen as if from
    farther round; the others have found their place without."""
    more = config.changed(max_features=MORE_ASKEW * config.max_features)
    near = promising_pairs(features, ASKEW.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"))
    pairs = [p for p in near if set(p) & set(lost)]
    wanted = sorted({i for p in pairs for i in p})
    nothing = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    oblique = [nothing] * len(photos)
    for i, f in zip(wanted, detect_all([photos[i] for i in wanted], more, ASKEW, progress), strict=True):
        oblique[i] = f
    found = match_pairs(photos, oblique, pairs, more, ASKEW, progress)
    single = {}
    for (i, j), pair in found.items():
        cell = REPEAT * max(photos[i].width, photos[i].height)
        kept = without_repeats(pair, oblique[i], oblique[j], cell)
        if len(kept.matches) >= MIN_INLIERS:
            single[i, j] = kept
    both = [Features(np.concatenate([f.uv, g.uv]), np.concatenate([f.descriptors, g.descriptors]))
            for f, g in zip(features, oblique, strict=True)]  # fmt: skip
    return both, joined(verified, single, [len(f.uv) for f in features])


def _hardly_moved(model: Model) -> bool:
    """Whether the cameras' centres lie close together against their distance from the points."""
    if len(model.points) < MIN_POINTS:
        return True
    centres = np.stack([p.world_from_cam[:3, 3] for p in model.poses.values()])
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    away = float(np.linalg.norm(np.median(model.points, axis=0) - np.median(centres, axis=0)))
    return spread < HARDLY * away


def _not_from_one_spot(
    photos: Sequence[Photo], features: Sequence[Features], verified: dict[Pair, Verified], seed: int
) -> None:  # fmt: skip
    """Photos from one spot differ by a homography each, whatever they show."""
    shares = []
    for (i, j), pair in verified.items():
        edge = max(photos[i].width, photos[i].height)
        shares.append(homography_share(features[i], features[j], pair, edge, seed))
    if len(shares) >= len(photos) / 2 and float(np.median(shares)) > ONE_SPOT_SHARE:
        raise StageError(
            "the photos look as if taken from one spot",
            where="poses",
            value=f"{np.median(shares):.0%} of the matches of two photos fit a camera that only turns",
            limit=f"at most {ONE_SPOT_SHARE:.0%}",
            remedy="walk around the subject instead of turning the camera or zooming; each photo from another place",
        )


def detect_all(photos: Sequence[Photo], config: Config, effort: Effort, progress: Progress) -> list[Features]:
    """Features of every photo."""

    def one(photo: Photo) -> Features:
        grey = grey8(photo.pixels(), config.max_image_size)
        alpha = photo.inside()
        inside = None
        if alpha is not None:
            inside = (cv2.resize(alpha, grey.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
        return detect(grey, (photo.width, photo.height), config.max_features, effort, inside)

    found = []
    with _single_threaded_cv2(), ThreadPoolExecutor(WORKERS) as pool:
        tasks = [pool.submit(one, p) for p in photos]
        try:
            for i, task in enumerate(tasks):
                progress(i, len(photos), "looking for features")
                found.append(task.result())
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return found


def match_all(
    photos: Sequence[Photo], features: Sequence[Features], config: Config, effort: Effort, progress: Progress,
    in_order: bool = False,
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches by pair of photos. in_order: they follow each other, as a film's frames do."""
    pairs = promising_pairs(features, effort.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"),
                            in_order)  # fmt: skip
    return match_pairs(photos, features, pairs, config, effort, progress)


def match_pairs(
    photos: Sequence[Photo], features: Sequence[Features], pairs: Sequence[Pair], config: Config, effort: Effort,
    progress: Progress,
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches of the given pairs."""

    def one(pair: Pair) -> Verified | None:
        i, j = pair
        matches = match(features[i].descriptors, features[j].descriptors, effort.ratio)
        edge = max(photos[i].width, photos[i].height, photos[j].width, photos[j].height)
        return verify(features[i], features[j], matches, edge, config.seed)

    found = {}
    with _single_threaded_cv2(), ThreadPoolExecutor(WORKERS) as pool:
        for n in range(0, len(pairs), CHUNK):
            progress(n, len(pairs), "matching photos")
            some = pairs[n : n + CHUNK]
            found.update({p: v for p, v in zip(some, pool.map(one, some), strict=True) if v is not None})
    return found


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
        """Progress must not raise through COLMAP's own frames: the exception is kept and raised behind it."""
        nonlocal placed
        try:
            progress(min(placed, len(photos) - 1), len(photos), "placing photos")
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
    """The best solution of the same matches; more are tried only while there is a doubt that they could dispel.

    attempt(mapper, what is added to the seed, loose). together: photos that hang together by their matches. A mapper
    that accepts fewer matches is worth a try where some of these lack a place; another seed where lenses, points or
    errors are not as they should be. Both are for fewer than GLOBAL_FROM photos: of more, each try takes long.
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
    """The ways to place so many photos, the likeliest first; the next is taken where one leaves too many out."""
    if wanted != "auto":
        return (wanted,)
    return ("global", "incremental") if photos >= GLOBAL_FROM else ("incremental",)


@contextmanager
def _single_threaded_cv2() -> Iterator[None]:
    """OpenCV's own threads would fight over the cores with ours."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
