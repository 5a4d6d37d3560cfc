"""The meshes of the 3D view beside the glb: the asset's levels of detail, its displaced surface, and the scan.

The levels are read from the written USD files, as other programs see them. The displaced surface is the textured mesh,
cut finer and moved along its normals by the map NAME_displacement: what a renderer with displacement draws.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline import meshes, tiles
from pipeline.artifacts import Located, TextureSet
from pipeline.images import read_exr
from pipeline.map_lookup import bilinear
from pipeline.meshes import Charts, Faces, Mesh, vertex_normals
from stages.report.collect import Results
from stages.report.viewer_pack import Packed, pack

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
MM = 1e-3  # m; the map's unit
MOST_FACES = 1_000_000  # of a mesh in the page: a level with more is left out
MOST_DISPLACED = 250_000  # faces of the displaced surface
MOST_TEXT = 22_000_000  # characters of all meshes: pages are sent and opened by phones


@dataclass(frozen=True, slots=True)
class ShownMesh:
    """A mesh to choose. smooth: it has the normal map's relief in its geometry; scan: it has the scan's maps."""

    name: str
    label: str
    packed: Packed
    smooth: bool = False
    scan: bool = False


def shown_meshes(r: Results) -> list[ShownMesh]:
    """What this asset has beside its glb, the smallest first where not all of it fits."""
    found, room = [], MOST_TEXT
    for name, label, (mesh, charts), smooth, scan in _known(r):
        if len(mesh.faces) > MOST_FACES:
            continue
        packed = pack(mesh, charts)
        if len(packed.text) <= room:
            room -= len(packed.text)
            found.append(ShownMesh(name, f"{label}, {packed.faces:,} triangles", packed, smooth, scan))
    return found


def _known(r: Results) -> Iterator[tuple[str, str, tuple[Mesh, Charts], bool, bool]]:
    """Name, label, mesh, smooth and scan."""
    proxy, scan = usd_mesh(r, "payload.usdc", "proxy"), usd_mesh(r, "payload.usdc", "scan")
    if proxy is not None:
        yield "proxy", "level of detail: proxy", proxy, False, False
    if scan is not None and r.bake.artifact.scan is not None:
        yield "scan", "scan, with its own maps", scan, False, True
    if "displacement" in r.bake.artifact.maps:
        yield "displaced", "displaced by its map", displaced(r), True, False
    high = usd_mesh(r, "high.usdc", "high")
    if high is not None:
        yield "high", "level of detail: high", high, True, False


# ------------------------------------------------------------------ levels
def usd_mesh(r: Results, file: str, name: str) -> tuple[Mesh, Charts] | None:
    """A mesh of one of the asset's layers as triangles; None where there is none of that name with coordinates."""
    from pxr import Usd, UsdGeom

    refs = [f for f in r.usd.artifact.files if f.path == f"asset/{file}"]
    stage = Usd.Stage.Open(str(r.usd.path(refs[0]))) if refs else None
    for prim in stage.TraverseAll() if stage is not None else ():
        if prim.IsA(UsdGeom.Mesh) and prim.GetName() == name:
            mesh, st = UsdGeom.Mesh(prim), UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
            if not st or not st.IsIndexed():
                return None
            corners = meshes.fans(np.asarray(mesh.GetFaceVertexCountsAttr().Get(), np.int64))
            vertices = np.array(mesh.GetPointsAttr().Get(), np.float32)
            faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int32)[corners]
            charts = Charts(np.array(st.Get(), np.float32), np.array(st.GetIndices(), np.int32)[corners])
            return Mesh(vertices, vertex_normals(vertices, faces), faces), charts
    return None


# ------------------------------------------------------------------ displacement
def displaced(r: Results) -> tuple[Mesh, Charts]:
    """The mesh that the maps were baked on, cut finer and displaced."""
    path = r.uv.path(r.uv.artifact.mesh)
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    while 4 * len(mesh.faces) <= MOST_DISPLACED:
        mesh, charts = quartered(mesh, charts)
    return moved_out(mesh, charts, heights(r.bake, charts))


def moved_out(mesh: Mesh, charts: Charts, height: F64) -> tuple[Mesh, Charts]:
    """Every vertex moved along its normal. height (U,) m at the texture coordinates; a vertex at a seam has the mean of
    its sides, so that the surface stays closed."""
    vertex, uv = mesh.faces.ravel(), charts.faces.ravel()
    total = np.bincount(vertex, height[uv], len(mesh.vertices))
    mean = total / np.maximum(np.bincount(vertex, minlength=len(mesh.vertices)), 1)
    vertices = (mesh.vertices + mean[:, None] * meshes.unit(mesh.normals)).astype(np.float32)
    return Mesh(vertices, vertex_normals(vertices, mesh.faces), mesh.faces), charts


def quartered(mesh: Mesh, charts: Charts) -> tuple[Mesh, Charts]:
    """Each triangle as four, by the middles of its edges; normals are interpolated."""
    pairs, faces = _cut(mesh.faces, len(mesh.vertices))
    normals = meshes.unit(mesh.normals)
    cut = Mesh(
        np.concatenate([mesh.vertices, mesh.vertices[pairs].mean(1)]).astype(np.float32),
        np.concatenate([normals, meshes.unit(normals[pairs].mean(1))]).astype(np.float32),
        faces,
    )
    pairs, faces = _cut(charts.faces, len(charts.uvs))
    return cut, Charts(np.concatenate([charts.uvs, charts.uvs[pairs].mean(1)]).astype(np.float32), faces)


def _cut(faces: Faces, count: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Ends (E, 2) of the edges of triangles between `count` points, and four triangles for each: point count + e is the
    middle of edge e."""
    ends = np.sort(meshes.edges(faces), axis=1)
    edges, index = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (count + index).reshape(3, -1)
    four = np.stack([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], 1)
    return np.stack([edges // count, edges % count], 1), four.reshape(-1, 3).astype(np.int32)


def heights(bake: Located[TextureSet], charts: Charts) -> F64:
    """(U,) m: the displacement at the texture coordinates, between the centres of texels."""
    count, files = bake.artifact.tiles, bake.artifact.maps["displacement"].files
    tile = np.zeros(len(charts.uvs), np.int64)
    tile[charts.faces] = tiles.of_face(charts).clip(0, count - 1)[:, None]  # a coordinate on the border of two tiles
    out = np.zeros(len(charts.uvs))
    for t in range(count):
        image = read_exr(bake.path(files[tiles.form("exr", t, count)]))[0][..., :1]
        own = tile == t
        out[own] = MM * bilinear(image, charts.uvs[own] - np.array([t, 0], np.float32))[:, 0]
    return out
