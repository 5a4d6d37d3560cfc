"""A field on a moved or deformed head: the same texels at other places, with turned functions and new shadows.

    R = argmin ||F - R||  over rotations,  F = [e1' e2' n'] [e1 e2 n]^-1        of a triangle
    n_field' = A R n_field,   A the least rotation of R n to n'                 of a texel, n between its corners'
    y'(l) = y(R^T l)                                                            rest, and corrections of shadows

Symbols
    e1, e2, n    two edges and the unit normal of a triangle at rest; primed: deformed
    R            of a vertex the mean over its triangles, weighted by area; of a texel that of its triangle's corners
    l            direction towards the light
Traced shadows are those of the deformed mesh. A cornea moves with the texels beside it as a rigid body. Albedo and
lobes stay: skin that is stretched keeps its colour here, and has no new wrinkles but those of the mesh.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.eyes.mirror import BESIDE, Cornea
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64
from stages.reflectance.field import Field
from stages.reflectance.texels import known_surface

REST = "rest.obj"
MOST_BYTES = 2_000_000_000
UV_APART, LARGEST, SMALLEST = 1e-3, 3.0, 1 / 3  # of the texture; size against the mesh at rest
REMEDY = f"deform the field's own {REST}, and export it as OBJ with its vertices in their order, triangles, in metres"


def write_rest(path: Path, mesh: meshes.Mesh, charts: meshes.Charts) -> None:
    """The mesh at rest as OBJ: triangles with texture coordinates, asset coordinates."""
    lines = ["# neuface: the reflectance field at rest; metres, +Y up. Deform it, and keep the order of its vertices."]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in charts.uvs.tolist()]
    both = np.stack([mesh.faces, charts.faces], 2) + 1
    lines += [" ".join(["f", *(f"{v}/{t}" for v, t in corner)]) for corner in both.tolist()]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def deformed(field: Field, path: Path) -> Field:
    """The field on the mesh of an OBJ file, in asset coordinates.

    Raises:
        StageError: the file is missing or damaged, or is not the field's own mesh with moved vertices.
    """
    vertices, faces, uvs = _read(path)
    _same_mesh(field, vertices, faces, uvs, path)
    return moved(field, vertices)


def moved(field: Field, vertices: F64) -> Field:
    """The field with its vertices at (V, 3), asset coordinates."""
    rest, faces, p = field.mesh, field.mesh.faces, field.points
    normals = meshes.vertex_normals(vertices, faces)
    mesh = meshes.Mesh(vertices.astype(np.float32), normals, faces)
    corners, weights = faces[p.face], p.weights[..., None]
    position = (vertices[corners] * weights).sum(1)
    before, after = (
        meshes.unit((n.astype(np.float64)[corners] * weights).sum(1))
        for n in (meshes.vertex_normals(rest.vertices, faces), normals)
    )
    turn = nearest_rotations((vertex_rotations(rest.vertices, vertices, faces)[corners] * weights[..., None]).sum(1))
    turn = least_rotations(np.einsum("tij,tj->ti", turn, before), after) @ turn
    out = copy(field)
    out.mesh, out.points = mesh, replace(p, position=position, normal=np.einsum("tij,tj->ti", turn, p.normal))
    out.normal = np.einsum("tij,tj->ti", turn, field.normal)
    out.turn = turn if field.turn is None else turn @ field.turn
    out.whole = RayCaster(mesh.vertices, faces)
    out.blocker = RayCaster(mesh.vertices, known_surface(mesh, out.points, field.known))
    return out.with_corneas(tuple(_carried(c, p.position, position) for c in field.corneas))


def _carried(cornea: Cornea, before: F64, after: F64) -> Cornea:
    """A cornea moved as the texels beside it from before (T, 3) to after (T, 3); as it was with too few of them."""
    own = np.linalg.norm(before - cornea.centre, axis=1) < cornea.radius + BESIDE
    if own.sum() < 3:
        return cornea
    a, b = before[own], after[own]
    turn = nearest_rotations(((b - b.mean(0)).T @ (a - a.mean(0)))[None])[0]
    centre = b.mean(0) + turn @ (cornea.centre - a.mean(0))
    return replace(cornea, centre=centre, normals=cornea.normals @ turn.T)


def vertex_rotations(rest: npt.NDArray[np.floating], vertices: F64, faces: meshes.Faces) -> F64:
    """(V, 3, 3) rotation of the surface around each vertex from rest to vertices (V, 3); the identity at vertices
    without a triangle."""
    before, area = _frames(rest.astype(np.float64), faces)
    after, _ = _frames(vertices, faces)
    usable = np.abs(np.linalg.det(before)) > 1e-18
    before[~usable] = after[~usable] = np.eye(3)
    found = nearest_rotations(after @ np.linalg.inv(before)) * np.where(usable, area, 0)[:, None, None]
    total = np.zeros((len(rest), 3, 3))
    for k in range(3):
        np.add.at(total, faces[:, k], found)
    total[np.abs(total).sum((1, 2)) == 0] = np.eye(3)
    return nearest_rotations(total)


def _frames(vertices: F64, faces: meshes.Faces) -> tuple[F64, F64]:
    """(F, 3, 3) columns e1, e2, n of each triangle, and (F,) its area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1)
    normal = across / np.maximum(length, 1e-30)[:, None]
    return np.stack([b - a, c - a, normal], 2), length / 2


