"""A person before a uniform background: the network gives back what the colour key takes from the person.

A highlight on dark skin, grey cloth or grey hair may have the backdrop's colour and reach the contour: then the key
takes it for background, and the forehead is gone. The network sees a person there. Its contour is less accurate, so
that the key's mask is kept, and only parts with some width that it lacks are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.masks.keying import EDGE, Background, keyed
from stages.masks.matting import soft_edge
from stages.masks.region import F32, U8, Bool, Disc, resized, thick
from stages.masks.segment_person import of_subject, person_mask, person_probability

SURE = 0.9  # probability from which the network is sure of a person
LOST = 0.01  # share of that in any photo which the key takes: below it the network is not asked further
BETTER = 0.001  # of mean IoU with the hull, by which the masks with the person must agree better than the key's own
AGREED = 0.9  # mean IoU that they must reach at least: see agree_better
THIN = 2  # pixels of the working size: what the key lacks and is thinner is a difference of two contours


@dataclass(frozen=True, slots=True)
class Network:
    """How the person is segmented: see stages.masks.segment_person.person_mask."""

    threshold: float
    longest: int
    seed: int


def loses_a_person(images: Sequence[U8], discs: Sequence[Disc], own: Sequence[Bool]) -> bool:
    """Whether in any photo the key takes parts of what the network is sure to be a person. images: (h, w, 3) 8-bit
    sRGB. discs: region of interest in each. own: the key's hard masks (h, w)."""
    return any(_lost(i, d, o) > LOST for i, d, o in zip(images, discs, own, strict=True))


def agree_better(helped: float, alone: float) -> bool:
    """Whether the key's masks with the person (mean IoU with their hull) agree well, and better than those alone. Masks
    that contradict each other even so come from wrong cameras: then no agreement tells which are right."""
    return helped >= AGREED and helped > alone + BETTER


def _lost(image: U8, disc: Disc, own: Bool) -> float:
    sure = person_probability(image, disc)[0] >= SURE
    return float((sure & ~own).sum() / max(int(sure.sum()), 1))


def both(image: U8, disc: Disc, own: Bool, how: Network) -> Bool:
    """Hard mask (H, W) of the key, own (H, W), and of the person's parts that it lacks. image: (H, W, 3) 8-bit sRGB."""
    small = person_mask(image, disc, how.threshold, how.longest, how.seed)
    person = np.asarray(resized(small.astype(np.float32), own.shape[1], own.shape[0])) >= 0.5
    radius = max(1, round(THIN * own.shape[1] / small.shape[1]))
    return of_subject(own | thick(person & ~own, radius), disc)


def key_with_person(image: U8, disc: Disc, background: Background, how: Network) -> F32:
    """Alpha (H, W) of the subject in (H, W, 3) 8-bit sRGB."""
    return soft_edge(image, both(image, disc, keyed(image, background), how), EDGE)
