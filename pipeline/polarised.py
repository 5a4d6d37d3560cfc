"""What the two photos of a polarised pair show. This is the only home of the factors.

The lamps' light is linearly polarised. Light that entered the skin comes out unpolarised, and a filter before the lens
passes half of it at every angle. The mirror reflection stays polarised: a filter that is parallel to the light passes
it, a crossed one stops it. [Debevec et al. 2000, Acquiring the Reflectance Field of a Human Face, section 4]

    X = D / 2                 cross
    P = D / 2 + S             parallel
    S = P - X,  D = 2 X,  D + S = P + X

Symbols
    D, S    diffuse and specular radiance of the same light without filters
    e       exposure of P over that of X; P is divided by it

The fit sees X, so its light is half of the true one. In its unit the mirror reflection is (P - X) / 2, and what a
camera without a filter shows is (P + X) / 2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.images import F32, read_linear

SHARE = 0.5  # of the unpolarised light that a filter passes


def specular(cross: npt.NDArray[Any], parallel: npt.NDArray[Any], exposure: float = 1.0) -> npt.NDArray[Any]:
    """(..., 3) mirror reflection in the unit of the cross-polarised photo: S / 2. It has the photos' noise, and may be
    negative. cross, parallel (..., 3) linear; exposure: e."""
    return np.asarray((parallel / exposure - cross) * SHARE, cross.dtype)


def unpolarised(cross: F32, parallel: F32, exposure: float = 1.0) -> F32:
    """(..., 3) what a camera without a filter shows, in the unit of the cross-polarised photo: (D + S) / 2."""
    out: F32 = (parallel / exposure + cross) * SHARE
    return out


def read_unpolarised(photo: Path, parallel: Path | None, exposure: float = 1.0) -> F32:
    """(H, W, 3) linear picture of a view without filters; a view without a pair as it is."""
    own = read_linear(photo)
    return own if parallel is None else unpolarised(own, read_linear(parallel), exposure)
