"""Meshes of the 3D view: unpacked they are what they were; a displaced sphere has the radius that the map says."""

from __future__ import annotations

import base64
import gzip
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from pipeline.artifacts import FileRef, Located
from pipeline.images import write_exr
from pipeline.map_lookup import bilinear
from pipeline.meshes import Charts, Mesh, areas, fans, split_at_seams, volume
from stages.report import viewer_meshes
from stages.report.viewer_maps import scan_look
from stages.report.viewer_meshes import heights, moved_out, quartered, shown_meshes, usd_mesh
from stages.report.viewer_pack import NORMAL_STEPS, POSITION_STEPS, UV_STEPS, Packed, pack


def octahedron(radius: float = 1.0, times: int = 0) -> tuple[Mesh, Charts]:
    """A sphere of 8 * 4^times triangles, its chart the longitude and latitude of the octahedron's halves laid flat."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]], np.int32)
    uvs = np.concatenate(
        [corners[:5, :2] * [0.2, 0.4] + [0.25, 0.5], corners[[0, 1, 2, 3, 5], :2] * [0.2, 0.4] + [0.75, 0.5]]
    )
    uv_faces = np.where(faces < 4, faces, 4) + np.array([0] * 4 + [5] * 4)[:, None]
    mesh, charts = Mesh(corners, corners.copy(), faces), Charts(uvs.astype(np.float32), uv_faces.astype(np.int32))
    for _ in range(times):
        mesh, charts = quartered(mesh, charts)
    unit = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return Mesh((radius * unit).astype(np.float32), unit.astype(np.float32), mesh.faces), charts


def unpacked(packed: Packed) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Positions, normals, uvs and faces of each piece: the layout read again, number by number."""
    data, at, out = gzip.decompress(base64.b64decode(packed.text)), 0, []

    def take(count: int, columns: int, size: int, signed: bool = False) -> np.ndarray:
        nonlocal at
        rows = np.zeros((count, columns), np.int64)
        for c in range(columns):
            value = 0
            for i in range(count):
                steps = [data[at + (c * size + b) * count + i] for b in range(size)]
                value = (value + sum(s << (8 * b) for b, s in enumerate(steps))) % (1 << (8 * size))
                rows[i, c] = value - (1 << (8 * size)) if signed and value >= 1 << (8 * size - 1) else value
        at += count * columns * size
        return rows

    for part in packed.parts:
        n = part["vertices"]
        positions = np.array(packed.low) + packed.step * take(n, 3, 2)
        normals, uvs = take(n, 3, 2, signed=True) / NORMAL_STEPS, take(n, 2, 2) / UV_STEPS
        out.append((positions, normals, uvs, take(3 * part["faces"], 1, 4).reshape(-1, 3)))
    assert at == len(data)
    return out


# ------------------------------------------------------------------ packing
def test_what_is_packed_is_unpacked_within_a_step() -> None:
    mesh, charts = octahedron(0.12, 3)
    [(positions, normals, uvs, faces)] = unpacked(pack(mesh, charts))
    assert np.abs(positions[faces] - mesh.vertices[mesh.faces]).max() <= 0.51 * 0.24 / POSITION_STEPS
    assert np.abs(normals[faces] - mesh.normals[mesh.faces]).max() <= 0.51 / NORMAL_STEPS
    wanted = charts.uvs[charts.faces] * [1, -1] + [0, 1]
    assert np.abs(uvs[faces] - wanted).max() <= 0.51 / UV_STEPS


def test_tiles_become_pieces_in_the_unit_square() -> None:
    mesh, charts = octahedron()
    uvs = charts.uvs + np.array([[0, 0]] * 5 + [[1, 0]] * 5, np.float32)
    packed = pack(mesh, Charts(uvs, charts.faces))
    assert [(p["tile"], p["faces"]) for p in packed.parts] == [(0, 4), (1, 4)]
    for _, _, own, _ in unpacked(packed):
        assert own.min() >= 0 and own.max() <= 1
    _, _, own, faces = unpacked(packed)[1]
    assert np.abs(own[faces] - (charts.uvs[charts.faces[4:]] * [1, -1] + [0, 1])).max() < 1e-4


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e6])
def test_extreme_sizes_are_packed(size: float) -> None:
    mesh, charts = octahedron()
    [(positions, _, _, faces)] = unpacked(
        pack(Mesh(mesh.vertices * np.float32(size), mesh.normals, mesh.faces), charts)
    )
    assert np.isfinite(positions).all()
    assert np.abs(positions[faces] - size * mesh.vertices[mesh.faces]).max() <= max(2 * size / POSITION_STEPS, 1e-9)


def test_corners_are_split_where_their_coordinates_differ() -> None:
    vertex, uv, faces = split_at_seams(np.array([[0, 1, 2], [2, 1, 3]]), np.array([[0, 1, 2], [2, 4, 3]]))
    assert len(vertex) == 5 and vertex[faces].tolist() == [[0, 1, 2], [2, 1, 3]]
    assert uv[faces].tolist() == [[0, 1, 2], [2, 4, 3]]


