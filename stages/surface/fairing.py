"""Surface that no photo shows is made fair: as smooth as its surroundings allow.

Behind a head that was photographed from the front, the fit leaves what its start was: knobs of the visual hull, tunnels
between hair and neck, edges of the box. On a coarse grid the signed distance is smoothed there, ROUNDS times:

    phi <- phi + b (F phi - phi),    F = 1 / (1 + (l |k|)^4)

Symbols
    phi     signed distance at the nodes, negative inside
    F       low pass of fourth order; |k| in radians a length, the box's borders are mirrors. A plane stays as it is and
            a sphere nearly so; waves much shorter than 2 pi l vanish
    l       the length of the setting
    open    nodes outside of the surface that a camera looks into
    shown   open nodes beside the surface where the camera's photo shows the subject, without specks
    b       0 up to NEAR cells from shown nodes, 1 from l further on: surface that photos show stays as it was

Open nodes more than a cell outside stay empty, however deep a hollow is. A knob that a camera sees where its photo
shows a wall is not shown. The faired values replace the field's as b says.
Source: the implicit fairing of Desbrun et al. (1999), for distances instead of vertices, so that tunnels close.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import fft, ndimage

from pipeline.artifacts import Extent
from pipeline.fields.faired import Faired
from pipeline.fields.protocol import Field
from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import F64, Mask, Mesh
from pipeline.visibility import Occluder
from stages.surface.extract import Lattice, Step, extract, lattice

CELLS = 128  # along the box's longest side
BESIDE = 1.5  # cells: nodes up to this far outside lie beside the surface
KNOWN = 2.0  # cells from the surface, up to which the field's own values are distances
NEAR = 2.0  # cells: the surface lies up to BESIDE from a shown node, and is to keep its slope too
ROUNDS = 4
SPECK, AROUND = 0.25, 2.0  # share of the nodes beside the surface that are shown, and cells (deviation) around one

Looked = Callable[[Occluder, F64], tuple[Mask, Mask]]


def low_pass(values: F64, length: float) -> F64:
    """F phi (X, Y, Z) of values at nodes (X, Y, Z). length: l >= 0, in cells; 0 changes nothing."""
    k = [np.pi * np.arange(n) / n for n in values.shape]
    square = k[0][:, None, None] ** 2 + k[1][:, None] ** 2 + k[2] ** 2
    waves = fft.dctn(values, workers=-1) / (1 + (length**2 * square) ** 2)
    return np.asarray(fft.idctn(waves, workers=-1), np.float64)


def faired(field: Field, share: float, looked: Looked, step: Step, extent: Extent | None = None) -> Field:
    """The field with a fair surface where no photo shows it; the same one where photos show all of it, or nothing.

    share: l, of the box's longest side. looked: which points (N, 3) a camera looks into, that is, which it has in its
    frame with nothing of a mesh before it, and where its photo shows the subject there. extent: cuts the solid.

    Raises:
        StageError: the field has no surface, or is not finite.
    """
    grid = lattice(field, CELLS, extent)
    vertices, faces = extract(field, grid, step)
    rough = Occluder(Mesh(vertices.astype(np.float32), np.zeros((len(vertices), 3), np.float32), faces))
    lower, cell, length, nodes = grid.lower, grid.h, share * CELLS * grid.h, _nodes(grid)
    inner = np.clip(nodes, lower, grid.upper).reshape(-1, 3).astype(np.float32)
    first = _distances(field.sdf(inner).reshape(nodes.shape[:3]).astype(np.float64), cell)
    beside = (first > 0) & (first < BESIDE * cell)

    def marked(where: Mask) -> tuple[Mask, Mask]:
        found = np.zeros((2, *where.shape), np.bool_)
        found[:, where] = looked(rough, nodes[where])
        return found[0], found[1]

    opened, shown = marked(beside)
    shown &= _share_around(shown, beside) >= SPECK
    if not shown.any():
        return field
    away = np.asarray(ndimage.distance_transform_edt(~shown), np.float64) * cell
    b = smoothstep(away, NEAR * cell, NEAR * cell + length)
    if not b[np.abs(first) < BESIDE * cell].any():
        return field
    phi, asked = first, beside
    for _ in range(ROUNDS):
        phi = phi + b * (low_pass(phi, length / cell) - phi)
        new = (first > 0) & (phi < cell) & (b > 0) & ~asked
        asked, opened = asked | new, opened | marked(new)[0]
        phi = np.where(opened, np.maximum(phi, first - cell), phi)
    return Faired(field, lower, cell, phi.astype(np.float32), b.astype(np.float32))


def _nodes(grid: Lattice) -> F64:
    """(X, Y, Z, 3) nodes of the lattice up to the first beyond the box."""
    counts = np.ceil(np.round((grid.upper - grid.lower) / grid.h, 6)).astype(int) + 1
    return np.asarray(grid.lower + grid.h * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1))


def _distances(value: F64, cell: float) -> F64:
    """Signed distances (X, Y, Z) from a field's values: its own next to the surface, of voxels further away."""
    inside = value < 0
    outer, inner = (ndimage.distance_transform_edt(x) - 0.5 for x in (~inside, inside))
    far = np.where(inside, -inner, outer) * cell
    return np.where(np.abs(far) > KNOWN * cell, far, np.clip(value, -KNOWN * cell, KNOWN * cell))


def _share_around(shown: Mask, of: Mask) -> F64:
    """(X, Y, Z) share of the nodes `of` around each node that are `shown`, weighted by a Gaussian."""
    near, every = (ndimage.gaussian_filter(x.astype(np.float64), AROUND, mode="constant") for x in (shown, of))
    return np.asarray(near / np.maximum(every, 1e-9), np.float64)
