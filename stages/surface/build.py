"""From a field to a mesh: extract, keep one component, project onto the zero set, cut handles, check."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline import meshes
from pipeline.artifacts import Extent
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.meshes import F64, Faces, Mask, Mesh, Topology
from stages.surface import clean, extract
from stages.surface.clean import Kept, Landed
from stages.surface.extract import Step
from stages.surface.handles import Opened, without_handles
from stages.surface.pieces import Votes
from stages.surface.repair import repaired
from stages.surface.thin import thin_share
from stages.surface.trim import trimmed

log = logging.getLogger("neuface.surface")
LARGE_SECOND = 0.05  # of the kept component's area: a larger component that was dropped causes a warning
HANDLE = 0.1  # of the box's longest side: a handle with a shorter loop is an error of the fit. For a head, 4 cm

Sees = Callable[[Mesh], Mask]


@dataclass(frozen=True, slots=True)
class Built:
    """The finished mesh and its figures. cell: lattice edge; cap: share of the area on the box or the extent; trimmed:
    share of the area that no photo saw and that was cut off; handles: number cut, and number left; unshown: share of
    the visible surface that was on dropped components; thin: share of the area on flakes and needles; must_close: the
    mesh must not have a border."""

    mesh: Mesh
    topology: Topology
    removed: int
    cell: float
    cap: float
    residual: float
    warnings: tuple[str, ...]
    trimmed: float = 0.0
    handles: tuple[int, int] = (0, 0)
    unshown: float = 0.0
    thin: float = 0.0
    must_close: bool = True


def build(
    field: Field,
    resolution: int,
    step: Step,
    sees: Sees | None = None,
    handle: float = HANDLE,
    vote: Votes | None = None,
    extent: Extent | None = None,
) -> Built:
    """Mesh the field's zero set with `resolution` cells along the box's longest side. `sees`: returns which vertices of
    a mesh the photos see; the rest is cut off. `handle`: handles with a loop up to this share of that side are cut.
    `vote`: how much the photos show of each component; without it the largest is kept. `extent`: closes the mesh.

    A mesh that can't be closed is returned open, and one that is mostly cap is returned as it is: the checks of the
    stage grade them.

    Raises:
        StageError: the field has no zero crossing.
    """
    grid = extract.lattice(field, resolution, extent)
    kept = clean.one_piece(*extract.extract(field, grid, step), vote)
    vertices, faces, found, repairs = _closed(kept.vertices, kept.faces)
    landed = clean.spread_degenerate(field, grid, clean.land(field, grid, vertices), faces)
    faces = clean.outward(landed.vertices, faces)
    area = meshes.areas(landed.vertices, faces)
    on_cap = landed.capped[faces].all(1)
    cap = float(area[on_cap].sum() / area.sum())
    free = landed.vertices[~landed.capped]
    residual = float(np.abs(field.sdf(free.astype(np.float32))).max(initial=0)) if len(free) else 0.0
    mesh, handles = Mesh(landed.vertices.astype(np.float32), landed.normals, faces), (0, 0)
    if found.manifold and found.euler < 2:
        opened = without_handles(landed.vertices, faces, handle * float((grid.upper - grid.lower).max()))
        mesh, handles = _mended(landed, opened), (opened.cut, opened.left)
        found = meshes.topology(mesh.faces, len(mesh.vertices))
    warnings = _warnings(kept, repairs, handles[1])
    built = Built(mesh, found, kept.removed, grid.h, cap, residual, warnings, handles=handles, unshown=kept.unshown)
    if sees is not None and found.manifold:
        cut = trimmed(field, grid, mesh, sees(mesh))
        found = meshes.topology(cut.mesh.faces, len(cut.mesh.vertices))
        built = replace(built, mesh=cut.mesh, topology=found, trimmed=cut.share, must_close=False)
    return replace(built, thin=thin_share(built.mesh, grid.h))


def _mended(landed: Landed, opened: Opened) -> Mesh:
    """The mesh with the field's normals; where handles were cut, off the zero set, with the normals of its faces."""
    normals = meshes.vertex_normals(opened.vertices, opened.faces)
    kept = np.ones(len(normals), np.bool_)
    kept[opened.moved] = False
    still = np.flatnonzero(kept)
    normals[still] = landed.normals[still]
    return Mesh(opened.vertices.astype(np.float32), normals, opened.faces)


def _closed(vertices: F64, faces: Faces) -> tuple[F64, Faces, Topology, Topology | None]:
    """The mesh, its topology (moving vertices later does not change it), and the topology before a repair.

    A mesh that can't be closed is split where its sheets touch, so that every edge has at most two faces.
    """
    found = meshes.topology(faces, len(vertices))
    if found.manifold:
        return vertices, faces, found, None
    try:
        mended = clean.one_piece(*repaired(vertices, faces, found))
        now = meshes.topology(mended.faces, len(mended.vertices))
        if now.manifold:
            return mended.vertices, mended.faces, now, found
        vertices, faces = mended.vertices, mended.faces
    except StageError as e:
        log.warning("surface: the mesh stays open: %s", e.value)
    parted = clean.one_piece(*meshes.split_apart(vertices, faces))
    return parted.vertices, parted.faces, meshes.topology(parted.faces, len(parted.vertices)), found


def _warnings(kept: Kept, repairs: Topology | None, handles: int) -> tuple[str, ...]:
    out = []
    if kept.second > LARGE_SECOND:
        out.append(
            f"disconnected components that were removed: {kept.removed}; the largest has {kept.second:.0%} of the "
            "head's area: check the masks"
        )
    if repairs is not None:
        out.append(
            f"the mesh was repaired: it had {repairs.boundary_edges} open edges, {repairs.crowded_edges} edges with "
            f"more than two faces and {repairs.pinched_vertices} non-manifold vertices"
        )
    if handles:
        out.append(f"{handles} handles are wider than surface.handle and were kept; the mesh may need many charts")
    return tuple(out)
