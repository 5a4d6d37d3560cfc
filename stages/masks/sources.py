"""The segmentation methods, and the choice between them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.artifacts import Camera
from pipeline.errors import StageError, UsageError
from stages.masks.config import Method
from stages.masks.grabcut import INNER, OUTER, cut_by_region
from stages.masks.hull_consistency import opinions
from stages.masks.key_person import Network, agree_better, both, key_with_person, loses_a_person
from stages.masks.keying import Background, border_colours, find_background, key_out, key_out_plate, keyed
from stages.masks.loose_hair import with_loose_hair
from stages.masks.matting import soft_edge
from stages.masks.region import F32, U8, Bool, Disc, resized, working_size
from stages.masks.segment_person import of_subject, person_mask
from stages.masks.smooth_backdrop import corrected, shades
from stages.masks.support_object import SupportedObject, cut_by_points
from stages.masks.user_model import UserModel, mask_by_model

LOOKED_AT = 24  # views that are used for the choice: wrong masks of twelve can agree with each other
PERSON_SHARE = 0.5  # of the centre of the region of interest that the network must classify as person
PERSON_VIEWS = 0.9  # smallest share of such views: the network takes a statue for a person from some sides, but not all
BETTER = 0.05  # of IoU with the hull: an object's masks must agree by so much better than the network's
CHOICE_SIZE, CHOICE_CELLS = 320, 64  # pixels and voxels for the choice
MIN_AROUND, WRONG_SIDE = 0.02, 0.3  # smallest share of the photo around the region; mean alpha of a nearly empty area
KEY_AND_PERSON = "key+person"
COLOURLESS = 0.98  # alpha of a pixel that is the subject's, but whose colour is not: the fit uses those above 0.99
SOFT = 2  # pixels of the working size: accuracy of a segmented contour


@dataclass(frozen=True, slots=True)
class PhotoToMask:
    """A photo to segment. read: its 8-bit sRGB (H, W, 3). given: reads its given mask, alpha (H, W). plate: reads its
    clean plate (H, W, 3)."""

    index: int
    name: str
    camera: Camera
    disc: Disc
    holdout: bool
    read: Callable[[], U8]
    given: Callable[[], F32] | None
    plate: Callable[[], U8] | None = None

    def known(self, method: Method) -> bool:
        """Whether it has a given mask or a clean plate that `method` uses."""
        return (self.given is not None and method in ("auto", "given")) or (
            self.plate is not None and method in ("auto", "plate")
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """The segmentation method for views without a given mask, with its data. person: the network gives back what the
    key takes from a person. backdrop: a smooth one is behind the person in the photos, and corrects the network."""

    method: Literal["given", "plate", "key", "model", "person", "object", "grabcut"]
    background: Background | None = None
    person: bool = False
    backdrop: bool = False
    solid: SupportedObject | None = None
    model: UserModel | None = None


def plan(
    views: Sequence[PhotoToMask], method: Method, threshold: float, longest: int, seed: int, roi_radius: float,
    solid: Callable[[], SupportedObject | None] = lambda: None, model: UserModel | None = None,
) -> Plan:  # fmt: skip
    """Choose the method from a few of the fitted views. roi_radius: asset units. solid: finds the object among the
    sparse points. model: the user's network; `auto` prefers it to the methods from key on.

    Raises:
        UsageError: `method` needs masks or clean plates that are missing. StageError: `method` is key or object, and
            there is no uniform background or no object.
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
    if method in ("person", "grabcut"):
        return Plan(method)
    if method == "object":
        return _by_points(solid())
    fitted = [v for v in bare if not v.holdout] or bare
    some = fitted[:: -(-len(fitted) // LOOKED_AT)]
    colours, small = _looked_at(some, min(longest, CHOICE_SIZE))
    background = find_background(colours)
    if background is not None:
        network = Network(threshold, CHOICE_SIZE, seed)
        return Plan("key", background, method == "auto" and _person_helps(some, small, background, network, roi_radius))
    if method == "key":
        raise StageError("the background is not of one colour", where="masks.method=key",
                         value="the photos' borders differ in colour", limit="one colour around the subject, the "
                         "same in all photos", remedy="use masks.method=auto, or give masks")  # fmt: skip
    return _person_or_object(some, small, threshold, seed, solid)


def _looked_at(views: Sequence[PhotoToMask], longest: int) -> tuple[list[U8], list[U8]]:
    """Colours of each photo's border, and the photo reduced to `longest` pixels: one photo after the other, because
    large ones do not fit in memory."""
    colours, small = [], []
    for view in views:
        image = view.read()
        colours.append(border_colours(image))
        small.append(np.asarray(resized(image, *working_size(image.shape[1], image.shape[0], longest)), np.uint8))
    return colours, small


def _person_helps(
    views: Sequence[PhotoToMask], images: Sequence[U8], background: Background, network: Network, roi_radius: float
) -> bool:
    """Whether the key takes parts of a person in reduced photos (h, w, 3), and the masks agree better with them. An
    object that the network takes for a person loses nothing to a key of another colour."""
    discs = [v.disc.scaled(i.shape[1] / v.camera.width) for i, v in zip(images, views, strict=True)]
    alone = [keyed(i, background) for i in images]
    if not loses_a_person(images, discs, alone):
        return False
    helped = [both(i, d, o, network) for i, d, o in zip(images, discs, alone, strict=True)]
    return agree_better(*(_mean_iou(views, m, roi_radius) for m in (helped, alone)))


def _person_or_object(
    views: Sequence[PhotoToMask],
    images: Sequence[U8],
    threshold: float,
    seed: int,
    solid: Callable[[], SupportedObject | None],
) -> Plan:
    """By what the network says of reduced photos (h, w, 3), and by whose masks agree."""
    discs = [v.disc.scaled(i.shape[1] / v.camera.width) for i, v in zip(images, views, strict=True)]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        persons = list(pool.map(lambda i, disc: person_mask(i, disc, threshold, max(i.shape[:2]), seed), images, discs))
    shares = [_share_of_centre(p, v) for p, v in zip(persons, views, strict=True)]
    found = solid()
    if np.quantile(shares, 1 - PERSON_VIEWS) >= PERSON_SHARE:
        person = found is None or not _agrees_better(found, views, images, persons, seed)
        return Plan("person", backdrop=_before_backdrop(images, persons)) if person else _by_points(found)
    if found is not None:
        return _by_points(found)
    return Plan("person" if np.median(shares) >= PERSON_SHARE else "grabcut")


def _before_backdrop(images: Sequence[U8], persons: Sequence[Bool]) -> bool:
    """Whether a smooth backdrop is behind the person (h, w) in nearly all photos (h, w, 3)."""
    left = (1 - PERSON_VIEWS) * len(images) + 1e-9  # photos that may have none
    for image, person in zip(images, persons, strict=True):
        found = shades(image, person)
        left -= found is None or not found.is_backdrop
        if left < 0:  # as in every room: the other photos need not be asked
            return False
    return True


def _by_points(solid: SupportedObject | None) -> Plan:
    if solid is None:
        raise StageError("no object is found among the sparse points", where="masks.method=object",
                         value="no points, or too few connected ones", limit="cameras solved from the photos "
                         "(poses.method=colmap) of an object with texture",
                         remedy="use masks.method=auto, or give masks")  # fmt: skip
    return Plan("object", solid=solid)


def _share_of_centre(inside: Bool, view: PhotoToMask) -> float:
    """Share of the centre of the region of interest that a mask (h, w) covers."""
    centre = view.disc.scaled(inside.shape[1] / view.camera.width).covers(inside.shape[0], inside.shape[1], 0.5)
    return float(inside[centre].mean()) if centre.any() else 0.0


def _agrees_better(
    solid: SupportedObject, views: Sequence[PhotoToMask], images: Sequence[U8], persons: Sequence[Bool], seed: int
) -> bool:
    """Whether the masks of an object agree clearly better with each other than the network's (h, w).

    A network that takes a skull, or the carved hair of a statue, for a person is sure of itself in nearly every photo;
    its masks still contradict each other.
    """
    cuts = [cut_by_points(i, v.camera, solid, max(i.shape[:2]), seed) for i, v in zip(images, views, strict=True)]
    of_object, of_person = (_mean_iou(views, m, solid.roi_radius) for m in (cuts, persons))
    return of_object > of_person + BETTER


def _mean_iou(views: Sequence[PhotoToMask], masks: Sequence[Bool], roi_radius: float) -> float:
    """Mean over the views of the IoU of a mask (h, w) with the visual hull of all."""
    alphas = [m.astype(np.float32) for m in masks]
    found = opinions([v.camera for v in views], alphas, [True] * len(views), roi_radius, CHOICE_CELLS)
    return float(np.mean([o.iou or 0.0 for o in found]))


def mask(view: PhotoToMask, how: Plan, threshold: float, longest: int, seed: int) -> tuple[F32, str]:
    """Alpha (H, W) at the photo's size, and the method. A given mask is returned unchanged.

    Raises:
        StageError: a given mask of the wrong size.
    """
    if view.given is not None:
        return view.given(), "given"
    image = view.read()
    if view.plate is not None:
        return key_out_plate(image, view.plate()), "plate"
    if how.method == "key" and how.background is not None:
        if how.person:
            network = Network(threshold, longest, seed)
            return key_with_person(image, view.disc, how.background, network), KEY_AND_PERSON
        return key_out(image, how.background), "key"
    if how.method == "model" and how.model is not None:
        inside = mask_by_model(image, view.disc, how.model, threshold, longest, seed)
        return person_alpha(image, inside, view.disc), "model"
    if how.method == "object" and how.solid is not None:
        return to_full_size(image, cut_by_points(image, view.camera, how.solid, longest, seed)), "object"
    if how.method == "person":
        inside = person_mask(image, view.disc, threshold, longest, seed)
        if how.backdrop:
            inside = _against_backdrop(image, inside, view)
        return person_alpha(image, inside, view.disc), "person"
    return to_full_size(image, cut_by_region(image, view.disc, longest, seed)), "grabcut"


def _against_backdrop(image: U8, inside: Bool, view: PhotoToMask) -> Bool:
    """A network's mask (h, w) corrected by a smooth backdrop. image: (H, W, 3) 8-bit sRGB."""
    h, w = inside.shape
    small = np.asarray(resized(image, w, h), np.uint8)
    return of_subject(corrected(small, inside), view.disc.scaled(w / image.shape[1]))


def inverted(alpha: F32, disc: Disc) -> bool:
    """Whether a given mask (H, W) is white on the background: nearly empty in the centre of the region of interest and
    nearly full around it, that is, beyond the region and along the frame's upper edge and sides, where there is no
    neck. The mask of a subject that fills the frame is not empty in the centre."""
    h, w = alpha.shape
    core, around = disc.covers(h, w, INNER), ~disc.covers(h, w, OUTER)
    around[0], around[:, 0], around[:, -1] = True, True, True
    if not core.any() or around.mean() < MIN_AROUND:
        return False
    return bool(alpha[core].mean() < WRONG_SIDE and alpha[around].mean() > 1 - WRONG_SIDE)


def to_full_size(image: U8, inside: Bool) -> F32:
    """Alpha (H, W) of a photo (H, W, 3) from a smaller hard mask (h, w): enlarged, then matted at the edge."""
    h, w = image.shape[:2]
    factor = w / inside.shape[1]
    hard = inside if factor == 1 else np.asarray(resized(inside.astype(np.float32), w, h), np.float32) >= 0.5
    return soft_edge(image, hard, max(2, min(12, round(SOFT * factor))))


def person_alpha(image: U8, inside: Bool, disc: Disc) -> F32:
    """Alpha (H, W) of a photo (H, W, 3) from a person's smaller hard mask (h, w): without the gaps in loose hair, and
    below 1 where the wall shines through hair, so that its colour is not used."""
    h, w = inside.shape
    small = np.asarray(resized(image, w, h), np.uint8)
    left, mixed = with_loose_hair(small, inside, disc.scaled(w / image.shape[1]))
    alpha = to_full_size(image, left)
    if not mixed.any():
        return alpha
    zone = np.asarray(resized(mixed.astype(np.float32), image.shape[1], image.shape[0])) >= 0.5
    return np.where(zone, np.minimum(alpha, np.float32(COLOURLESS)), alpha)
