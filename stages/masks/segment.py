"""Masks for all views of a capture: segmentation, consistency check, second segmentation, and dropping of wrong
masks."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipeline.artifacts import Camera, CameraSet, Extent, Located, MaskSet, ViewMask
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.extent import head_extent
from pipeline.faces.find import Face
from pipeline.faces.labels import LABELS
from pipeline.faces.landmarks3d import head_frame
from pipeline.images import read_alpha, write_png
from pipeline.meshes import F64
from pipeline.needed_parts import needed_parts
from pipeline.support import Support
from stages.masks import beyond_hull
from stages.masks.complete_mask import completed
from stages.masks.config import Config
from stages.masks.extent import MAX_OPEN, asked, cut_by_head, kept_whole, outline_points, whole_hull
from stages.masks.face_labels import labels_with, subjects_face
from stages.masks.grabcut import cut
from stages.masks.hull_consistency import POSSIBLE, Opinion, contradiction, hole, lacking, opinions, outliers, trimap
from stages.masks.hull_votes import Votes, beyond_all, contradicting, votes_of
from stages.masks.judge import Seen, extent_finding, judge, open_share
from stages.masks.landmarks import agreed, save_landmarks
from stages.masks.photos import at_once, photos_of
from stages.masks.region import F32, U8, Bool, Disc, resized, working_size
from stages.masks.segment_person import of_subject, settled
from stages.masks.sources import KEY_AND_PERSON, PhotoToMask, Plan, inverted, mask, person_alpha, plan, to_full_size
from stages.masks.support_object import distinct, object_of
from stages.masks.user_model import UserModel, hair_model, user_model

WORKING_SIZE = 640  # pixels, longest edge at which people and objects are segmented
MIN_AGREEMENT = 0.8  # smallest IoU of a mask and the hull of all masks, in the region of interest
MAX_DEVIATION = 0.05  # IoU below the median from which a mask may be an outlier
LIMITS = 0.001, 0.999  # mean alpha of a mask that is neither empty nor full
SMALL = 512  # pixels, longest edge of the masks for the consistency check
CONTRADICTED = 0.007  # share of a mask's area from which the view is segmented again
HOLE = 0.001  # the same for a hole: one in a single mask makes a tunnel through the subject
FEWEST = 3  # views that must remain
INVERTED = "given, inverted"
BY_HULL = "+hull"  # appended to the method of a mask that was corrected by the hull
KEYED = ("key", KEY_AND_PERSON)
LEARNED = ("model", "person")  # methods with a network's contour
COMPUTED = ("plate", "model", "person", "object", "grabcut")  # methods whose masks the hull may contradict
Labelled = tuple[Path, tuple[str, ...]]
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Masked:
    """A view's mask: reduced (h, w) in memory, full size in a file. coverage: mean alpha. iou: with the hull.
    doubtful: (h, w) what it lacks and the other masks need; None if nothing."""

    view: PhotoToMask
    camera: Camera
    small: F32
    source: str
    coverage: float
    iou: float | None = None
    doubtful: Bool | None = None

    @property
    def carving(self) -> F32:
        """The mask (h, w) that carves a hull: not where it lacks what the other masks need."""
        return self.small if self.doubtful is None else np.where(self.doubtful, np.float32(1), self.small)

    @property
    def useless(self) -> bool:
        """Whether it is empty or full."""
        return not LIMITS[0] <= self.coverage <= LIMITS[1]


@dataclass(frozen=True, slots=True)
class FaceResult:
    """The face in a photo, and the file of its labels with the names of the labels in it."""

    face: Face | None = None
    labels: Labelled | None = None


def segment(
    capture: Located[Capture], located: Located[CameraSet], config: Config, context: Context
) -> MaskSet:  # fmt: skip
    """Masks of all registered views: the whole stage. See stages.masks.stage.run."""
    poses = located.artifact
    pairs = photos_of(capture, poses, context.check)
    threads = at_once(capture.artifact.views, os.cpu_count() or 1)
    how = plan([v for v, _ in pairs], config.method, config.threshold, WORKING_SIZE, config.seed,
               poses.roi_radius, lambda: object_of(located, config.seed), user_model(config))  # fmt: skip
    context.log.info("masks: %s", how.method)
    masked = _each(lambda p: _make(p[0], p[1], how, config, context), pairs, threads, context, "masking")
    warnings = [f"view {m.view.index} ({m.view.name}): its mask is black on the subject and was inverted; save it "
                "white on the subject" for m in masked if m.source == INVERTED]  # fmt: skip
    voting = [not m.view.holdout and not m.useless for m in masked]
    _enough(sum(voting), len(masked), warnings)
    support = how.solid.support if how.solid is not None else None
    if config.resegment:
        masked = _with_needed_parts(masked, voting, poses.roi_radius, threads, config, context)
    found = _opinions(masked, voting, poses, config, support)
    masked = [replace(m, iou=o.iou) for m, o in zip(masked, found, strict=True)]
    first = _seen(masked, [])
    if config.resegment and _agreement(masked) >= MIN_AGREEMENT:  # else the hull knows no better than the masks
        bad = [a or _wrong_held_out(m) for a, m in zip(_outliers(masked), masked, strict=True)]
        corrected = _each(lambda t: _segment_again(t[0], t[1], t[2], config, context),
                          list(zip(masked, found, bad, strict=True)), threads, context, "checking masks")  # fmt: skip
        corrected = _without_background(corrected, poses.roi_radius, support, threads, context)
        if any(a is not b for a, b in zip(corrected, masked, strict=True)):
            voting = [not m.view.holdout and not m.useless for m in corrected]
            found = _opinions(corrected, voting, poses, config, support)
            corrected = [replace(m, iou=o.iou) for m, o in zip(corrected, found, strict=True)]
        masked = corrected
    dropped = _dropped(masked, warnings)
    faces = [FaceResult()] * len(masked)
    if config.faces:
        hair = hair_model(config)
        faces = _each(lambda m: _find_face(m, hair, context), masked, threads, context, "detecting faces")
    fitted = [(m.camera, x.face) for m, x in zip(masked, faces, strict=True)
              if x.face is not None and not m.view.holdout and m.view.index not in dropped]  # fmt: skip
    found_face = agreed(fitted)
    landmarks = None if found_face is None else save_landmarks(found_face, context)
    # a subject that is segmented as an object is an object, even with a face
    people = found_face is not None and how.method != "object"
    frame = head_frame(found_face.face.xyz) if found_face is not None and people else None
    votes = [m for m in masked if not m.view.holdout and not m.useless and m.view.index not in set(dropped)]
    whole = frame is None or kept_whole([m.camera for m in votes], [m.small for m in votes], frame, poses.roi_radius)
    extent = None if frame is None or whole else head_extent(frame)
    face = None if found_face is None else found_face.face.xyz
    showing = {m.view.index for m, x in zip(masked, faces, strict=True) if x.face is not None}
    parts = _asked(masked, votes, extent, face, showing, poses.roi_radius, threads, context)
    masks = tuple(_manifest(m, x.labels, parts.get(m.view.index), context) for m, x in zip(masked, faces, strict=True))
    findings = judge(_seen(masked, dropped), first, poses.roi_radius, poses.metric,
                     sum("face" in m.labelled for m in masks))  # fmt: skip
    if how.method != "object":
        agreeing = 0 if found_face is None else int(found_face.face.kept.sum())
        known = extent_finding(len(fitted), agreeing, extent is not None)
        findings = findings if known is None else (*findings, known)
    return MaskSet(masks=masks, label_names=LABELS, dropped=tuple(dropped), landmarks=landmarks, extent=extent,
                   warnings=tuple(warnings), findings=findings)  # fmt: skip


def _seen(masked: list[Masked], dropped: list[int]) -> list[Seen]:
    """The masks as input of the checks."""
    return [Seen(m.view.name, m.camera, m.small, m.source, m.coverage, None if m.useless else m.iou, m.view.holdout,
                 m.view.index in dropped) for m in masked]  # fmt: skip


def _asked(
    masked: list[Masked],
    votes: list[Masked],
    extent: Extent | None,
    face: F64 | None,
    showing: set[int],
    roi_radius: float,
    threads: int,
    context: Context,
) -> dict[int, Path]:
    """Files of the pixels that count, by view index; only for views in which not all pixels count. face (468, 3):
    landmarks. showing: indices of the views with a detected face."""
    if extent is None:
        return {}
    cameras = [m.camera for m in votes]
    hull = whole_hull(cameras, [m.small for m in votes], extent)
    if face is not None and open_share(hull, roi_radius) > MAX_OPEN:
        hull = cut_by_head(hull, cameras, face)
    points = outline_points(hull, extent)

    def one(m: Masked) -> tuple[int, Path | None]:
        part = asked(m.camera, read_alpha(_path(m.view.index, context)), extent, points,
                     m.view.index in showing)  # fmt: skip
        path = context.workdir / "asked" / f"{m.view.index}.png"
        if part is not None:
            write_png(path, part)
        return m.view.index, None if part is None else path

    found = _each(one, masked, threads, context, "computing the extent")
    return {index: path for index, path in found if path is not None}


def _each(work: Callable[[T], R], items: list[T], threads: int, context: Context, message: str) -> list[R]:
    """`work` on every item in a thread pool, results in order; OpenCV releases Python's lock."""
    out: list[R] = []
    pool = ThreadPoolExecutor(threads)
    try:
        for done, result in enumerate(pool.map(work, items)):
            context.check()
            context.progress(done + 1, len(items), message)
            out.append(result)
    finally:
        pool.shutdown(cancel_futures=True)
    return out


