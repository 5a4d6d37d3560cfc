"""From artifacts to arrays: photos, masks and cameras as the fit takes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline import transforms
from pipeline.artifacts import Camera, CameraSet, Capture, Located, MaskSet
from pipeline.images import read_alpha, read_linear, shrink
from stages.inverse_rendering.views import PhotoView, factor_for, whole_blocks


def read_views(
    capture: Located[Capture], poses: CameraSet, masks: Located[MaskSet], indices: list[int], side: int
) -> list[PhotoView]:
    """Photos, masks and cameras of some views, no larger than a whole number of blocks above `side`."""
    cameras = {c.index: c for c in poses.cameras}
    alphas = {m.index: m for m in masks.artifact.masks}
    photos = {v.index: v for v in capture.artifact.views}
    views = []
    for i in indices:
        c = cameras[i]
        views.append(
            shrunk(
                PhotoView(
                    i,
                    read_linear(capture.path(photos[i].image)),
                    read_alpha(masks.path(alphas[i].mask)),
                    transforms.matrix(c.K),
                    transforms.matrix(c.world_from_cam),
                    np.array(c.distortion),
                ),
                side,
            )
        )
    return views


def shrunk(view: PhotoView, side: int) -> PhotoView:
    """The view at the smallest whole-block size that still has `side` pixels, so that large photos fit in memory.

    Lens positions are kept exact: intrinsics scale with the image, distortion does not change.
    """
    f = factor_for(view.size, max(side, 1024))
    if f == 1:
        return view
    K = view.K.copy()
    K[:2] /= f
    return replace(view, rgb=shrink(whole_blocks(view.rgb, f), f), alpha=shrink(whole_blocks(view.alpha, f), f), K=K)


def camera_only(c: Camera) -> PhotoView:
    """A camera as a view without a photo: what a prediction may see of a held-out view."""
    empty = np.broadcast_to(np.zeros((), np.float32), (c.height, c.width, 3))
    return PhotoView(
        c.index,
        empty,
        empty[..., 0],
        transforms.matrix(c.K),
        transforms.matrix(c.world_from_cam),
        np.array(c.distortion),
    )
