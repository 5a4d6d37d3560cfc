"""The demo's result against what the demo knows to be true: pictures, surface and albedo.

Everything is measured on the published files (USD, maps, predicted views), brought into the capture's world by
run.json's capture_from_asset. Distances are in millimetres, colours as PSNR of sRGB-encoded values in dB.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Capture, CaptureView
from pipeline.colour import srgb_from_linear
from pipeline.images import read_alpha, read_encoded, read_exr, shrink
from pipeline.transforms import apply, inverse_rigid, matrix, pixel_centres, project, rays

F64 = npt.NDArray[np.float64]
NO_LENS: F64 = np.zeros(5)  # the demo's cameras are pinholes
SURFACE_SAMPLES, TREE_SAMPLES, NEIGHBOURS = 20_000, 300_000, 8
SEEN_BY = 3  # fitted views; what fewer see can't be known from photos
OFFSET = 1e-4  # metres: rays to the camera start off the surface, well below what is measured


@dataclass(frozen=True, slots=True)
class Figures:
    """psnr: held-out views, the subject's pixels, sRGB. accuracy: asset to truth, mm. completeness: truth to asset."""

    psnr: float
    psnr_asset: float
    accuracy_mean: float
    accuracy_median: float
    completeness_mean: float
    albedo: float
    views: int

    def lines(self) -> list[str]:
        """For people."""
        return [
            f"held-out views ({self.views}), subject's pixels: {self.psnr:.1f} dB from the fitted model, "
            f"{self.psnr_asset:.1f} dB from the exported asset",
            f"surface, asset to truth: mean {self.accuracy_mean:.2f} mm, median {self.accuracy_median:.2f} mm; "
            f"truth to asset: mean {self.completeness_mean:.2f} mm",
            f"albedo, after one gain: {self.albedo:.1f} dB",
        ]


def measure(out: Path, capture_folder: Path, capture: Capture) -> Figures:
    """Compare the run in `out` with `capture_folder`/truth."""
    import trimesh

    record = json.loads((out / "run.json").read_text())
    mesh, st = asset_mesh(out / record["asset"], matrix(record["capture_from_asset"]))
    truth = trimesh.load(capture_folder / "truth" / "mesh_gt.ply", process=False)
    fitted = [v for v in capture.views if not v.holdout]
    held = [v for v in capture.views if v.holdout]
    accuracy = 1000 * _distances(truth, _seen(mesh, fitted))
    completeness = 1000 * _distances(mesh, _seen(truth, fitted))
    return Figures(
        psnr=_mean(_picture_psnr(out / "report/views", capture_folder, v) for v in held),
        psnr_asset=_mean(_picture_psnr(out / "report/asset_views", capture_folder, v) for v in held),
        accuracy_mean=float(accuracy.mean()),
        accuracy_median=float(np.median(accuracy)),
        completeness_mean=float(completeness.mean()),
        albedo=_albedo_psnr(out, capture_folder, mesh, st, held),
        views=len(held),
    )


def psnr(got: npt.NDArray[Any], expected: npt.NDArray[Any]) -> float:
    """-10 log10 of the mean squared difference; values in [0, 1]."""
    return float(-10 * np.log10(max(np.mean((np.asarray(got, np.float64) - expected) ** 2), 1e-12)))


def _as_seen(linear: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return srgb_from_linear(linear.clip(0, 1))


def _mean(values: Iterator[float]) -> float:
    found = list(values)
    return float(np.mean(found)) if found else float("nan")


# ------------------------------------------------------------------ pictures
def _picture_psnr(views: Path, capture_folder: Path, view: CaptureView) -> float:
    predicted = read_exr(views / f"{view.index}.exr")[0][..., :3]
    photo = (read_encoded(capture_folder / view.name)[..., :3].astype(np.float32) / 255).astype(np.float32)
    factor = photo.shape[0] // predicted.shape[0]
    subject = shrink(read_alpha(capture_folder / f"truth/alpha/{view.index}.png"), factor) > 0.5
    return psnr(_as_seen(predicted)[subject], shrink(photo, factor)[subject])


# ------------------------------------------------------------------ surface
def asset_mesh(path: Path, capture_from_asset: F64) -> tuple[Any, F64]:
    """The render mesh of a USD component as a trimesh in the capture's world, and st of each corner (F, 3, 2)."""
    import trimesh
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    meshes = [
        p
        for p in stage.Traverse()
        if p.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(p).ComputePurpose() in ("default", "render")
    ]
    prim = max(meshes, key=lambda p: len(UsdGeom.Mesh(p).GetPointsAttr().Get()))
    mesh = UsdGeom.Mesh(prim)
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T  # USD multiplies row vectors
    points = apply(capture_from_asset @ world, np.array(mesh.GetPointsAttr().Get(), np.float64))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    corners = np.array(st.ComputeFlattened(), np.float64).reshape(-1, 3, 2)
    return trimesh.Trimesh(points, faces, process=False), corners


def _seen(mesh: Any, views: list[CaptureView]) -> F64:
    """Points spread over a mesh that at least SEEN_BY of the views show."""
    import trimesh

    points, face = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=0)
    points, normals = np.asarray(points, np.float64), np.asarray(mesh.face_normals[face], np.float64)
    count = np.zeros(len(points), int)
    for view in views:
        count += _visible(mesh, points, normals, view)
    return points[count >= SEEN_BY]


