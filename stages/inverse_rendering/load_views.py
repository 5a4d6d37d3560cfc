"""Loads photos, masks, labels and cameras as arrays for the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline import transforms
from pipeline.artifacts import Camera, CameraSet, FileRef, Located, MaskSet
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.images import read_alpha, read_encoded, read_linear, shrink_whole
from pipeline.polarised import specular
from stages.inverse_rendering.albedo_level import FACE
from stages.inverse_rendering.ray_sampling import F32, U8, Bool, PhotoView, factor_for


def read_views(
    capture: Located[Capture], poses: CameraSet, masks: Located[MaskSet], indices: list[int], side: int
) -> list[PhotoView]:
    """Photos, masks and cameras of some views, reduced by `shrunk` to about `side` pixels.

    Photos are divided by their exposures; per-image calibration refines this.
    """
    cameras = {c.index: c for c in poses.cameras}
    alphas = {m.index: m for m in masks.artifact.masks}
    photos = {v.index: v for v in capture.artifact.views}
    views = []
    for i in indices:
        c = cameras[i]
        rgb = read_linear(capture.path(photos[i].image)) / np.float32(photos[i].exposure)
        views.append(
            shrunk(
                PhotoView(
                    i,
                    rgb,
                    read_alpha(masks.path(alphas[i].mask)),
                    transforms.matrix(c.K),
                    transforms.matrix(c.world_from_cam),
                    np.array(c.distortion),
                    _clipped(capture, photos[i].clipped),
                    asked=_asked(masks, alphas[i].asked),
                    skin=_skin(masks, alphas[i].labels),
                    mirror=_mirror(capture, photos[i], rgb),
                ),
                side,
            )
        )
    return views


def read_labels(masks: Located[MaskSet], indices: list[int]) -> list[U8 | None]:
    """(H, W) label codes of some views, None for a view without labels."""
    files = {m.index: m.labels for m in masks.artifact.masks}
    found = (files.get(i) for i in indices)
    return [None if f is None else np.asarray(read_encoded(masks.path(f))[..., 0], np.uint8) for f in found]


def shrunk(view: PhotoView, side: int) -> PhotoView:
    """The view averaged over blocks to at most `side` (at least 1024) pixels, so that large photos fit in memory.

    Intrinsics scale with the image; distortion does not change.
    """
    f = factor_for(view.size, max(side, 1024))
    if f == 1:
        return view
    K = view.K.copy()
    K[:2] /= f
    clipped = None if view.clipped is None else shrink_whole(view.clipped, f)
    rgb, alpha = shrink_whole(view.rgb, f), shrink_whole(view.alpha, f)
    asked = None if view.asked is None else shrink_whole(view.asked, f)
    mirror = None if view.mirror is None else shrink_whole(view.mirror, f)
    skin = None if view.skin is None else shrink_whole(view.skin.astype(np.float32), f) == 1
    return replace(view, rgb=rgb, alpha=alpha, clipped=clipped, asked=asked, skin=skin, mirror=mirror, K=K)


def _clipped(capture: Located[Capture], file: FileRef | None) -> F32 | None:
    return None if file is None else read_alpha(capture.path(file))


def _asked(masks: Located[MaskSet], file: FileRef | None) -> F32 | None:
    return None if file is None else read_alpha(masks.path(file))


def _skin(masks: Located[MaskSet], file: FileRef | None) -> Bool | None:
    """Pixels with the label face, which excludes the eyes."""
    names = masks.artifact.label_names
    if file is None or FACE not in names:
        return None
    return np.asarray(read_encoded(masks.path(file))[..., 0] == names.index(FACE), np.bool_)


def _mirror(capture: Located[Capture], photo: CaptureView, rgb: F32) -> F32 | None:
    """The mirror reflection of a polarised pair, in the unit of its cross-polarised photo rgb (H, W, 3)."""
    if photo.parallel is None:
        return None
    return specular(
        rgb, read_linear(capture.path(photo.parallel)) / np.float32(photo.exposure), photo.parallel_exposure
    )


def camera_only(c: Camera) -> PhotoView:
    """A camera as a view without a photo: predictions do not read held-out photos."""
    empty = np.broadcast_to(np.zeros((), np.float32), (c.height, c.width, 3))
    return PhotoView(
        c.index,
        empty,
        empty[..., 0],
        transforms.matrix(c.K),
        transforms.matrix(c.world_from_cam),
        np.array(c.distortion),
    )
