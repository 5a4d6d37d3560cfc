"""The whole way from a field to a mesh: extract, keep one piece, land on the zero set, cut handles, check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Extent
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.meshes import F64, Faces, Mask, Mesh, Topology
from stages.surface import clean, extract
from stages.surface.clean import Landed
from stages.surface.extract import Step
from stages.surface.handles import Opened, without_handles
from stages.surface.repair import repaired
from stages.surface.trim import trimmed

LARGE_SECOND = 0.05  # area of a dropped piece over the kept one's, from which it is worth a warning
MOSTLY_CAP = 0.5  # of the area: more cap than that is a box and not a head

HANDLE = 0.1  # of the box's longest side: a handle with a shorter loop is a fault of the fit. Of a head, 4 cm

Sees = Callable[[Mesh], Mask]


@dataclass(frozen=True, slots=True)
class Built:
    """The finished mesh and what was found on the way. cell: lattice edge; cap: share of the area on the box; trimmed:
    share of the area that no photo saw and that was cut off; handles: how many were cut, and how many are left."""

    mesh: Mesh
    topology: Topology
    removed: int
    cell: float
    cap: float
    residual: float
    warnings: tuple[str, ...]
    trimmed: float = 0.0
    handles: tuple[int, int] = (0, 0)


def build(
    field: Field,
    resolution: int,
    step: Step,
    sees: Sees | None = None,
    handle: float = HANDLE,
    extent: Extent | None = None,
) -> Built:
    """Mesh the field's zero set with `resolution` cells along the box's longest side. `sees`: which vertices of a mesh
    photos see; the rest is cut off. `handle`: handles with a loop up to this share of that side are cut. `extent`: the
    mesh is closed there.

    Raises:
        StageError: no zero crossing, a solid that fills its box, or a mesh that can't be closed.
    """
    grid = extract.lattice(field, resolution, extent)
    vertices, faces = extract.extract(field, grid, step)
    vertices, faces, removed, second = clean.largest_component(vertices, faces)
    vertices, faces, found, repairs = _closed(vertices, faces)
    landed = clean.spread_degenerate(field, grid, clean.land(field, grid, vertices), faces)
    faces = clean.outward(landed.vertices, faces)
    area = meshes.areas(landed.vertices, faces)
    on_cap = landed.capped[faces].all(1)
    cap = float(area[on_cap].sum() / area.sum())
    if cap > MOSTLY_CAP:
        raise StageError(
            "the fitted solid fills its box",
            where="inverse_rendering",
            value=f"{cap:.0%} of the surface is the box itself",
            limit=f"at most {MOSTLY_CAP:.0%}",
            remedy="check the masks (is the background black?) and the region of interest",
        )
    free = landed.vertices[~landed.capped]
    residual = float(np.abs(field.sdf(free.astype(np.float32))).max(initial=0))
    mesh, handles = Mesh(landed.vertices.astype(np.float32), landed.normals, faces), (0, 0)
    if found.euler < 2:
        opened = without_handles(landed.vertices, faces, handle * float((grid.upper - grid.lower).max()))
        mesh, handles = _mended(landed, opened), (opened.cut, opened.left)
        found = meshes.topology(mesh.faces, len(mesh.vertices))
    warnings = _warnings(removed, second, repairs, handles[1])
    if sees is None:
        return Built(mesh, found, removed, grid.h, cap, residual, warnings, handles=handles)
    cut = trimmed(field, grid, mesh, sees(mesh))
    found = meshes.topology(cut.mesh.faces, len(cut.mesh.vertices))
    return Built(cut.mesh, found, removed, grid.h, cap, residual, warnings, cut.share, handles)


def _mended(landed: Landed, opened: Opened) -> Mesh:
    """The mesh with the field's normals, and its own where handles were cut and the zero set is elsewhere."""
    normals = meshes.vertex_normals(opened.vertices, opened.faces)
    kept = np.ones(len(normals), np.bool_)
    kept[opened.moved] = False
    still = np.flatnonzero(kept)
    normals[still] = landed.normals[still]
    return Mesh(opened.vertices.astype(np.float32), normals, opened.faces)


def _closed(vertices: F64, faces: Faces) -> tuple[F64, Faces, Topology, Topology | None]:
    """The mesh, its topology (moving vertices later does not change it), and what it was before a repair."""
    found = meshes.topology(faces, len(vertices))
    if found.manifold:
        return vertices, faces, found, None
    fixed_vertices, fixed_faces = repaired(vertices, faces, found)
    fixed_vertices, fixed_faces, _, _ = clean.largest_component(fixed_vertices, fixed_faces)
    now = meshes.topology(fixed_faces, len(fixed_vertices))
    if not now.manifold:
        raise StageError(
            "the surface can't be closed",
            where="surface",
            value=now,
            limit="a watertight manifold mesh",
            remedy="change surface.resolution a little, or fit for longer",
        )
    return fixed_vertices, fixed_faces, now, found


def _warnings(removed: int, second: float, repairs: Topology | None, handles: int) -> tuple[str, ...]:
    out = []
    if second > LARGE_SECOND:
        out.append(
            f"a second piece with {second:.0%} of the head's area was dropped (of {removed} pieces): look at the masks"
        )
    if repairs is not None:
        out.append(
            f"the mesh was repaired: {repairs.boundary_edges} open and {repairs.crowded_edges} crowded edges, "
            f"{repairs.pinched_vertices} pinched vertices"
        )
    if handles:
        out.append(f"{handles} handles are wider than surface.handle and were left: charts may be many")
    return tuple(out)