def _make(view: PhotoToMask, camera: Camera, how: Plan, config: Config, context: Context) -> Masked:
    use = replace(view, given=view.given if config.method in ("auto", "given") else None,
                  plate=view.plate if config.method in ("auto", "plate") else None)  # fmt: skip
    alpha, source = mask(use, how, config.threshold, WORKING_SIZE, config.seed)
    if source == "given" and inverted(alpha, view.disc):
        alpha, source = 1 - alpha, INVERTED
    return _keep(use, camera, alpha, source, context)


def _keep(view: PhotoToMask, camera: Camera, alpha: F32, source: str, context: Context) -> Masked:
    write_png(_path(view.index, context), alpha)
    w, h = working_size(alpha.shape[1], alpha.shape[0], SMALL)
    return Masked(view, camera, np.asarray(resized(alpha, w, h), np.float32), source, float(alpha.mean()))


def _path(index: int, context: Context) -> Path:
    return context.workdir / "masks" / f"{index}.png"


def _with_needed_parts(
    masked: list[Masked], voting: list[bool], roi_radius: float, threads: int, config: Config, context: Context
) -> list[Masked]:
    """The masks with the parts that they lack and most others need; where the colours do not tell, the mask stays, and
    does not carve there."""
    needed = needed_parts([m.camera for m in masked], [m.small for m in masked], voting, roi_radius)

    def one(item: tuple[int, Masked]) -> Masked:
        n, m = item
        part, name = needed.parts.get(n), m.source
        if part is None or needed.hull is None or name not in COMPUTED:
            return m
        image = m.view.read()
        w, h = working_size(image.shape[1], image.shape[0], WORKING_SIZE)
        small = np.asarray(resized(image, w, h), np.uint8)
        inside, lost = (np.asarray(resized(x.astype(np.float32), w, h)) >= 0.5 for x in (m.small >= 0.5, part))
        new = completed(small, inside, lost, needed.hull, m.camera, config.seed)
        if new is None:
            return replace(m, doubtful=part)
        new = _tidied(small, new, name, m.view.disc.scaled(w / image.shape[1]))
        return _keep(m.view, m.camera, _alpha(image, new, name, m.view.disc), name + BY_HULL, context)

    return _each(one, list(enumerate(masked)), threads, context, "completing masks") if needed.parts else masked


