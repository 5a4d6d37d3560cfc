"""A picture of a running fit: one fitted photo, and beside it what the model makes of that view now.

It is rendered without random numbers and without gradients, in a random state of its own: a fit has the same bytes with
pictures and without.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
import torch

from pipeline.colour import srgb_from_linear
from pipeline.contract import Show
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.ray_sampling import PhotoView, factor_for, image_rays
from stages.inverse_rendering.systems import render_any

U8 = npt.NDArray[np.uint8]
F32 = npt.NDArray[np.float32]
NAME = "fit"
SIDE = 192  # pixels: most of the rendered picture's longer side
SHOWN = 384  # pixels: longer side on the screen
SAMPLES = 4  # along a ray
GREY = 0.12  # linear, behind the subject


class Preview:
    """Shows the view that looks at the subject from the front, if somebody watches."""

    def __init__(self, views: Sequence[PhotoView], show: Show, device: str) -> None:
        self.view, self.show, self.device = frontal(views), show, device

    def __call__(self, model: FaceModel) -> float:
        """Seconds that it took."""
        return self.show(NAME, lambda: self.picture(model))

    def picture(self, model: FaceModel) -> U8:
        """(H, 2 W, 3): photo and model."""
        factor = factor_for(self.view.size, SIDE)
        w, h = self.view.size[0] // factor, self.view.size[1] // factor
        with torch.random.fork_rng(devices=[]):
            colour, opacity = render_any(model, image_rays(self.view, factor, self.device), SAMPLES)
        shown = (colour + (1 - opacity[:, None]) * GREY).cpu().numpy().reshape(h, w, 3)
        photo = np.asarray(cv2.resize(self.view.rgb, (w, h), interpolation=cv2.INTER_AREA), np.float32)
        return np.concatenate([_picture(photo), _picture(shown)], 1)


def frontal(views: Sequence[PhotoView]) -> PhotoView:
    """The view whose camera stands nearest to the front (+Z) of the subject, as seen from the origin."""
    places = np.array([v.world_from_cam[:3, 3] for v in views])
    return views[int(np.argmax(places[:, 2] / np.maximum(np.linalg.norm(places, axis=1), 1e-9)))]


def _picture(linear: F32) -> U8:
    """8-bit sRGB, at the size on the screen."""
    encoded = srgb_from_linear(np.nan_to_num(linear).clip(0, 1)) * 255
    factor = SHOWN / max(encoded.shape[:2])
    size = (max(1, round(encoded.shape[1] * factor)), max(1, round(encoded.shape[0] * factor)))
    return np.asarray(cv2.resize(encoded.round().astype(np.uint8), size, interpolation=cv2.INTER_LINEAR), np.uint8)
