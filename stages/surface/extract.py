"""Marching cubes on the lattice cells near the surface, slab by slab, to limit the memory.

Symbols
    h       edge of a lattice cell
    block   BLOCK^3 cells; only blocks that the surface may cross are evaluated
    slab    block layers along x that are in memory at one time
    g       max(sdf, wall) near the walls: the field's box and the subject's extent cut the solid, so that the neck gets
            a flat cap

Vertices of neighbouring slabs are merged if they lie on the same lattice edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Extent
from pipeline.errors import StageError
from pipeline.extent import MESH, signed, signed_and_gradient
from pipeline.fields.protocol import Field
from pipeline.meshes import F32, F64, Faces, Indices, Mask

BLOCK = 4  # cells: small blocks follow the surface, large ones need fewer coarse samples; 4 is best at 256
SLAB_NODES = 24_000_000  # 100 MB of float32, and about three times that inside marching cubes
QUERY = 1_000_000  # points in one call of the field
SAFETY = (1.2, 3.0, 8.0)  # largest slope of the SDF (1 for an exact distance), tried in turn
SNAP = 0.02  # of h: values nearer to zero are moved to +-SNAP, so that no vertex lies on a lattice node
INSET = 0.5  # of h: the cap lies this far inside the box, between two layers of nodes

Step = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Lattice:
    """Nodes at lower + h * index, index < shape. `blocks`: blocks along each axis; shape = blocks * BLOCK + 1. extent:
    it cuts the solid as the box does."""

    lower: F64
    upper: F64
    h: float
    blocks: tuple[int, int, int]
    extent: Extent | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along each axis."""
        x, y, z = self.blocks
        return x * BLOCK + 1, y * BLOCK + 1, z * BLOCK + 1


def lattice(field: Field, resolution: int, extent: Extent | None = None) -> Lattice:
    """A lattice over the field's box with `resolution` cells along its longest side; other sides are rounded up."""
    lower, upper = (np.asarray(b, np.float64) for b in field.bounds)
    sides = upper - lower
    if not np.all(np.isfinite(sides)) or sides.min() <= 0:
        raise StageError(
            "the fitted field has no volume",
            where="bounds of the field",
            value=(lower, upper),
            limit="a box with positive, finite sides",
            remedy="fit the model again",
        )
    h = float(sides.max()) / resolution
    x, y, z = (int(n) for n in np.ceil(np.round(sides / h / BLOCK, 6)))
    return Lattice(lower, upper, h, (x, y, z), extent)


def extract(field: Field, grid: Lattice, step: Step) -> tuple[F64, Faces]:
    """Vertices (V, 3) on lattice edges and outward faces (F, 3) of the zero set of g.

    Raises:
        StageError: the SDF has no zero in the box, or is not finite.
    """
    coarse = _coarse(field, grid)
    if coarse.min() >= 0 and not (coarse < np.sqrt(3) * BLOCK * grid.h).any():
        raise _no_surface(coarse)
    for safety in SAFETY:
        found = _march(field, grid, near_blocks(coarse, grid.h * safety), coarse, step)
        if found is not None:
            break
    else:
        found = _march(field, grid, np.ones(grid.blocks, np.bool_), coarse, step)
    if found is None or len(found[1]) == 0:
        raise _no_surface(coarse)
    return found


def wall_distance(points: F64, grid: Lattice) -> tuple[F64, F64]:
    """Distance (N,) of points (N, 3) to the inset box and the subject's extent, negative inside both, and its gradient
    (N, 3). It is the distance to the nearest of the box's six planes and the extent's surfaces."""
    sides = np.concatenate([grid.lower + INSET * grid.h - points, points - grid.upper + INSET * grid.h], 1)
    box, slope = sides.max(1), np.concatenate([-np.eye(3), np.eye(3)])[sides.argmax(1)]
    if grid.extent is None:
        return box, slope
    beyond, away = signed_and_gradient(grid.extent, points, MESH * grid.extent.head)
    return np.maximum(box, beyond), np.where((beyond > box)[:, None], away, slope)


def _wall(points: F64, grid: Lattice) -> F64:
    """The distances (N,) of `wall_distance` alone, several times faster."""
    low, high = grid.lower + INSET * grid.h, grid.upper - INSET * grid.h
    out = np.maximum(low[0] - points[:, 0], points[:, 0] - high[0])
    for i in (1, 2):
        np.maximum(out, low[i] - points[:, i], out=out)
        np.maximum(out, points[:, i] - high[i], out=out)
    if grid.extent is not None:
        np.maximum(out, signed(grid.extent, points, MESH * grid.extent.head), out=out)
    return np.asarray(out, np.float64)


def cut(value: npt.NDArray[np.floating], wall: F64, grid: Lattice) -> F64:
    """(N,) g: the larger of SDF (N,) and wall distance (N,) within a cell of the wall, elsewhere the SDF alone.

    Deep inside, an SDF with a slope above 1 is below the wall distance, so that the maximum would ignore it.
    """
    out: F64 = np.where(wall > -grid.h, np.maximum(value, wall), value)
    return out


