"""Checks of a template's arrays: shapes, ranges and finite numbers, each with a named error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from pipeline.meshes import F64, Indices, Mask
from pipeline.template.files import refuse
from pipeline.template.manifest import REMEDY
from pipeline.template.model import LEFT_OUT
from pipeline.tiles import FIRST, MAX_TILES

MAX_VERTICES = 1_000_000
BESIDE = 2  # tiles that the asset adds to the template's: clothes and hair
MOST_TILES = MAX_TILES - BESIDE
FARTHEST = 1e9  # units of length from the origin
UV_SLACK = 1e-6  # of a tile, for rounded coordinates
SYMMETRIC = 1e-3  # of the mesh's size: how far from its mirror image a vertex may be where no mirror is given
Arrays = Mapping[str, npt.NDArray[Any]]


def bad_array(path: Path, key: str, value: object, limit: object) -> NoReturn:
    """An array of the template's file that can't be used."""
    refuse("an array of a template is wrong", f"{path}: {key}", value, limit, "write the array again; docs/template.md")


def array(path: Path, arrays: Arrays, key: str, shape: tuple[int | None, ...], kind: str) -> npt.NDArray[Any]:
    """An array of a `shape` (None: any size), `kind` "float" as float64 and finite, "int" as int64, or "bool"."""
    if key not in arrays:
        bad_array(path, key, "no such array", f"an array of shape {_words(shape)}")
    found = arrays[key]
    fits = found.ndim == len(shape) and all(w is None or w == s for w, s in zip(shape, found.shape, strict=True))
    if not fits:
        if key == "quads" and found.ndim == 2 and found.shape[1] == 3:
            refuse("a template must be all quads", f"{path}: {key}", "faces of 3 corners", "4 corners",
                   "convert the mesh to quads before it becomes a template")  # fmt: skip
        bad_array(path, key, f"shape {found.shape}", f"shape {_words(shape)}")
    if found.dtype.kind not in {"float": "fiu", "int": "iu", "bool": "b"}[kind]:
        bad_array(path, key, f"type {found.dtype}", kind)
    if kind == "int":
        return found.astype(np.int64)
    if kind == "bool":
        return found
    out = found.astype(np.float64)
    if not np.isfinite(out).all():
        bad_array(path, key, f"{int((~np.isfinite(out)).sum())} values are NaN or infinite", "finite numbers")
    return out


def _words(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"


def in_range(path: Path, key: str, indices: Indices, count: int) -> Indices:
    """Indices that are all from 0 to count - 1."""
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        wrong = indices[(indices < 0) | (indices >= count)]
        bad_array(path, key, f"{len(wrong)} indices out of range, the first {wrong[0]}", f"0 to {count - 1}")
    return indices


def check_mesh(path: Path, vertices: F64, quads: Indices) -> None:
    """At least one quad, of four different vertices each, and no vertex that no quad uses."""
    if not 0 < len(vertices) <= MAX_VERTICES or len(quads) == 0:
        bad_array(path, "vertices", f"{len(vertices)} vertices, {len(quads)} quads", f"1 to {MAX_VERTICES} vertices")
    if not (np.abs(vertices) <= FARTHEST).all():
        bad_array(path, "vertices", "NaN, infinite or huge", f"finite numbers up to {FARTHEST:g}")
    in_range(path, "quads", quads, len(vertices))
    ordered = np.sort(quads, 1)
    if (ordered[:, 1:] == ordered[:, :-1]).any():
        row = int((ordered[:, 1:] == ordered[:, :-1]).any(1).argmax())
        bad_array(path, "quads", f"quad {row} has the vertices {quads[row].tolist()}", "four different vertices")
    unused = np.flatnonzero(np.bincount(quads.ravel(), minlength=len(vertices)) == 0)
    if len(unused):
        bad_array(path, "vertices", f"{len(unused)} in no quad, the first {unused[0]}", "no loose vertices")


def rows_of(path: Path, what: str, named: Mapping[str, tuple[str, ...]], group: Indices,
            groups: tuple[str, ...]) -> dict[str, Indices]:  # fmt: skip
    """Name -> quads, each quad under exactly one name. group: (Q,) index into groups."""
    owner = np.full(len(groups), -1)
    for i, (name, members) in enumerate(named.items()):
        for member in members:
            if member not in groups:
                refuse("a group of a template is missing", f"{path}: {what}.{name}", member,
                       ", ".join(groups)[:300], REMEDY)  # fmt: skip
            if owner[groups.index(member)] >= 0:
                refuse(f"a group of a template is in two {what}", f"{path}: {what}.{name}", member, "one", REMEDY)
            owner[groups.index(member)] = i
    of_quad = owner[group]
    if (of_quad < 0).any():
        lost = groups[int(group[of_quad < 0][0])]
        refuse(f"a group of a template is in none of its {what}", f"{path}: {what}", lost, "every group in one", REMEDY)
    return {name: np.flatnonzero(of_quad == i) for i, name in enumerate(named)}


def check_uvs(path: Path, uvs: F64, uv_quads: Indices) -> None:
    """Each quad inside one tile of the row."""
    if not np.isfinite(uvs).all():
        bad_array(path, "uvs", "NaN or infinite", "finite numbers")
    in_range(path, "uv_quads", uv_quads, len(uvs))
    corners = uvs[uv_quads]
    tile = np.floor(corners[..., 0].mean(1))[:, None]
    u, v = corners[..., 0] - tile, corners[..., 1]
    out = (u < -UV_SLACK) | (u > 1 + UV_SLACK) | (v < -UV_SLACK) | (v > 1 + UV_SLACK)
    out |= (tile < 0) | (tile >= MOST_TILES)
    if out.any():
        row, corner = np.argwhere(out)[0]
        refuse(
            "texture coordinates of a template lie outside their tile", f"{path}: quad {row}",
            f"({corners[row, corner, 0]:.4g}, {corners[row, corner, 1]:.4g}), {int(out.any(1).sum())} quads in all",
            f"each quad inside one of the tiles {FIRST} to {FIRST + MOST_TILES - 1}, which are one row",
            "move the chart into a tile",
        )  # fmt: skip


def check_tiles(path: Path, uvs: F64, uv_quads: Indices, regions: Mapping[str, Indices]) -> None:
    """No tile without a quad between others: the asset has maps for each, and its renderers read the row. Quads that
    the asset leaves out do not count."""
    quads = np.concatenate([rows for name, rows in regions.items() if name not in LEFT_OUT])
    used = np.unique(np.floor(uvs[uv_quads[quads], 0].mean(1)).astype(np.int64))
    if not np.array_equal(used, np.arange(len(used))):
        found = ", ".join(str(FIRST + t) for t in used.tolist())
        refuse(
            "a template leaves a tile of its row empty", f"{path}: uvs", found,
            f"tiles from {FIRST} on without a gap", "move the charts of the later tiles",
        )  # fmt: skip


def check_mirror(path: Path, mirror: Indices, count: int) -> Indices:
    """A pairing: the mirror of the mirror is the vertex itself."""
    in_range(path, "mirror", mirror, count)
    wrong = np.flatnonzero(mirror[mirror] != np.arange(count))
    if len(wrong):
        bad_array(path, "mirror", f"{len(wrong)} vertices are not their mirror's mirror, the first {wrong[0]}", "pairs")
    return mirror


def found_mirror(path: Path, vertices: F64) -> Indices:
    """(V,) the vertex at the mirrored place, of a mesh that is symmetric about x = 0."""
    from scipy.spatial import cKDTree

    distance, mirror = cKDTree(vertices).query(vertices * [-1, 1, 1])
    limit = SYMMETRIC * float(np.ptp(vertices, axis=0).max())
    if distance.max() > limit or (mirror[mirror] != np.arange(len(vertices))).any():
        refuse(
            "a template without a mirror is not symmetric about x = 0", path,
            f"{int((distance > limit).sum())} vertices without a partner", f"a partner within {limit:.2g}",
            "give the pairs as the array `mirror`",
        )  # fmt: skip
    return np.asarray(mirror, np.int64)


def check_starts(path: Path, starts: Indices, count: int) -> Indices:
    """Where each expression's rows begin, and the end of the last."""
    if starts[0] != 0 or starts[-1] != count or (np.diff(starts) < 0).any():
        bad_array(path, "expression_starts", f"from {starts[0]} to {starts[-1]}", f"rising from 0 to {count}")
    return starts


def check_basis(path: Path, basis: F64, deviation: F64) -> None:
    """Rows of unit length at right angles, deviations positive and falling."""
    flat = basis.reshape(len(basis), -1)
    off = float(np.abs(flat @ flat.T - np.eye(len(flat))).max(initial=0))
    if off > ORTHONORMAL:
        bad_array(path, "identity_basis", f"off from orthonormal by {off:.2g}", f"{ORTHONORMAL:g}")
    if (deviation <= 0).any() or (np.diff(deviation) > 0).any():
        bad_array(path, "identity_deviation", "not positive and falling", "positive, the largest first")


ORTHONORMAL = 1e-2  # what rounding to half floats may leave


def completed(basis: F64, rows: Indices, mirror: Indices, symmetric: Mask) -> F64:
    """(K, V, 3) from the vertices `rows` (n,) of a basis (K, n, 3); the others are the mirrored ones, with the other
    sign where a component is not symmetric."""
    out = np.zeros((len(basis), len(mirror), 3))
    sign = np.where(symmetric, 1.0, -1.0)[:, None, None]
    out[:, mirror[rows]] = basis * sign * [-1, 1, 1]
    out[:, rows] = basis
    return out
