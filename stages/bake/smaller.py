"""Fewer texels for a tile: each is the mean of the covered ones that it replaces.

A tile is baked at full size first, so that its texels do not miss what lies between their centres.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.meshes import Indices
from stages.bake.build import Baked, nearest_covered
from stages.bake.texels import Samples


def smaller(baked: Baked, factor: int, scratch: Path | None = None) -> Baked:
    """The tile with `factor` times fewer texels along a side. Its statistics stay those of the texels that were
    baked."""
    if factor == 1:
        return baked
    size = baked.size // factor
    row, column = np.divmod(baked.texel, baked.size)
    texel, group = np.unique(row // factor * size + column // factor, return_inverse=True)
    values = {f.name: _mean(getattr(baked.samples, f.name), group, len(texel)) for f in fields(Samples)}
    values["normal"] /= np.maximum(np.linalg.norm(values["normal"], axis=1, keepdims=True), 1e-6)
    values["landed"] = values["landed"] > 0.5
    nearest = nearest_covered(texel, size, scratch)
    return replace(baked, size=size, texel=_as(texel, baked.texel), samples=Samples(**values), nearest=nearest)


def _mean(values: npt.NDArray[Any], group: Indices, count: int) -> npt.NDArray[Any]:
    """Means of the rows of values (N,) or (N, C) in each of `count` groups."""
    share = 1 / np.bincount(group, minlength=count)
    planes = np.asarray(values, np.float32).reshape(len(values), -1).T
    means = [(np.bincount(group, plane, count) * share).astype(np.float32) for plane in planes]
    return np.stack(means, -1).reshape(count, *values.shape[1:])


def _as(texel: npt.NDArray[Any], like: Indices) -> Indices:
    return np.asarray(texel, like.dtype)
