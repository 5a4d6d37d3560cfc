"""A light that was measured, as spherical harmonics.

    L_lm = integral over the sphere of L(d) Y_lm(d)           a lat-long picture of radiance
         = sum_i e_i Y_lm(l_i)                                distant lamps

Symbols
    Y_lm     real, orthonormal, index l (l + 1) + m (pipeline/maths/sh.py)
    l_i      unit direction towards lamp i; e_i its irradiance on a surface that faces it
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pipeline.errors import StageError
from pipeline.images import F32, read_linear
from pipeline.lighting.median_cut import checked_environment
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.maths.sh import count, sh_basis
from pipeline.transforms import F64

FORMATS = (".exr", ".hdr")
RUN = 65_536  # pixels at once


def read_latlong(path: Path) -> F32:
    """(H, 2 H, 3) radiance of a lat-long file. Raises StageError if there is none, or it is no such picture, is black,
    or has values that are negative or not a number."""
    if path.suffix.lower() not in FORMATS or not path.is_file():
        raise StageError(
            "this light can't be read",
            where=path,
            value="no such file" if not path.is_file() else f"a {path.suffix or 'nameless'} file",
            limit=f"a file {' or '.join(FORMATS)}",
            remedy="give an equirectangular picture of the light, linear",
        )
    return checked_environment(read_linear(path), str(path))


def sh_of_latlong(image: F32, order: int, to_world: F64) -> F64:
    """((order + 1)^2, 3) coefficients of a picture (H, 2 H, 3) in a frame of its own. to_world (3, 3): rotation of that
    frame's directions into those of the picture. By quadrature: the midpoint of each pixel times its solid angle.
    [NeuFace eq. 2]"""
    height, width = image.shape[:2]
    directions = latlong_directions(width, height).reshape(-1, 3) @ to_world
    flux = (image[..., :3].astype(np.float64) * latlong_weights(width, height)[..., None]).reshape(-1, 3)
    out = np.zeros((count(order), 3))
    for start in range(0, len(flux), RUN):
        run = slice(start, start + RUN)
        out += sh_of_lamps(directions[run], flux[run], order)
    return out


def sh_of_lamps(directions: F64, irradiance: F64, order: int) -> F64:
    """((order + 1)^2, 3) coefficients of distant lamps: unit directions (N, 3) towards them, irradiance (N, 3).
    [NeuFace eq. 2]"""
    basis = sh_basis(torch.from_numpy(np.ascontiguousarray(directions, np.float64)), order).numpy()
    return np.asarray(basis.T @ irradiance, np.float64)
