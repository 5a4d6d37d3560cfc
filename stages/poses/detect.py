"""Features of photos and verified matches of pairs, on several threads, with progress and cancellation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from stages.poses.config import Config
from stages.poses.features import Effort, Features, detect, grey8
from stages.poses.matching import MIN_INLIERS, Pair, Verified, match, promising_pairs, verify

WORKERS = 2  # the result does not depend on it: each photo, and each pair, is a separate task
CHUNK = 64  # pairs between two checks for cancellation


class Photo(Protocol):
    """One photo with its focal length, if known, and its lens group. width, height: pixels."""

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
        """Equal for photos of one lens."""
        ...

    def pixels(self) -> npt.NDArray[np.generic]:
        """(H, W, C) as stored."""
        ...

    def inside(self) -> npt.NDArray[np.float32] | None:
        """(H, W) alpha of the subject, or None."""
        ...


Progress = Callable[[int, int, str], None]  # done, total, message; raises to stop


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
                progress(i, len(photos), "detecting features")
                found.append(task.result())
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return found


def match_all(
    photos: Sequence[Photo], features: Sequence[Features], config: Config, effort: Effort, progress: Progress,
    in_order: bool = False,
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches by pair of photos. in_order: the photos are in order, as frames of a video."""
    pairs = promising_pairs(features, effort.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"),
                            in_order)  # fmt: skip
    return match_pairs(photos, features, pairs, config, effort, progress)


def match_pairs(
    photos: Sequence[Photo], features: Sequence[Features], pairs: Sequence[Pair], config: Config, effort: Effort,
    progress: Progress, least: int = MIN_INLIERS,
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches of the given pairs. least: fewest that fit one fundamental matrix."""

    def one(pair: Pair) -> Verified | None:
        i, j = pair
        matches = match(features[i].descriptors, features[j].descriptors, effort.ratio)
        edge = max(photos[i].width, photos[i].height, photos[j].width, photos[j].height)
        return verify(features[i], features[j], matches, edge, config.seed, least)

    found = {}
    with _single_threaded_cv2(), ThreadPoolExecutor(WORKERS) as pool:
        for n in range(0, len(pairs), CHUNK):
            progress(n, len(pairs), "matching photos")
            some = pairs[n : n + CHUNK]
            found.update({p: v for p, v in zip(some, pool.map(one, some), strict=True) if v is not None})
    return found


@contextmanager
def _single_threaded_cv2() -> Iterator[None]:
    """Switch off OpenCV's threads, which would compete with this module's."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
