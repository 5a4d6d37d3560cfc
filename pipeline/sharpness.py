"""Sharpness of a photo, comparable between photos of one capture."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt


def detail(grey: npt.NDArray[np.uint8]) -> float:
    """Energy of the finest structures over that of a few times coarser ones, in a grey photo (H, W). Blur lowers it.

    E[(I - G1 I)^2] / E[(G1 I - G4 I)^2], Gn a Gaussian of n pixels. The ratio does not depend on contrast, and hardly
    on the share of uniform areas.
    """
    image = grey.astype(np.float32)
    fine, coarse = (np.asarray(cv2.GaussianBlur(image, (0, 0), s), np.float32) for s in (1.0, 4.0))
    return float(np.square(image - fine).mean() / max(float(np.square(fine - coarse).mean()), 1e-3))