def _opinions(
    masked: list[Masked], voting: list[bool], poses: CameraSet, config: Config, support: Support | None
) -> list[Opinion]:
    return opinions([m.camera for m in masked], [m.carving for m in masked], voting, poses.roi_radius,
                    config.hull_cells, support)  # fmt: skip


def _outliers(masked: list[Masked]) -> list[bool]:
    """Which fitted views are outliers; held-out ones are never."""
    ious = [None if m.view.holdout or m.useless else m.iou for m in masked]
    found = outliers(ious, MIN_AGREEMENT, MAX_DEVIATION)
    return [f or (m.useless and not m.view.holdout) for f, m in zip(found, masked, strict=True)]


def _wrong_held_out(m: Masked) -> bool:
    """Whether a held-out view's mask is nothing like the hull of the fitted ones. Less may be the hull's own fault."""
    return m.view.holdout and not m.useless and m.iou is not None and m.iou < MIN_AGREEMENT


def _segment_again(made: Masked, opinion: Opinion, bad: bool, config: Config, context: Context) -> Masked:
    """The view with a new mask if the hull contradicts the old one; unchanged if the new one is no better. bad: it is
    an outlier, or held out and wrong. Of a held-out view only that counts, and the hull is its limit, not its shape:
    the hull is carved without it, and wrong by what fitted masks lack."""
    inside, filled = made.small >= 0.5, bad and not made.view.holdout
    if made.source in ("given", INVERTED) or (made.source in KEYED and made.useless):
        return made  # a photo of background only has no subject to segment
    share = lacking(inside, opinion) if made.view.holdout else contradiction(inside, opinion, filled=filled)
    doubtful = made.source in COMPUTED and (
        share > CONTRADICTED or (not made.view.holdout and hole(inside, opinion) > HOLE)
    )
    if not (bad or doubtful):
        return made
    image = made.view.read()
    w, h = working_size(image.shape[1], image.shape[0], WORKING_SIZE)
    opinion_here = opinion.at_size(w, h)
    prior = np.asarray(resized(made.small, w, h)) >= 0.5
    small = np.asarray(resized(image, w, h), np.uint8)
    shown = distinct(small) if made.source == "object" else small
    new = cut(shown, trimap(prior, opinion_here, filled=filled), config.seed)
    new = _tidied(small, new, made.source, made.view.disc.scaled(w / image.shape[1]))
    before, after = (contradiction(m, opinion_here, filled=filled) + hole(m, opinion_here) for m in (prior, new))
    if after >= before or not LIMITS[0] <= new.mean() <= LIMITS[1]:
        return made
    return _keep(made.view, made.camera, _alpha(image, new, made.source, made.view.disc), made.source + BY_HULL,
                 context)  # fmt: skip


