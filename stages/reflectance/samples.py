"""What every camera measured of every texel under every light: a memory-mapped table.

    y = radiance / (intensity e),    e = (axis . -l) / d^2

so that a white Lambertian texel has y = n.l / pi. Rows are those of `Pairs`, sorted by texel: the fit reads a run of
texels as one piece of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.images import F32, read_linear
from pipeline.meshes import Indices
from pipeline.transforms import F64
from stages.reflectance.rig import Rig
from stages.reflectance.texels import Pairs, Points

F16 = npt.NDArray[np.float16]
Step = Callable[[int, int, str], None]
LARGEST = 6e4  # half floats end at 65504


def gather(
    path: Path, points: Points, pairs: Pairs, rig: Rig, pictures: Mapping[tuple[int, int], Path], step: Step
) -> F16:
    """(P, L, 3) y in half floats, in the file `path`, which is kept if it is whole: a run that was stopped goes on.

    pictures: (place of the camera in the rig, place of the light) -> linear picture; NaN where there is none.
    Memory: one camera's rows at a time.
    """
    from stages.reflectance.sample_kernels import cubic

    shape, done = (len(pairs.texel), len(rig.index), 3), path.with_suffix(".done")
    if done.is_file() and done.read_text() == repr(shape):
        kept: F16 = np.load(path, mmap_mode="r", allow_pickle=False)
        return kept
    path.parent.mkdir(parents=True, exist_ok=True)
    table: F16 = np.lib.format.open_memmap(path, "w+", np.float16, shape)
    lamps, axes = rig.lamps()
    for c in range(len(rig.cameras)):
        rows = np.flatnonzero(pairs.camera == c)
        where = points.position[pairs.texel[rows]]
        own = np.full((len(rows), len(rig.index), 3), np.nan, np.float16)
        for i in range(len(rig.index)):
            if (c, i) not in pictures:
                continue
            step(c * len(rig.index) + i, len(rig.cameras) * len(rig.index), "samples")
            uv, _ = rig.pixels(c, i, where)
            values = np.empty((len(rows), 3), np.float32)
            cubic(read_linear(pictures[c, i]), uv, values)
            own[:, i] = np.clip(values / falling(where, lamps[i], axes[i], rig.strength[i]), -LARGEST, LARGEST)
        table[rows] = own
    done.write_text(repr(shape))
    return table


def falling(points: F64, lamp: F64, axis: F64, strength: F64) -> F64:
    """(N, 3) intensity e of a lamp at points (N, 3): what falls on a surface that faces it. At least a trifle, so that
    y stays finite behind the lamp."""
    away = points - lamp
    squared = (away**2).sum(1)
    forward = (away @ axis) / np.sqrt(squared)
    return np.asarray(np.maximum(forward / squared, 1e-9)[:, None] * strength, np.float64)


def part(table: F16, pairs: Pairs, texels: Indices) -> tuple[F32, Indices, F64, npt.NDArray[np.int32]]:
    """The rows of some texels, ascending: y (p, L, 3) in single precision, first (len(texels) + 1,), weight and camera
    (p,)."""
    counts = pairs.first[texels + 1] - pairs.first[texels]
    first = np.concatenate([[0], np.cumsum(counts)])
    rows = np.repeat(pairs.first[texels] - first[:-1], counts) + np.arange(first[-1])
    whole = len(rows) > 0 and rows[-1] - rows[0] == len(rows) - 1
    values = table[rows[0] : rows[-1] + 1] if whole else table[rows]
    return np.asarray(values, np.float32), first, pairs.weight[rows], pairs.camera[rows]
