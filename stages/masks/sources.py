"""The ways to a mask, and which of them a capture takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.artifacts import Camera
from pipeline.errors import StageError, UsageError
from stages.masks.config import Method
from stages.masks.grabcut import INNER, OUTER, cut_by_region
from stages.masks.keying import Background, border_colours, find_background, key_out, key_out_plate
from stages.masks.matting import soft_edge
from stages.masks.region import F32, U8, Bool, Disc, resized
from stages.masks.segment_person import person_mask
from stages.masks.support_object import SupportedObject, cut_by_points
from stages.masks.user_model import UserModel, mask_by_model

LOOKED_AT = 12  # views from which the kind of background and subject is judged
PERSON_SHARE = 0.5  # of the middle of the region of interest that the network must call a person
PERSON_VIEWS = 0.9  # share of the views in which it must: it takes a statue for a person from some sides, but not all
TELLING, WRONG_SIDE = 0.02, 0.3  # share of the photo around the region; mean alpha that is all but empty
SOFT = 2  # pixels of the working size to which a cut-out contour is right


@dataclass(frozen=True, slots=True)
class View:
    """A photo to mask. read: its 8-bit sRGB (H, W, 3). given: reads its mask, alpha (H, W). plate: reads the
    same view without the subject."""

    index: int
    name: str
    camera: Camera
    disc: Disc
    holdout: bool
    read: Callable[[], U8]
    given: Callable[[], F32] | None
    plate: Callable[[], U8] | None = None

    def known(self, method: Method) -> bool:
        """Whether the user's own mask or clean plate says what is subject."""
        return (self.given is not None and method in ("auto", "given")) or (
            self.plate is not None and method in ("auto", "plate")
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """How views without a mask of their own are masked."""

    method: Literal["given", "plate", "key", "model", "person", "object", "grabcut"]
    background: Background | None = None
    solid: SupportedObject | None = None
    model: UserModel | None = None


def plan(
    views: Sequence[View], method: Method, threshold: float, working_size: int, seed: int,
    solid: Callable[[], SupportedObject | None] = lambda: None, model: UserModel | None = None,
) -> Plan:  # fmt: skip
    """Choose the way from a few of the views that are fitted. solid: looks for the object among the sparse points.
    model: the user's network, which goes before all guesses.

    Raises:
        StageError: masks, a uniform background or an object were asked for and are not there.
    """
    bare = [v for v in views if not v.known(method)]
    if method in ("given", "plate") and bare:
        what = "mask" if method == "given" else "clean plate"
        raise UsageError(f"views without a {what}", where=f"masks.method={method}",
                         value=", ".join(v.name for v in bare[:5]), limit=f"a {what} for every view",
                         remedy="add them, or use masks.method=auto")  # fmt: skip
    if not bare:
        return Plan("plate" if method == "plate" else "given")
    if model is not None and method == "auto":
        return Plan("model", model=model)
    fitted = [v for v in bare if not v.holdout] or bare
    some = fitted[:: -(-len(fitted) // LOOKED_AT)]
    images = [v.read() for v in some]
    if method in ("auto", "key"):
        background = find_background([border_colours(i) for i in images])
        if background is not None:
            return Plan("key", background)
        if method == "key":
            raise StageError("the background is not of one colour", where="masks.method=key",
                             value="the photos' borders differ in colour", limit="one colour around the subject, the "
                             "same in all photos", remedy="use masks.method=auto, or give masks")  # fmt: skip
    if method in ("person", "grabcut"):
        return Plan(method)
    if method == "object":
        return _by_points(solid())
    shares = [_person_share(i, v.disc, threshold, min(working_size, 320), seed)
              for i, v in zip(images, some, strict=True)]  # fmt: skip
    if np.quantile(shares, 1 - PERSON_VIEWS) >= PERSON_SHARE:
        return Plan("person")
    found = solid()
    if found is not None:
        return _by_points(found)
    return Plan("person" if np.median(shares) >= PERSON_SHARE else "grabcut")


def _by_points(solid: SupportedObject | None) -> Plan:
    if solid is None:
        raise StageError("no object is found among the sparse points", where="masks.method=object",
                         value="no points, or too few that hang together", limit="cameras solved from the photos "
                         "(poses.method=colmap) of an object with texture",
                         remedy="use masks.method=auto, or give masks")  # fmt: skip
    return Plan("object", solid=solid)


def _person_share(image: U8, disc: Disc, threshold: float, longest: int, seed: int) -> float:
    inside = person_mask(image, disc, threshold, longest, seed)
    middle = disc.scaled(inside.shape[1] / image.shape[1]).covers(inside.shape[0], inside.shape[1], 0.5)
    return float(inside[middle].mean()) if middle.any() else 0.0


def mask(view: View, how: Plan, threshold: float, working_size: int, seed: int) -> tuple[F32, str]:
    """Alpha (H, W) at the photo's size and where it is from. A given mask is handed on as it is.

    Raises:
        StageError: a given mask of the wrong size.
    """
    if view.given is not None:
        return view.given(), "given"
    image = view.read()
    if view.plate is not None:
        return key_out_plate(image, view.plate()), "plate"
    if how.method == "key" and how.background is not None:
        return key_out(image, how.background), "key"
    if how.method == "model" and how.model is not None:
        inside = mask_by_model(image, view.disc, how.model, threshold, working_size, seed)
        return to_full_size(image, inside), "model"
    if how.method == "object" and how.solid is not None:
        return to_full_size(image, cut_by_points(image, view.camera, how.solid, working_size, seed)), "object"
    if how.method == "person":
        return to_full_size(image, person_mask(image, view.disc, threshold, working_size, seed)), "person"
    return to_full_size(image, cut_by_region(image, view.disc, working_size, seed)), "grabcut"


def inverted(alpha: F32, disc: Disc) -> bool:
    """Whether a given mask shows the background: all but empty in the middle of the region of interest and all but
    full around it: beyond the region, and along the frame's upper edge and sides where a head has no neck. A subject
    that fills the frame is not empty in the middle."""
    h, w = alpha.shape
    core, around = disc.covers(h, w, INNER), ~disc.covers(h, w, OUTER)
    around[0], around[:, 0], around[:, -1] = True, True, True
    if not core.any() or around.mean() < TELLING:
        return False
    return bool(alpha[core].mean() < WRONG_SIDE and alpha[around].mean() > 1 - WRONG_SIDE)


def to_full_size(image: U8, inside: Bool) -> F32:
    """Alpha (H, W) of a photo from a hard mask of a smaller size: smooth contour, then the colours of its edge."""
    h, w = image.shape[:2]
    factor = w / inside.shape[1]
    hard = inside if factor == 1 else np.asarray(resized(inside.astype(np.float32), w, h), np.float32) >= 0.5
    return soft_edge(image, hard, max(2, min(12, round(SOFT * factor))))