def near_blocks(coarse: F32, reach: float) -> Mask:
    """(bx, by, bz): blocks that the surface may cross, from SDF values at the blocks' corners (bx + 1, ...).

    No point of a block is further than half its diagonal from its nearest corner. So a distance has no zero in a block
    whose corners all exceed that. `reach` is h times a factor for fields with a slope above 1.
    """
    eight = [
        coarse[i : i + coarse.shape[0] - 1, j : j + coarse.shape[1] - 1, k : k + coarse.shape[2] - 1]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    least, signs = np.abs(eight[0]), (eight[0] < 0).astype(np.int8)
    for corner in eight[1:]:
        least, signs = np.minimum(least, np.abs(corner)), signs + (corner < 0).astype(np.int8)
    out: Mask = (least < 0.5 * np.sqrt(3) * BLOCK * reach) | ((signs > 0) & (signs < 8))
    return out


def solid(field: Field, points: F64, grid: Lattice) -> F32:
    """(N,) values of g at points (N, 3). Points outside the box take the SDF of the nearest point of the box."""
    out = np.empty(len(points), np.float32)
    for start in range(0, len(points), QUERY):
        p = points[start : start + QUERY]
        value = field.sdf(np.clip(p, grid.lower, grid.upper).astype(np.float32))
        if not np.isfinite(value).all():
            raise StageError(
                "the SDF is not finite",
                where="fitted field",
                value=f"{(~np.isfinite(value)).sum()} of {len(value)} samples",
                limit="finite everywhere",
                remedy="fit the model again with another seed or a smaller learning rate",
            )
        out[start : start + QUERY] = cut(value, _wall(p, grid), grid)
    return out


def _coarse(field: Field, grid: Lattice) -> F32:
    axes = [grid.lower[i] + grid.h * BLOCK * np.arange(n + 1) for i, n in enumerate(grid.blocks)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return solid(field, points, grid).reshape([n + 1 for n in grid.blocks])


def _no_surface(coarse: F32) -> StageError:
    return StageError(
        "the fitted field has no surface",
        where="inverse_rendering",
        value=f"SDF between {coarse.min():.4g} and {coarse.max():.4g} in the box",
        limit="values of both signs",
        remedy="check the masks and cameras (the report shows both), or fit for longer",
    )


def _march(field: Field, grid: Lattice, near: Mask, coarse: F32, step: Step) -> tuple[F64, Faces] | None:
    """All slabs, merged. None if the surface leaves the near blocks, so that more of them are needed."""
    layer = grid.shape[1] * grid.shape[2] * BLOCK
    run = max(1, SLAB_NODES // layer)
    vertices: list[F64] = []
    keys: list[Indices] = []
    faces: list[Indices] = []
    offset = 0
    for first in range(0, grid.blocks[0], run):
        last = min(first + run, grid.blocks[0])
        step(first, grid.blocks[0])
        if not near[first:last].any():
            continue
        values, known = _slab(field, grid, near[first:last], coarse[first : last + 1], first)
        if _leaves(values, known):
            return None
        v, f = _marching_cubes(values)
        v[:, 0] += first * BLOCK
        vertices.append(v)
        keys.append(edge_keys(v, grid.shape))
        faces.append(f + offset)
        offset += len(v)
    if not vertices:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    welded, joined = weld(np.concatenate(vertices), np.concatenate(keys), np.concatenate(faces))
    return grid.lower + grid.h * welded, joined


def _slab(field: Field, grid: Lattice, near: Mask, coarse: F32, first: int) -> tuple[F32, Mask]:
    """Values of g on the nodes of some block layers, and which were evaluated. Of the others only the sign is right."""
    shape = tuple(n * BLOCK + 1 for n in near.shape)
    known = np.zeros(shape, np.bool_)
    for i, j, k in np.argwhere(near):
        known[i * BLOCK : (i + 1) * BLOCK + 1, j * BLOCK : (j + 1) * BLOCK + 1, k * BLOCK : (k + 1) * BLOCK + 1] = True
    nearest = [(np.arange(n) + BLOCK // 2) // BLOCK for n in shape]
    far = np.where(coarse < 0, -BLOCK * grid.h, BLOCK * grid.h).astype(np.float32)
    values = far[np.ix_(*nearest)]
    index = np.argwhere(known)
    points = grid.lower + grid.h * (index + [first * BLOCK, 0, 0])
    sampled = solid(field, points, grid)
    smallest = np.float32(SNAP * grid.h)
    values[known] = np.where(np.abs(sampled) < smallest, np.where(sampled < 0, -smallest, smallest), sampled)
    return values, known


def _leaves(values: F32, known: Mask) -> bool:
    """Whether the sign changes along a lattice edge with an end that was not evaluated: a false surface."""
    inside = values < 0
    for axis in range(3):
        a, b = (
            tuple(slice(s, n - 1 + s) if i == axis else slice(None) for i, n in enumerate(values.shape)) for s in (0, 1)
        )
        if ((inside[a] != inside[b]) & ~(known[a] & known[b])).any():
            return True
    return False


def _marching_cubes(values: F32) -> tuple[F64, Indices]:
    """(V, 3) in cells, and faces (F, 3) whose right-handed normals point towards positive values."""
    from skimage.measure import marching_cubes

    if not (values.min() < 0 < values.max()):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    # "descent" gives outward faces for values that grow outwards; the tests check this
    v, f, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")  # type: ignore[no-untyped-call]
    return v.astype(np.float64), f.astype(np.int64)


def edge_keys(v: F64, shape: tuple[int, int, int]) -> Indices:
    """(V,) one number for the lattice edge (or the cell's inside) that each vertex lies in.

    v: (V, 3) in cells. On an edge two coordinates are integers; a vertex inside a cell has none. SNAP keeps the third
    coordinate well away from integers.
    """
    low = np.floor(v + 1e-4)
    broken = (np.abs(v - np.round(v)) > 1e-4) @ np.array([1, 2, 4])
    i = low.astype(np.int64)
    out: Indices = ((i[:, 0] * shape[1] + i[:, 1]) * shape[2] + i[:, 2]) * 8 + broken
    return out


def weld(vertices: F64, keys: npt.NDArray[np.int64], faces: Indices) -> tuple[F64, Faces]:
    """Merge vertices (V, 3) with equal keys (V,); faces (F, 3) that lose a corner are dropped."""
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    f = inverse.reshape(-1)[faces]
    whole = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    return vertices[first], f[whole].astype(np.int32)
