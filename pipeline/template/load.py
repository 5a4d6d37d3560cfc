"""Loads a template from its folder: the project's own, or another topology (docs/template.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.meshes import F64, Indices
from pipeline.template import checks
from pipeline.template.files import inside, read_arrays, read_text, refuse
from pipeline.template.manifest import REMEDY, Manifest, read_manifest
from pipeline.template.model import SKIN, Expressions, IdentityBasis, Points, Template
from pipeline.template.obj import read_obj

OWN = Path(__file__).parent / "hm08"  # the template that the project comes with


@dataclass(frozen=True, slots=True)
class _Mesh:
    """What the mesh's file says: see Template; group (Q,) index into groups."""

    path: Path
    vertices: F64
    quads: Indices
    uvs: F64
    uv_quads: Indices
    group: Indices
    groups: tuple[str, ...]


def load_template(folder: Path | None = None) -> Template:
    """The template of a folder with manifest.json; the project's own if none is given. StageError says what is wrong
    with it."""
    folder = OWN if folder is None else folder
    manifest = read_manifest(folder)
    mesh_file = inside(folder, manifest.mesh)
    is_obj = mesh_file.suffix.lower() == ".obj"
    source = inside(folder, manifest.arrays) if manifest.arrays else mesh_file
    arrays = {} if is_obj and not manifest.arrays else read_arrays(source)
    mesh = _from_obj(mesh_file) if is_obj else _from_npz(mesh_file, manifest, arrays if source == mesh_file else None)
    checks.check_mesh(mesh.path, mesh.vertices, mesh.quads)
    checks.check_uvs(mesh.path, mesh.uvs, mesh.uv_quads)
    vertices, count = mesh.vertices * manifest.metres, len(mesh.vertices)
    if "mirror" in arrays:
        mirror = checks.check_mirror(source, checks.array(source, arrays, "mirror", (count,), "int"), count)
    else:
        mirror = checks.found_mirror(mesh.path, mesh.vertices)
    parts = checks.rows_of(manifest.path, "parts", manifest.parts, mesh.group, mesh.groups)
    if SKIN not in parts or not len(parts[SKIN]):
        refuse("a template has no skin", f"{manifest.path}: parts", ", ".join(parts), f"a part named {SKIN!r}", REMEDY)
    regions = checks.rows_of(manifest.path, "regions", manifest.regions, mesh.group, mesh.groups)
    checks.check_tiles(mesh.path, mesh.uvs, mesh.uv_quads, regions)
    return Template(
        name=manifest.name,
        licence=manifest.licence,
        licence_text=read_text(inside(folder, manifest.licence_file)),
        vertices=vertices,
        quads=mesh.quads,
        parts=parts,
        regions=regions,
        uvs=mesh.uvs,
        uv_quads=mesh.uv_quads,
        mirror=mirror,
        landmarks=_landmarks(manifest, mesh.quads[parts[SKIN]], count),
        joints=_joints(manifest, source, arrays),
        shape=_identity(manifest, source, arrays, mirror),
        expressions=_expressions(manifest, source, arrays, count),
    )


def _from_obj(path: Path) -> _Mesh:
    m = read_obj(path)
    return _Mesh(path, m.vertices, m.quads, m.uvs, m.uv_quads, m.group, m.groups)


def _from_npz(path: Path, manifest: Manifest, read: checks.Arrays | None) -> _Mesh:
    arrays = read_arrays(path) if read is None else read
    quads = checks.array(path, arrays, "quads", (None, 4), "int")
    group = checks.array(path, arrays, "group", (len(quads),), "int")
    checks.in_range(path, "group", group, len(manifest.groups))
    return _Mesh(
        path,
        checks.array(path, arrays, "vertices", (None, 3), "float"),
        quads,
        checks.array(path, arrays, "uvs", (None, 2), "float"),
        checks.array(path, arrays, "uv_quads", (len(quads), 4), "int"),
        group,
        manifest.groups,
    )


def _landmarks(manifest: Manifest, skin: Indices, count: int) -> Points:
    """The landmarks, all on the skin."""
    corners = np.array([x.corners for x in manifest.landmarks], np.int64)
    checks.in_range(manifest.path, "landmarks", corners, count)
    off = np.flatnonzero(~np.isin(corners, skin).all(axis=1))
    lost = [manifest.landmarks[i].name for i in off]
    if lost:
        refuse("a landmark of a template is not on its skin", f"{manifest.path}: landmarks", lost[0],
               "three vertices of the skin", REMEDY)  # fmt: skip
    weights = np.clip(np.array([x.weights for x in manifest.landmarks], np.float64), 0, 1)
    return Points(
        tuple(x.name for x in manifest.landmarks),
        np.array([x.network for x in manifest.landmarks], np.int64),
        corners,
        weights / weights.sum(1, keepdims=True),
    )


def _joints(manifest: Manifest, path: Path, arrays: checks.Arrays) -> dict[str, F64]:
    if not manifest.joints:
        return {}
    places = checks.array(path, arrays, "joints", (len(manifest.joints), 3), "float") * manifest.metres
    return dict(zip(manifest.joints, places, strict=True))


def _identity(manifest: Manifest, path: Path, arrays: checks.Arrays, mirror: Indices) -> IdentityBasis | None:
    """The basis, if there is one. Stored: basis over its scale, of all vertices or of one side."""
    if "identity_basis" not in arrays:
        return None
    stored = checks.array(path, arrays, "identity_basis", (None, None, 3), "float")
    k, n, joints = len(stored), stored.shape[1], len(manifest.joints)
    symmetric = checks.array(path, arrays, "identity_symmetric", (k,), "bool")
    if "identity_scale" in arrays:
        stored = stored * checks.array(path, arrays, "identity_scale", (k,), "float")[:, None, None]
    rows = np.arange(len(mirror))
    if "identity_vertices" in arrays:
        rows = checks.array(path, arrays, "identity_vertices", (n,), "int")
        checks.in_range(path, "identity_vertices", rows, len(mirror))
    missing = len(mirror) - len(np.union1d(rows, mirror[rows]))
    if len(rows) != n or missing:
        checks.bad_array(
            path, "identity_basis", f"{n} vertices, {missing} on neither side", f"{len(mirror)}, or a side"
        )
    basis = checks.completed(stored, rows, mirror, symmetric)
    deviation = checks.array(path, arrays, "identity_deviation", (k,), "float") * manifest.metres
    checks.check_basis(path, basis, deviation)
    moved = np.zeros((k, 0, 3))
    if joints:
        moved = checks.array(path, arrays, "identity_joints", (k, joints, 3), "float")
    return IdentityBasis(basis, deviation, symmetric, moved)


def _expressions(manifest: Manifest, path: Path, arrays: checks.Arrays, count: int) -> Expressions | None:
    """The expressions, if there are any. Stored: offsets over `expression_scale`."""
    if not manifest.expressions:
        return None
    vertices = checks.array(path, arrays, "expression_vertices", (None,), "int")
    checks.in_range(path, "expression_vertices", vertices, count)
    offsets = checks.array(path, arrays, "expression_offsets", (len(vertices), 3), "float") * manifest.metres
    if "expression_scale" in arrays:
        offsets = offsets * checks.array(path, arrays, "expression_scale", (), "float")
    starts = checks.array(path, arrays, "expression_starts", (len(manifest.expressions) + 1,), "int")
    return Expressions(manifest.expressions, checks.check_starts(path, starts, len(vertices)), vertices, offsets)
