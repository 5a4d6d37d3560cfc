"""Held-out views from the fitted field, in the photo's own pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.fields.face import FaceModel
from stages.inverse_rendering.systems import render_any
from stages.inverse_rendering.views import PhotoView, image_rays

F32 = npt.NDArray[np.float32]


def predict_view(model: FaceModel, view: PhotoView, factor: int, samples: int, device: str) -> F32:
    """(H / factor, W / factor, 4) linear RGBA, premultiplied; the lens's distortion is in the rays.

    No calibration is applied: the colours are those of the mean response, A = I.
    """
    w, h = view.size[0] // factor, view.size[1] // factor
    colour, opacity = render_any(model, image_rays(view, factor, device), samples)
    rgba = np.concatenate([colour.cpu().numpy(), opacity.cpu().numpy()[:, None]], 1)
    return rgba.reshape(h, w, 4).astype(np.float32)
