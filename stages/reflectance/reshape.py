"""Moves the surface so that it has the normals that the lights show, where the cameras agree.

    minimise over the vertices x_i, each along its normal n_i
        sum over edges i j, cameras c   w ((N_i + N_j) . (x_j - x_i) / (|N_i + N_j| |x_j - x_i|))^2 / s_e^2
      + sum over vertices               A a_i (d_i - d)^2 + ((x_i - x0_i) . n_i / s_0)^2
      + sum over outlines, cameras      ((o_0 - o) / s_o)^2
      + sum over vertices               ((B x)_i . n_i / s_b)^2

Symbols
    N_i, w       normal in a camera's map where x_i is seen (answers.py); its n.v, less where the edge disagrees much
    d_i, a_i     way to where the cameras agree, and how well that is known (agree.py); d the way of the solution
    x0           the surface as it came
    o_0, o       signed distance from the outline in a camera, of the surface as it came and now: the masks' outline is
                 better than what is here
    B            umbrella operator U on what cameras see, against its own mean; U^2 on what none sees: the surface there
                 goes on with the curvature of what is around
A normal is that of the chord between two points of a circle: the mean of both ends' is right to the third order.
Gauss-Newton steps. Triangles that have folded are relaxed, and the surface there counts as unseen in the next step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.maths.sparse import factorised
from pipeline.meshes import Faces, Indices, Mesh, unique_edges, unit, vertex_normals
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, inverse_rigid, pixel_centres, project
from stages.reflectance.agree import ways
from stages.reflectance.answers import FLATTEST, WIDTH, AnswerMap, answer_maps, view_of
from stages.reflectance.rig import Rig
from stages.reflectance.samples import Step
from stages.reflectance.texels import LIFT
from stages.reflectance.thin import Held, subject

# farthest way and number of ways tried, asset units (metres); new maps before each group
ROUNDS = (((0.012, 33), (0.008, 33)), ((0.006, 25), (0.003, 21)))
STEPS = (5, 3)  # Gauss-Newton steps of each round in the groups
EDGE, STRONG = 0.05, 0.25  # s_e; sines of this size are more likely a step of the surface than an error
AGREED = 10.0  # A: agreement is not independent of its neighbours', but not biased as sums of normals are
STAY, UNSEEN_STAY, THIN_STAY = 0.05, 0.02, 5e-4  # s_0 seen, unseen, on thin sheets, asset units (metres)
OUTLINE, OUTLIER = 5e-4, 3e-3  # s_o; farther off, the outline is another surface's
RIM, FLAT_RIM = 0.3, 0.6  # most |n.v| at an outline, and outside of it
BORDER = 3.0  # pixels at the frame that do not count
SLACK = 3e-4  # metres that an outline may be off before vertices are moved that are not seen at it
LENGTH = 3e-3  # median of the edges; s_b grows with its square
BENT, UNSEEN_BENT = 2e-4, 5e-5  # s_b seen, unseen, at edges of that length
WELL_SEEN = 0.2  # least n.v of what counts as seen for s_b
FARTHEST = 0.015  # of one step
FOLD, RELAXED = 0.0, 6  # least cosine between a face and the surface around it; times that folds are relaxed

Bools = npt.NDArray[np.bool_]


@dataclass(slots=True)
class _System:
    """Linear least squares: rows of sum_k values[k] x[columns[k]] = wanted with a weight."""

    size: int
    parts: list[Any] = field(default_factory=list)
    right: F64 | float = 0.0

    def add(self, columns: Sequence[Indices], values: Sequence[F64], wanted: F64, weight: F64) -> None:
        """Rows with one column in each of `columns`."""
        from scipy.sparse import coo_array

        count = len(wanted)
        rows = np.tile(np.arange(count), len(columns))
        entries = (np.concatenate(values), (rows, np.concatenate(columns)))
        self.add_sparse(coo_array(entries, shape=(count, self.size)).tocsr(), wanted, weight)

    def add_sparse(self, matrix: Any, wanted: F64, weight: F64) -> None:
        """Rows of a sparse matrix."""
        from scipy.sparse import diags_array

        turned = matrix.T @ diags_array(weight)
        self.parts.append(turned @ matrix)
        self.right = self.right + turned @ wanted

    def solved(self) -> F64:
        """(size,) the solution."""
        whole = sum(self.parts[1:], self.parts[0])
        return np.asarray(factorised(whole).solve(np.asarray(self.right)), np.float64)


def reshaped(
    mesh: Mesh, rig: Rig, pictures: Mapping[tuple[int, int], Path], scratch: Path, check: Callable[[], None], step: Step
) -> Mesh:
    """The mesh, with the same faces. pictures: (place of the camera in the rig, place of the light) -> linear picture.
    scratch: folder for samples, which are removed."""
    first, mean = mesh, neighbour_mean(unique_edges(mesh.faces), len(mesh.vertices))
    held = Held(mesh, mean, [subject(pictures, c) for c in range(len(rig.cameras))])
    for number, (rounds, steps) in enumerate(zip(ROUNDS, STEPS, strict=True)):
        maps = answer_maps(mesh, rig, pictures, scratch / f"answers_{number}", check, step)
        for done, (far, count) in enumerate(rounds):
            step(done, len(rounds), "moving the surface")
            check()
            mesh = moved(mesh, first, maps, [view_of(c, min(2 * WIDTH, c.width)) for c in rig.cameras],
                         np.linspace(-far, far, count), steps, held)  # fmt: skip
    return mesh


def moved(
    mesh: Mesh, first: Mesh, maps: Sequence[AnswerMap], views: Sequence[Any], tried: F64, steps: int, held: Held
) -> Mesh:
    """One round: ways on which the cameras agree, then steps towards them and the maps' normals. first: the mesh as it
    came; views: the maps' cameras in the size in which outlines are compared; held: what stays, which grows. Maps that
    know nothing move nothing."""
    if not any(m.values[..., 6].any() for m in maps):
        return mesh
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    pairs = unique_edges(faces)
    mean = neighbour_mean(pairs, len(vertices))
    normals = vertex_normals(vertices, faces).astype(np.float64)
    seen, well = _seen(vertices, normals, faces, maps)
    way, trust = ways(vertices, normals, seen, maps, mean, tried)
    goal = vertices + way[:, None] * normals
    before, free = [outline(first, view) for view in views], 1 - held.share
    for _ in range(steps):
        vertices, whole = relaxed(vertices, faces, mean)
        normals = vertex_normals(vertices, faces).astype(np.float64)
        now = Mesh(vertices.astype(np.float32), normals.astype(np.float32), faces)
        system = _System(len(vertices))
        _add_edges(system, vertices, normals, pairs, seen & whole, maps, free)
        every = np.arange(len(vertices))
        system.add([every], [np.ones(len(every))], ((goal - vertices) * normals).sum(1), AGREED * trust * whole * free)
        off = ((first.vertices - vertices) * normals).sum(1)
        stay = np.where(well, 1 / STAY**2, 1 / UNSEEN_STAY**2) + held.share / THIN_STAY**2
        system.add([every], [np.ones(len(every))], off, stay)
        _add_outlines(system, vertices, normals, seen, views, before, [outline(now, view) for view in views])
        _add_bending(system, vertices, normals, pairs, mean, well & whole)
        vertices = vertices + np.clip(system.solved(), -FARTHEST, FARTHEST)[:, None] * normals
    vertices, _ = relaxed(vertices, faces, mean)
    out = Mesh(vertices.astype(np.float32), vertex_normals(vertices, faces), faces)
    held.grow(views, [outline(out, view) for view in views])
    return out


def neighbour_mean(pairs: Indices, count: int) -> Any:
    """Sparse (V, V): mean over a vertex and its neighbours."""
    from scipy.sparse import coo_array, diags_array, eye_array

    i, j = pairs.T
    both = (np.concatenate([i, j]), np.concatenate([j, i]))
    near = coo_array((np.ones(2 * len(pairs)), both), shape=(count, count)).tocsr() + eye_array(count, format="csr")
    return diags_array(1 / np.asarray(near.sum(1)).ravel()) @ near


def _seen(vertices: F64, normals: F64, faces: Faces, maps: Sequence[AnswerMap]) -> tuple[Bools, Bools]:
    """(C, V) which camera sees which vertex; (V,) whether any does at more than a grazing angle."""
    caster = RayCaster(vertices.astype(np.float32), faces)
    seen, well = np.zeros((len(maps), len(vertices)), np.bool_), np.zeros(len(vertices), np.bool_)
    for row, one in zip(seen, maps, strict=True):
        cosine = (unit(one.camera.eye - vertices) * normals).sum(1)
        live = np.flatnonzero(cosine > FLATTEST)
        start = vertices[live] + 1.5 * LIFT * normals[live]
        row[live] = caster.first_faces(start, unit(one.camera.eye - start)) < 0
        well |= row & (cosine > WELL_SEEN)
    return seen, well


def _add_edges(
    system: _System, vertices: F64, normals: F64, pairs: Indices, seen: Bools, maps: Sequence[AnswerMap], counts: F64
) -> None:
    """Edges lie across the mean of their ends' normals. counts (V,): weight of edges at each vertex."""
    along = vertices[pairs[:, 1]] - vertices[pairs[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    for visible, one in zip(seen, maps, strict=True):
        shown, _, known = one.at(vertices)
        facing = np.clip((shown * unit(one.camera.eye - vertices)).sum(1), 0, 1)
        used = np.flatnonzero((visible & (known > 0))[pairs].all(1))
        i, j = pairs[used].T
        across = unit(shown[i] + shown[j])
        sine = (across * along[used]).sum(1) / length[used]
        weight = (
            np.minimum(facing[i], facing[j]) * np.minimum(counts[i], counts[j]) / EDGE**2 / (1 + (sine / STRONG) ** 2)
        )
        slope = [(across * normals[k]).sum(1) / length[used] for k in (i, j)]
        system.add([j, i], [slope[1], -slope[0]], -sine, weight)


def outline(mesh: Mesh, view: Any) -> F64:
    """(H, W) pixels to the outline of a mesh in a camera, negative inside. The frame's border is no outline."""
    from scipy.ndimage import distance_transform_edt

    eye, rays = view.rays(pixel_centres(view.width, view.height))
    face = RayCaster(mesh.vertices, mesh.faces).first_faces(np.broadcast_to(eye, rays.shape), rays)
    inside = (face >= 0).reshape(view.height, view.width)
    if inside.all() or not inside.any():
        return np.full(inside.shape, -np.inf if inside.all() else np.inf)
    distance = distance_transform_edt(~inside) - distance_transform_edt(inside)
    return np.asarray(np.where(inside, distance + 0.5, distance - 0.5), np.float64)


def _add_outlines(
    system: _System,
    vertices: F64,
    normals: F64,
    seen: Bools,
    views: Sequence[Any],
    before: Sequence[F64],
    now: Sequence[F64],
) -> None:
    """Vertices that are seen at an outline keep it where it was; those outside of it go back there, and those at it
    that are not seen, where it has receded. So a wall along the line of sight is free: one curve on it makes the
    outline, and it is not known which."""
    from scipy.ndimage import map_coordinates

    for visible, view, old, new in zip(seen, views, before, now, strict=True):
        uv, depth = project(view.K, inverse_rigid(view.world_from_cam), view.distortion, vertices)
        inside = (depth > 0) & ((uv > BORDER) & (uv < np.array([view.width, view.height]) - BORDER)).all(1)
        cosine = np.abs((unit(view.eye - vertices) * normals).sum(1))
        near = np.flatnonzero(inside & (cosine < FLAT_RIM))
        metres = depth[near] / view.K[0, 0]
        was, is_ = (map_coordinates(o, (uv[near] - 0.5).T[::-1], order=1, mode="nearest") * metres for o in (old, new))
        finite = np.isfinite(was) & np.isfinite(is_)
        near, was, off = near[finite], was[finite], (is_ - was)[finite]
        rim = (cosine[near] < RIM) & (np.abs(was) < OUTLIER) & (visible[near] | (off > SLACK))
        used = rim | (was > SLACK)
        near, off = near[used], off[used]
        weight = 1 / OUTLINE**2 / (1 + (off / OUTLIER) ** 2)
        system.add([near], [np.sqrt(1 - cosine[near] ** 2)], off, weight)


def _add_bending(system: _System, vertices: F64, normals: F64, pairs: Indices, mean: Any, well: Bools) -> None:
    """Where cameras see the surface its umbrella vectors are as their neighbours'; elsewhere their own vanish."""
    from scipy.sparse import eye_array

    umbrella = eye_array(len(vertices), format="csr") - mean
    length = np.linalg.norm(vertices[pairs[:, 1]] - vertices[pairs[:, 0]], axis=1)
    size = float(np.median(length)) / LENGTH if len(length) else 1.0
    around = ((umbrella @ vertices) * normals).sum(1)
    seen, unseen = np.flatnonzero(well), np.flatnonzero(~well)
    for rows, operator, wanted, scale in (
        (seen, umbrella, (mean @ around) - around, BENT),
        (unseen, umbrella @ umbrella, -((umbrella @ (umbrella @ vertices)) * normals).sum(1), UNSEEN_BENT),
    ):
        if len(rows):
            along = _along(operator[rows], normals[rows], normals)
            system.add_sparse(along, wanted[rows], np.full(len(rows), 1 / (scale * size**2) ** 2))


def _along(operator: Any, own: F64, normals: F64) -> Any:
    """(R, V) sparse: each entry of an operator on vertices times n_row . n_column."""
    entries = operator.tocoo()
    turned = (own[entries.row] * normals[entries.col]).sum(1)
    entries.data = entries.data * turned
    return entries.tocsr()


def relaxed(vertices: F64, faces: Faces, mean: Any) -> tuple[F64, Bools]:
    """(V, 3) vertices, those at folded triangles moved to the mean of their neighbours, some times; and (V,) whether
    the surface is whole there."""
    touched = np.zeros(len(vertices), np.bool_)
    for _ in range(RELAXED):
        bad = folded(vertices, vertex_normals(vertices, faces).astype(np.float64), faces, mean)
        if not bad.any():
            break
        touched |= bad
        vertices = np.where(bad[:, None], mean @ vertices, vertices)
    return vertices, ~touched


def folded(vertices: F64, normals: F64, faces: Faces, mean: Any) -> Bools:
    """(V,) at or beside a triangle that does not face as the surface around it does."""
    around = mean @ (mean @ normals)
    facing = unit(meshes.area_vectors(vertices, faces))[:, None] * unit(around)[faces]
    out = np.zeros(len(vertices), np.bool_)
    out[faces[facing.sum(2).min(1) < FOLD]] = True
    return np.asarray((mean @ out.astype(np.float64)) > 0, np.bool_)