def _tidied(small: U8, new: Bool, source: str, disc: Disc) -> Bool:
    """A new mask (h, w), finished like the one of its method. small: (h, w, 3) 8-bit sRGB."""
    return of_subject(settled(small, new) if source in LEARNED else new, disc)


def _alpha(image: U8, new: Bool, source: str, disc: Disc) -> F32:
    """Alpha (H, W) from a new hard mask (h, w), as its method makes it. image: (H, W, 3) 8-bit sRGB."""
    return person_alpha(image, new, disc) if source in LEARNED else to_full_size(image, new)


def _without_background(
    masked: list[Masked], roi_radius: float, support: Support | None, threads: int, context: Context
) -> list[Masked]:
    """The masks without what lies beyond the hull of all and is background; see beyond_hull."""
    voting = [not m.view.holdout and not m.useless for m in masked]
    votes = votes_of([m.camera for m in masked], [m.carving for m in masked], voting)
    return _each(partial(_cut, votes, roi_radius, support, context), list(enumerate(masked)), threads, context,
                 "cutting off background")  # fmt: skip


def _cut(
    votes: Votes, roi_radius: float, support: Support | None, context: Context, item: tuple[int, Masked]
) -> Masked:
    """The view's mask without the background beyond the hull; unchanged if there is none, or if the user gave it."""
    number, m = item
    name = m.source.removesuffix(BY_HULL)
    if name not in COMPUTED or m.useless:
        return m
    h, w = m.small.shape
    own = m.small >= 0.5
    here = m.view.disc.scaled(w / m.camera.width).covers(h, w, POSSIBLE)
    outer = beyond_all(votes, number, m.camera, own & here, roi_radius, support)
    if not beyond_hull.beyond(own, outer):
        return m
    share = contradicting(votes, number, m.camera, outer, roi_radius, support)
    image = m.view.read()
    w, h = working_size(image.shape[1], image.shape[0], WORKING_SIZE)
    inside, beyond = (np.asarray(resized(x.astype(np.float32), w, h)) >= 0.5 for x in (m.small, outer))
    small = np.asarray(resized(image, w, h), np.uint8)
    found = beyond_hull.background(small, inside, beyond, np.asarray(resized(share, w, h), np.float32),
                                   beyond_hull.many(len(votes.numbers)))  # fmt: skip
    if not found.any() or (inside & ~found).mean() < LIMITS[0]:
        return m
    alpha = beyond_hull.cut(read_alpha(_path(m.view.index, context)), image, inside, found)
    return _keep(m.view, m.camera, alpha, name + BY_HULL, context)


