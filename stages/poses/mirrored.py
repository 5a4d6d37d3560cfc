"""Detection of mirror images: photos whose features match only after a horizontal flip.

Phones save photos of the front camera as mirror images. Only photos without a camera, or that contradict their given
camera, are checked, each against a few others: a fraction of a second per photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stages.poses.epipolar_check import features_of
from stages.poses.features import PLAIN, Features
from stages.poses.matching import match, verify
from stages.poses.photos import StoredPhoto

MAX_SUSPECTS, PARTNERS = 12, 12  # photos checked, and photos that each is compared with
CLEAR, MANY = 2.0, 25  # fewest matches of the flipped picture: relative to those of the photo itself; absolute


@dataclass(frozen=True, slots=True)
class Flipped:
    """A photo flipped horizontally."""

    photo: StoredPhoto

    @property
    def width(self) -> int:
        """Pixels."""
        return self.photo.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.photo.height

    def pixels(self) -> npt.NDArray[np.generic]:
        """(H, W, C)."""
        return np.ascontiguousarray(self.photo.pixels()[:, ::-1])

    def inside(self) -> npt.NDArray[np.float32] | None:
        """(H, W) alpha of the subject, or None."""
        alpha = self.photo.inside()
        return None if alpha is None else np.ascontiguousarray(alpha[:, ::-1])


def find_mirrored(photos: Sequence[StoredPhoto], suspects: Sequence[int], fine: Sequence[int], seed: int) -> list[int]:
    """Which of the `suspects` match the photos `fine` only when flipped. Both are indices into `photos`."""
    checked = list(suspects)[:MAX_SUSPECTS]
    partners = list(fine)[:: max(1, -(-len(fine) // PARTNERS))]
    if not checked or not partners:
        return []
    near = features_of([photos[i] for i in partners], _silent)
    own = features_of([photos[i] for i in checked], _silent)
    turned = features_of([Flipped(photos[i]) for i in checked], _silent)
    out = []
    for i, plain, flipped in zip(checked, own, turned, strict=True):
        edge = max(photos[i].width, photos[i].height)
        best, other = (max(_agreeing(f, n, edge, seed) for n in near) for f in (flipped, plain))
        if best >= max(MANY, CLEAR * other):
            out.append(i)
    return out


def _agreeing(a: Features, b: Features, edge: int, seed: int) -> int:
    """Number of geometrically verified matches."""
    pair = verify(a, b, match(a.descriptors, b.descriptors, PLAIN.ratio), edge, seed)
    return 0 if pair is None else len(pair.matches)


def _silent(done: int, total: int) -> None:
    """No progress: it takes a second."""