def _visible(mesh: Any, points: F64, normals: F64, view: CaptureView) -> npt.NDArray[np.bool_]:
    K, cam_from_world = _camera(view)
    uv, depth = project(K, cam_from_world, NO_LENS, points)
    to_camera = inverse_rigid(cam_from_world)[:3, 3] - points
    facing = (to_camera * normals).sum(1) > 0
    inside = (depth > 0) & (uv >= 0).all(1) & (uv < (view.width, view.height)).all(1)
    found: npt.NDArray[np.bool_] = facing & inside
    towards = to_camera[found] / np.linalg.norm(to_camera[found], axis=1, keepdims=True)
    found[found] = ~mesh.ray.intersects_any(points[found] + OFFSET * normals[found], towards)
    return found


def _camera(view: CaptureView) -> tuple[F64, F64]:
    if view.camera is None:
        raise ValueError(f"view {view.index} of the demo has no camera")
    cam_from_world = np.eye(4)
    cam_from_world[:3] = matrix(view.camera.cam_from_world)[:3]
    return matrix(view.camera.K), cam_from_world


def _distances(mesh: Any, points: F64) -> F64:
    """From each point to the mesh: exact over the triangles of the nearest of many samples."""
    import trimesh
    from scipy.spatial import cKDTree

    samples, face = trimesh.sample.sample_surface(mesh, TREE_SAMPLES, seed=1)
    _, nearest = cKDTree(samples).query(points, NEIGHBOURS)
    triangles = mesh.triangles[face[nearest.ravel()]]
    repeated = np.repeat(points, NEIGHBOURS, axis=0)
    gap = np.linalg.norm(trimesh.triangles.closest_point(triangles, repeated) - repeated, axis=1)
    found: F64 = gap.reshape(-1, NEIGHBOURS).min(1)
    return found


# ------------------------------------------------------------------ albedo
def _albedo_psnr(out: Path, capture_folder: Path, mesh: Any, st: F64, views: list[CaptureView]) -> float:
    """Albedo map seen from the held-out cameras against the truth's, after the one gain that fits best."""
    maps = out / "asset/textures"
    files = list(maps.glob("*_albedo.exr")) or sorted(maps.glob("*_albedo.[0-9]*.exr"))
    texture = np.concatenate([read_exr(f)[0][..., :3] for f in files], 1)
    got, expected = [], []
    for view in views:
        path = capture_folder / f"truth/albedo/{view.index}.exr"
        if path.is_file():
            a, b = _albedo_of_view(mesh, st, texture, view, path, capture_folder)
            got.append(a)
            expected.append(b)
    if not got:
        return float("nan")
    mine, true = np.concatenate(got), np.concatenate(expected)
    gain = (mine * true).sum() / max((mine * mine).sum(), 1e-12)
    return _mean(psnr(_as_seen(gain * a), _as_seen(b)) for a, b in zip(got, expected, strict=True))


def _albedo_of_view(
    mesh: Any, st: F64, texture: npt.NDArray[np.float32], view: CaptureView, truth: Path, capture_folder: Path
) -> tuple[F64, F64]:
    import trimesh

    K, cam_from_world = _camera(view)
    inner = (
        read_alpha(capture_folder / f"truth/alpha/{view.index}.png").ravel() > 0.999
    )  # edges mix with the background
    uv = pixel_centres(view.width, view.height)[inner]
    origin, directions = rays(K, inverse_rigid(cam_from_world), NO_LENS, uv)
    points, ray, face = mesh.ray.intersects_location(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False
    )
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    at = (weights[:, :, None] * st[face]).sum(1)
    expected = read_exr(truth)[0][..., :3].reshape(-1, 3)[inner][ray]
    return _bilinear(texture, at), expected.astype(np.float64)


def _bilinear(texture: npt.NDArray[np.float32], st: F64) -> F64:
    """(N, 3) from a square texture, or a row of square tiles, with row 0 at v = 1 and texel centres at +0.5."""
    from scipy.ndimage import map_coordinates

    rows, columns = (1 - st[:, 1]) * texture.shape[0] - 0.5, st[:, 0] * texture.shape[0] - 0.5
    planes = [map_coordinates(texture[..., c], (rows, columns), order=1, mode="nearest") for c in range(3)]
    return np.stack(planes, -1).astype(np.float64)
