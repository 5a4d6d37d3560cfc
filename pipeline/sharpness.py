"""How sharp a photo is, by a figure that photos of one capture can be compared with."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt


def detail(grey: npt.NDArray[np.uint8]) -> float:
    """Energy of the finest structures against that of ones a few times coarser: what a blur takes away.

    E[(I - G1 I)^2] / E[(G1 I - G4 I)^2], G a Gaussian of so many pixels; the ratio does not depend on contrast, and
    little on how much of the frame is plain.
    """
    image = grey.astype(np.float32)
    fine, coarse = (np.asarray(cv2.GaussianBlur(image, (0, 0), s), np.float32) for s in (1.0, 4.0))
    return float(np.square(image - fine).mean() / max(float(np.square(fine - coarse).mean()), 1e-3))