def _agreement(masked: list[Masked]) -> float:
    """Median over the fitted views of the IoU with the hull; 0 if none is known."""
    known = [m.iou for m in masked if m.iou is not None and not m.view.holdout]
    return float(np.median(known)) if known else 0.0


def _dropped(masked: list[Masked], warnings: list[str]) -> list[int]:
    median = _agreement(masked)
    if median < MIN_AGREEMENT:
        warnings.append(f"masks and cameras agree poorly: median IoU with the visual hull {median:.2f}, expected at "
                        f"least {MIN_AGREEMENT:.2f}; check the masks and the cameras")  # fmt: skip
    out = []
    for m, bad in zip(masked, _outliers(masked), strict=True):
        name = f"view {m.view.index} ({m.view.name})"
        if bad:
            out.append(m.view.index)
            why = "is empty or full" if m.useless else f"has IoU {m.iou:.2f} with the other views' hull"
            warnings.append(f"{name} is not fitted: its mask {why} (median IoU {median:.2f})")
        elif (m.view.holdout and m.useless) or _wrong_held_out(m):
            warnings.append(f"{name} is held out and its mask may be wrong: IoU {m.iou or 0:.2f} with the fitted "
                            f"views' hull (median {median:.2f})")  # fmt: skip
    _enough(sum(not m.view.holdout for m in masked) - len(out), len(masked), warnings)
    return out


def _enough(left: int, views: int, warnings: list[str]) -> None:
    if left < FEWEST:
        raise StageError("too few views have a mask that agrees with the others", where="masks",
                         value=f"{left} of {views}; {'; '.join(warnings) or 'no usable masks'}",
                         limit=f"at least {FEWEST} views to fit", remedy="check the listed photos; give masks, or "
                         "choose another masks.method")  # fmt: skip


def _find_face(m: Masked, hair: UserModel | None, context: Context) -> FaceResult:
    """The subject's face in a photo, and the file of its labels if it shows face or hair."""
    image, alpha = m.view.read(), read_alpha(_path(m.view.index, context))
    face = subjects_face(image, alpha, m.view.disc)
    labels = labels_with(face, image, alpha, m.view.disc, hair)
    if labels is None:
        return FaceResult(face)
    path = context.workdir / "labels" / f"{m.view.index}.png"
    write_png(path, labels / 255)
    return FaceResult(face, (path, tuple(LABELS[i] for i in np.unique(labels) if i)))


def _manifest(m: Masked, labels: Labelled | None, part: Path | None, context: Context) -> ViewMask:
    return ViewMask(index=m.view.index, mask=context.file(_path(m.view.index, context)), source=m.source,
                    coverage=round(m.coverage, 6), hull_iou=None if m.iou is None else round(m.iou, 4),
                    labels=None if labels is None else context.file(labels[0]),
                    labelled=() if labels is None else labels[1],
                    asked=None if part is None else context.file(part))  # fmt: skip
