"""Remeshing to quads that follow the surface's curvature (Instant Meshes; Jakob et al. 2015, by pyinstantmeshes, BSD).

The library runs in a process of its own: it prints, exchanges files, and may crash on a broken surface. Its mesh is
extracted at a quarter of the wanted number of faces, and each face of it is divided into quads, which leaves no
triangle. Quad q is the triangles 2 q and 2 q + 1 of the mesh, cut along its shorter diagonal.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.meshes import F64, Faces, Indices, Mesh, triangles_of
from stages.uv.decimate import normals_from

DIVIDED = 4  # quads for each quad of the extracted mesh
LEAST = 100  # quads: fewer do not hold a surface together
NEARLY = 0.05  # accepted deviation from the wanted number of quads
TRIES = (1.0, 0.97, 1.03, 0.94, 1.06)  # times the number of quads: another number avoids a fault of the extraction
UNIT = 100.0  # longest side in the files, which hold six digits of each coordinate
LIMIT = 900.0  # seconds for one extraction; 25,000 quads take 2 to 4
CHILD = """
import sys
import pyinstantmeshes
source, result, count, border = sys.argv[1:]
pyinstantmeshes.remesh_file(source, result, target_vertex_count=int(count), pure_quad=True, deterministic=True,
                            align_to_boundaries=border == "1")
"""


def quadded(dense: Mesh, target: int) -> Mesh:
    """A manifold of about target / 2 quads on the dense mesh, as target triangles in pairs, with its normals; closed
    if the dense mesh is.

    Raises:
        StageError: pyinstantmeshes is missing or fails, or its result is no manifold of quads.
    """
    closed = meshes.topology(dense.faces, len(dense.vertices)).watertight
    low = dense.vertices.min(0).astype(np.float64)
    scale = UNIT / max(float(np.ptp(dense.vertices, axis=0).max()), 1e-30)
    points = (dense.vertices.astype(np.float64) - low) * scale
    wanted = max(target // 2, LEAST)
    best: tuple[F64, Indices] | None = None
    asked, fault = float(wanted), ""
    for factor in TRIES:
        vertices, quads = _extracted(points, dense.faces, round(asked * factor / DIVIDED), closed)
        vertices, quads = without_doublets(vertices, quads)
        found = meshes.topology(triangles_of(quads), len(vertices))
        if not (found.manifold if closed else found.sound):
            fault = str(found)
            continue
        if best is None or abs(len(quads) - wanted) < abs(len(best[1]) - wanted):
            best = vertices, quads
        if abs(len(quads) / wanted - 1) < NEARLY:
            break
        asked *= wanted / len(quads)
    if best is None:
        raise _refused(fault)
    v = (best[0] / scale + low).astype(np.float32)
    faces = triangles_of(best[1])
    return Mesh(v, normals_from(dense, v, faces), faces)


# ------------------------------------------------------------------ the library
def _extracted(points: F64, faces: Faces, count: int, closed: bool) -> tuple[F64, Indices]:
    """Vertices (V, 3) and quads (Q, 4) of about 4 `count` quads. An open mesh keeps its border."""
    with tempfile.TemporaryDirectory(prefix="neuface-quads-") as folder:
        source, result = Path(folder) / "in.obj", Path(folder) / "out.obj"
        _write(source, points, faces)
        command = [sys.executable, "-c", CHILD, str(source), str(result), str(count), "0" if closed else "1"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=LIMIT)
        except subprocess.TimeoutExpired as e:
            raise _refused(f"no result after {LIMIT:g} s") from e
        if done.returncode != 0 or not result.is_file():
            said = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()[-1]
            raise _refused(f"exit code {done.returncode}: {said[:200]}")
        return _read(result)


def _write(path: Path, points: F64, faces: Faces) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def _read(path: Path) -> tuple[F64, Indices]:
    points, quads = [], []
    for line in path.read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            points.append([float(x) for x in rest[:3]])
        elif kind == "f":
            quads.append([int(x.split("/")[0]) - 1 for x in rest])
    if not quads or {len(q) for q in quads} != {4}:
        raise _refused(f"faces with {sorted({len(q) for q in quads})} corners")
    return np.array(points, np.float64), np.array(quads, np.int64)


# ------------------------------------------------------------------ repair
def without_doublets(vertices: F64, quads: Indices) -> tuple[F64, Indices]:
    """Vertices and quads without doublets (a vertex inside two quads that share two edges: both become one quad), and
    without unused vertices. Each quad begins at the shorter of its diagonals."""
    for _ in range(len(quads)):
        side = np.stack([quads, np.roll(quads, -1, 1)], -1).reshape(-1, 2)
        around = np.unique(np.concatenate([side, side[:, ::-1]]), axis=0)[:, 0]
        used = np.bincount(quads.ravel(), minlength=len(vertices))
        inner = np.flatnonzero((np.bincount(around, minlength=len(vertices)) == 2) & (used == 2))
        if not len(inner):
            break
        quads = _joined(quads, int(inner[0]))
    used_rows, flat = np.unique(quads, return_inverse=True)
    vertices, quads = vertices[used_rows], flat.reshape(-1, 4)
    corner = vertices[quads]
    first, second = (np.linalg.norm(corner[:, i] - corner[:, i + 2], axis=1) for i in (0, 1))
    return vertices, np.where((second < first)[:, None], np.roll(quads, -1, 1), quads)


def _joined(quads: Indices, vertex: int) -> Indices:
    """The two quads around `vertex` as one; none if both have the same corners."""
    rows, columns = np.nonzero(quads == vertex)
    one, two = (np.roll(quads[r], -c) for r, c in zip(rows, columns, strict=True))
    rest = np.delete(quads, rows, axis=0)
    if one[2] == two[2]:
        return rest
    return np.concatenate([rest, [[one[1], one[2], one[3], two[2]]]])


def _refused(reason: str) -> StageError:
    return StageError(
        "remeshing to quads failed",
        where="uv.remesh",
        value=reason,
        limit="a manifold of quads, closed if the dense mesh is; pyinstantmeshes installed",
        remedy="change uv.target_faces a little, or set uv.remesh=adaptive",
    )