# ------------------------------------------------------------------ displacement
def test_a_coarse_sphere_is_displaced_onto_the_sphere() -> None:
    """The chords of a sphere of 128 triangles, cut finer; the height of each point is what it lacks of the radius."""
    mesh, charts = quartered(*quartered(*octahedron(0.1, 2)))
    lacks = 0.1 - np.linalg.norm(mesh.vertices, axis=1)
    height = np.zeros(len(charts.uvs))
    height[charts.faces.ravel()] = lacks[mesh.faces.ravel()]
    moved, _ = moved_out(mesh, charts, height)
    before, after = lacks, 0.1 - np.linalg.norm(moved.vertices, axis=1)
    assert np.abs(before).max() > 5e-3 and np.abs(after).max() < 1e-4
    assert volume(moved.vertices, moved.faces) == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.01)
    assert moved_out(mesh, charts, np.zeros(len(charts.uvs)))[0].vertices == pytest.approx(mesh.vertices, abs=1e-7)


def test_a_seam_stays_closed_where_its_sides_differ() -> None:
    mesh, charts = octahedron()
    height = np.repeat([0.1, 0.3], 5)
    moved, _ = moved_out(mesh, charts, height)
    assert np.linalg.norm(moved.vertices, axis=1) == pytest.approx([1.2] * 4 + [1.1, 1.3], abs=1e-6)


def test_cutting_changes_no_surface() -> None:
    mesh, charts = octahedron()
    cut, laid = quartered(mesh, charts)
    assert len(cut.faces) == 32 and len(cut.vertices) == 6 + 12
    assert areas(cut.vertices, cut.faces).sum() == pytest.approx(areas(mesh.vertices, mesh.faces).sum())
    assert volume(cut.vertices, cut.faces) == pytest.approx(volume(mesh.vertices, mesh.faces))
    flat = [np.pad(c.uvs.astype(float), ((0, 0), (0, 1))) for c in (charts, laid)]
    assert areas(flat[1], laid.faces).sum() == pytest.approx(areas(flat[0], charts.faces).sum())
    assert np.linalg.norm(cut.normals, axis=1) == pytest.approx(1)


def test_heights_are_read_between_texels_of_the_right_tile(tmp_path: Path) -> None:
    """A map that grows linearly gives that line at every coordinate; in mm."""
    size, files = 32, {}
    u = (np.arange(size) + 0.5) / size
    for tile, offset in ((0, 0.0), (1, 10.0)):
        picture = (offset + 2 * u[None, :] + 3 * (1 - u[:, None]))[..., None].astype(np.float32)
        write_exr(tmp_path / f"d.{1001 + tile}.exr", picture)
        files[f"{1001 + tile}.exr"] = FileRef.of(tmp_path, f"d.{1001 + tile}.exr")
    bake = SimpleNamespace(tiles=2, maps={"displacement": SimpleNamespace(files=files)})
    uvs = np.array([[0.3, 0.4], [0.5, 0.6], [0.4, 0.9], [1.3, 0.4], [1.5, 0.6], [1.4, 0.9]], np.float32)
    found = heights(Located(bake, tmp_path), Charts(uvs, np.array([[0, 1, 2], [3, 4, 5]])))  # type: ignore[type-var]
    wanted = np.array([0, 0, 0, 10, 10, 10]) + 2 * (uvs[:, 0] % 1) + 3 * uvs[:, 1]
    assert found == pytest.approx(1e-3 * wanted, abs=1e-7)
    edge = bilinear(
        np.array([[[1.0], [2.0]], [[3.0], [4.0]]], np.float32), np.array([[0, 0], [1, 1], [0.5, 0.5]], np.float32)
    )
    assert edge[:, 0] == pytest.approx([3, 2, 2.5])
    assert bilinear(np.full((1, 1, 1), 7, np.float32), np.array([[0.2, 0.9]], np.float32))[:, 0] == pytest.approx([7])


# ------------------------------------------------------------------ levels
def test_faces_with_more_corners_become_fans() -> None:
    assert fans(np.array([4, 3, 5])).tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9], [7, 9, 10], [7, 10, 11]]


def written(folder: Path, *, indexed: bool = True) -> SimpleNamespace:
    """An asset whose payload has one square as a proxy."""
    (folder / "asset").mkdir(exist_ok=True)
    stage = Usd.Stage.CreateNew(str(folder / "asset/payload.usdc"))
    mesh = UsdGeom.Mesh.Define(stage, "/head/geo/proxy")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    kind, each = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, each)
    st.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    if indexed:
        st.SetIndices([0, 1, 2, 3])
    stage.Save()
    files = (FileRef.of(folder, "asset/payload.usdc"),)
    bake = SimpleNamespace(tiles=1, maps={}, scan=None)
    return SimpleNamespace(usd=Located(SimpleNamespace(files=files), folder), bake=Located(bake, folder))  # type: ignore[type-var]


def test_levels_are_read_from_the_written_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    r = written(tmp_path)
    found = usd_mesh(r, "payload.usdc", "proxy")  # type: ignore[arg-type]
    assert found is not None
    mesh, charts = found
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]] and charts.faces.tolist() == mesh.faces.tolist()
    assert mesh.normals.tolist() == [[0, 0, 1]] * 4
    assert usd_mesh(r, "high.usdc", "high") is None and usd_mesh(r, "payload.usdc", "scan") is None  # type: ignore[arg-type]
    assert [m.name for m in shown_meshes(r)] == ["proxy"]  # type: ignore[arg-type]
    for limit in ("MOST_FACES", "MOST_TEXT"):
        with monkeypatch.context() as small:
            small.setattr(viewer_meshes, limit, 1)
            assert shown_meshes(r) == []  # type: ignore[arg-type]
    assert scan_look(r.bake) is None


def test_a_mesh_without_indexed_coordinates_is_left_out(tmp_path: Path) -> None:
    assert usd_mesh(written(tmp_path, indexed=False), "payload.usdc", "proxy") is None  # type: ignore[arg-type]