def nearest_rotations(m: F64) -> F64:
    """(N, 3, 3) the rotation nearest to each matrix."""
    u, _, vt = np.linalg.svd(m)
    flip = np.ones((len(m), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * flip[:, None, :]) @ vt, np.float64)


def least_rotations(a: F64, b: F64) -> F64:
    """(N, 3, 3) the rotation by the least angle of unit vectors a to b (N, 3)."""
    axis, cosine = np.cross(a, b), (a * b).sum(1)
    cross = np.zeros((len(a), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    share = 1 / np.maximum(1 + cosine, 1e-9)  # opposite vectors: no axis, any rotation is as good
    return np.asarray(np.eye(3) + cross + cross @ cross * share[:, None, None], np.float64)


def _read(path: Path) -> tuple[F64, npt.NDArray[np.int64], tuple[F64, npt.NDArray[np.int64]] | None]:
    """vertices (V, 3), faces (F, 3), and texture coordinates (U, 2) with their faces (F, 3) if every face has them."""
    if not path.is_file() or path.suffix.lower() != ".obj":
        value = "no such file" if not path.is_file() else f"a {path.suffix or 'nameless'} file"
        raise _refused("the deformed mesh can't be read", path, value, "an .obj file")
    if path.stat().st_size > MOST_BYTES:
        raise _refused("the deformed mesh is too large", path, f"{path.stat().st_size} bytes", f"{MOST_BYTES} bytes")
    vertices: list[list[float]] = []
    uvs: list[list[float]] = []
    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            try:
                if words[:1] == ["v"]:
                    vertices.append(_numbers(words[1:4], 3))
                elif words[:1] == ["vt"]:
                    uvs.append(_numbers(words[1:3], 2))
                elif words[:1] == ["f"]:
                    corners = [w.split("/") for w in words[1:]]
                    if len(corners) != 3:
                        raise ValueError(f"a face of {len(corners)} corners")
                    faces.append([_index(c[0], len(vertices)) for c in corners])
                    if all(len(c) > 1 and c[1] for c in corners):
                        uv_faces.append([_index(c[1], len(uvs)) for c in corners])
            except (ValueError, IndexError, OverflowError) as e:
                raise _refused("a line of the deformed mesh can't be read", f"{path}, line {number}", str(e)[:120],
                               "v x y z, vt u v, and f with three corners") from e  # fmt: skip
    table = np.array(faces, np.int64).reshape(-1, 3)
    charts = (np.array(uvs, np.float64).reshape(-1, 2), np.array(uv_faces, np.int64).reshape(-1, 3))
    return np.array(vertices, np.float64).reshape(-1, 3), table, charts if len(uv_faces) == len(faces) else None


def _numbers(words: list[str], count: int) -> list[float]:
    found = [float(w) for w in words]
    if len(found) != count or not np.isfinite(found).all():
        raise ValueError(f"{' '.join(words)}: {count} finite numbers")
    return found


def _index(word: str, count: int) -> int:
    found = int(word)
    place = found - 1 if found > 0 else count + found
    if not 0 <= place < count:
        raise ValueError(f"{word} of {count}")
    return place


def _same_mesh(
    field: Field,
    vertices: F64,
    faces: npt.NDArray[np.int64],
    uvs: tuple[F64, npt.NDArray[np.int64]] | None,
    path: Path,
) -> None:
    """Raises StageError unless it is the field's mesh with moved vertices."""
    own, charts = field.mesh, field.charts
    for what, count, wanted in (("vertices", len(vertices), len(own.vertices)), ("faces", len(faces), len(own.faces))):
        if count != wanted:
            raise _refused(f"the deformed mesh has another number of {what}", path, f"{count:,}", f"{wanted:,}")
    if not np.array_equal(faces, own.faces):
        off = int((faces != own.faces).any(1).sum())
        raise _refused("the deformed mesh joins other vertices", path, f"{off:,} of {len(faces):,} faces differ",
                       "the same faces in the same order")  # fmt: skip
    if uvs is not None:
        apart = float(np.abs(uvs[0][uvs[1]] - charts.uvs[charts.faces]).max(initial=0))
        if apart > UV_APART:
            raise _refused("the deformed mesh has other texture coordinates", path, f"off by up to {apart:.3g}",
                           f"at most {UV_APART:g}")  # fmt: skip
    size = float(np.ptp(vertices, axis=0).max() / np.ptp(own.vertices, axis=0).max())
    if not SMALLEST <= size <= LARGEST:
        raise _refused("the deformed mesh is of another size", path, f"{size:.3g} times as large as at rest",
                       f"{SMALLEST:.2g} to {LARGEST:g} times; metres")  # fmt: skip


def _refused(what: str, where: object, value: object, limit: object) -> StageError:
    return StageError(what, where=where, value=value, limit=limit, remedy=REMEDY)
