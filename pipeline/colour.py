"""The only place where colour spaces are converted.

Radiance, albedo and every mean or sum of them are linear Rec.709. sRGB encoding is used in 8- and 16-bit files, and in
losses and metrics that model human perception.

Symbols: primaries and white as chromaticities (x, y); XYZ with Y = 1 for white.

Source: IEC 61966-2-1; SMPTE RP 177 (matrix of a set of primaries); Lam 1985 (Bradford adaptation); AMPAS S-2014-004
(ACEScg).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T")  # numpy.ndarray or torch.Tensor, any shape

LUMA = (0.2126, 0.7152, 0.0722)  # luminance of linear Rec.709
LUMA_OF_ENCODED = (0.299, 0.587, 0.114)  # Rec.601 luma of encoded values, as OpenCV's grey: for feature detectors
Chromaticities = tuple[float, float, float, float, float, float, float, float]  # x, y of red, green, blue, white
REC709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ACESCG: Chromaticities = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))


def _namespace(x: Any) -> Any:
    if isinstance(x, np.ndarray | float | np.floating):
        return np
    import torch

    return torch


def srgb_from_linear(x: T) -> T:
    """Encode linear values of any shape. Domain: all reals; [0, 1] maps to [0, 1], negative values use the linear part.

    Not clamped, so that a loss keeps its gradient above 1. The argument of the power is kept above the linear part,
    because the power's derivative at 0 is infinite and would reach the gradient through `where`.
    """
    xp: Any = _namespace(x)
    v: Any = x
    high = xp.clip(v, 0.0031308, None) if xp is np else v.clamp(min=0.0031308)
    out: T = xp.where(v <= 0.0031308, 12.92 * v, 1.055 * high ** (1 / 2.4) - 0.055)
    return out


def linear_from_srgb(x: T) -> T:
    """Decode sRGB values of any shape; inverse of `srgb_from_linear` on all reals."""
    xp: Any = _namespace(x)
    v: Any = x
    high = xp.clip(v, 0.04045, None) if xp is np else v.clamp(min=0.04045)
    out: T = xp.where(v <= 0.04045, v / 12.92, ((high + 0.055) / 1.055) ** 2.4)
    return out


def acescg_from_linear(x: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """(..., 3) ACEScg of linear Rec.709 (..., 3), with adaptation of the white."""
    return np.asarray(np.asarray(x, np.float64) @ rgb_from_rgb(ACESCG, REC709).T, np.float32)


def rgb_from_rgb(to: Chromaticities, origin: Chromaticities) -> npt.NDArray[np.float64]:
    """(3, 3) from one set of primaries to another, with Bradford adaptation of the white.

    M = N_to^-1 . B^-1 diag(B w_to / B w_from) B . N_from
    """
    bradford = np.array(BRADFORD)
    cone_to, cone_from = (bradford @ _xyz(c[6], c[7]) for c in (to, origin))
    adapt = np.linalg.inv(bradford) @ np.diag(cone_to / cone_from) @ bradford
    return np.asarray(np.linalg.inv(_xyz_from_rgb(to)) @ adapt @ _xyz_from_rgb(origin), np.float64)


def _xyz(x: float, y: float) -> npt.NDArray[np.float64]:
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _xyz_from_rgb(c: Chromaticities) -> npt.NDArray[np.float64]:
    """(3, 3): the columns are the primaries, scaled so that their sum is white."""
    columns = np.stack([_xyz(*c[i : i + 2]) for i in (0, 2, 4)], 1)
    return np.asarray(columns * np.linalg.solve(columns, _xyz(c[6], c[7])), np.float64)


def as_photographed(rgba: npt.NDArray[np.float32], response: Sequence[Sequence[float]]) -> npt.NDArray[np.float32]:
    """Linear RGBA (..., 4) after a camera's colour response, rows of a 3 x 3 matrix."""
    out = np.array(rgba, np.float32)
    out[..., :3] = rgba[..., :3] @ np.asarray(response, np.float32).T
    return out
