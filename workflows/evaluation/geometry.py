"""What measuring against a known truth rests on: cameras, which points they see, distances, and maps seen from them.

Meshes are trimesh objects in one world with the cameras; lengths in that world's unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.camera import PinholeCamera
from pipeline.capture_artifacts import CaptureView
from pipeline.colour import srgb_from_linear
from pipeline.transforms import apply, inverse_rigid, matrix

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
SURFACE_SAMPLES, TREE_SAMPLES, NEIGHBOURS = 20_000, 300_000, 8
SEEN_BY = 3  # fitted views; what fewer see can't be known from photos
OFFSET = 1e-4  # metres: rays to the camera start off the surface, well below what is measured
WHOLE = 0.999  # alpha of pixels that no background is mixed into


def camera_of(view: CaptureView) -> PinholeCamera:
    """The camera that came with a photo. ValueError if none did."""
    if view.camera is None:
        raise ValueError(f"view {view.index} has no camera")
    cam_from_world = np.eye(4)
    cam_from_world[:3] = matrix(view.camera.cam_from_world)[:3]
    distortion = np.pad(np.array(view.camera.distortion, np.float64), (0, 5))[:5]
    return PinholeCamera(matrix(view.camera.K), inverse_rigid(cam_from_world), view.width, view.height, distortion)


# ------------------------------------------------------------------ a run's surface
def asset_mesh(path: Path, capture_from_asset: F64) -> tuple[Any, F64]:
    """The render mesh of a USD component as a trimesh in the capture's world, and st of each corner (F, 3, 2)."""
    import trimesh

    from stages.usd.render.exported import read_usd_mesh

    mesh = read_usd_mesh(path)
    points = apply(capture_from_asset, mesh.vertices.astype(np.float64))
    return trimesh.Trimesh(points, mesh.faces, process=False), mesh.uvs[mesh.uv_faces].astype(np.float64)


def spread(mesh: Any, count: int = SURFACE_SAMPLES) -> tuple[F64, F64]:
    """(N, 3) points spread evenly over a mesh, the same each time, and the normals of their faces."""
    import trimesh

    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points, np.float64), np.asarray(mesh.face_normals[face], np.float64)


# ------------------------------------------------------------------ sight and distance
def visible(
    mesh: Any, points: F64, normals: F64, camera: PinholeCamera, least: float = 0.0, inside: F32 | None = None
) -> Mask:
    """(N,) whether the camera sees the points: in its picture, not hidden by the mesh, turned to it with a cosine above
    `least` and, with a picture `inside` (H, W), on a pixel above one half."""
    at, found = camera.pixels(points)
    if inside is not None:
        found &= inside[at[:, 1], at[:, 0]] > 0.5
    to_camera = camera.eye - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    found &= (to_camera * normals).sum(1) > least
    found[found] = ~mesh.ray.intersects_any(points[found] + OFFSET * normals[found], to_camera[found])
    return found


def seen(mesh: Any, cameras: Iterable[tuple[PinholeCamera, F32 | None]]) -> F64:
    """Points spread over a mesh that at least SEEN_BY of the cameras see; of a camera with a picture of the subject
    only points on it count."""
    points, normals = spread(mesh)
    count = np.zeros(len(points), int)
    for camera, inside in cameras:
        count += visible(mesh, points, normals, camera, inside=inside)
    return points[count >= SEEN_BY]


def distances(mesh: Any, points: F64) -> F64:
    """From each point to the mesh: exact over the triangles of the nearest of many samples. Each triangle has one at
    least: a mesh with more triangles than samples would seem further away, by as much as a triangle's size."""
    import trimesh
    from scipy.spatial import cKDTree

    samples, face = trimesh.sample.sample_surface(mesh, TREE_SAMPLES, seed=1)
    samples, face = np.concatenate([samples, mesh.triangles_center]), np.r_[face, np.arange(len(mesh.faces))]
    _, nearest = cKDTree(samples).query(points, NEIGHBOURS)
    triangles = mesh.triangles[face[nearest.ravel()]]
    repeated = np.repeat(points, NEIGHBOURS, axis=0)
    gap = np.linalg.norm(trimesh.triangles.closest_point(triangles, repeated) - repeated, axis=1)
    found: F64 = gap.reshape(-1, NEIGHBOURS).min(1)
    return found


# ------------------------------------------------------------------ colours
def psnr(got: npt.NDArray[Any], expected: npt.NDArray[Any]) -> float:
    """-10 log10 of the mean squared difference; values in [0, 1]."""
    return float(-10 * np.log10(max(np.mean((np.asarray(got, np.float64) - expected) ** 2), 1e-12)))


def as_seen(linear: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """sRGB-encoded values of linear ones, clipped to [0, 1]."""
    return srgb_from_linear(linear.clip(0, 1))


def albedo_map(textures: Path) -> F32:
    """The asset's albedo; of several tiles, side by side."""
    from pipeline import tiles
    from pipeline.images import read_exr
    from stages.usd.texture_names import pattern_of, texture_name

    pattern = pattern_of(textures.parent)
    one, several = (f"{texture_name(pattern, '*', 'albedo', udim)}.exr" for udim in ("", "[0-9]" * 4))
    files = list(textures.glob(one)) or sorted(textures.glob(several))
    return tiles.side_by_side([read_exr(f)[0][..., :3] for f in files])


def mapped(mesh: Any, st: F64, texture: F32, camera: PinholeCamera, pixel: npt.NDArray[np.int64], factor: int) -> F64:
    """(N, 3) a texture as the camera sees it in some pixels of a picture `factor` times smaller than its own, given by
    row * columns + column; the mean over factor x factor rays. NaN where a ray meets nothing."""
    import trimesh

    columns = camera.width // factor
    corner = np.stack([pixel % columns, pixel // columns], -1).astype(np.float64) * factor
    step = np.arange(factor) + 0.5
    inner = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
    origin, directions = camera.rays((corner[:, None] + inner).reshape(-1, 2))
    points, ray, face = mesh.ray.intersects_location(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False
    )
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    found = np.full(directions.shape, np.nan)
    found[ray] = bilinear(texture, (weights[:, :, None] * st[face]).sum(1))
    return np.asarray(found.reshape(len(pixel), -1, 3).mean(1), np.float64)


def albedo_pairs(mesh: Any, st: F64, texture: F32, camera: PinholeCamera, truth: F32, alpha: F32) -> tuple[F64, F64]:
    """(N, 3) the asset's and the true albedo of the pixels that lie wholly on the subject and on the asset.

    truth: (H / f, W / f, 3) for a camera of W x H pixels; alpha: of that size, or W x H.
    """
    from pipeline.images import shrink

    inner = np.flatnonzero(shrink(alpha, alpha.shape[0] // truth.shape[0]).ravel() > WHOLE)
    found = mapped(mesh, st, texture, camera, inner, camera.height // truth.shape[0])
    both = np.isfinite(found).all(1)
    return found[both], truth.reshape(-1, 3)[inner][both].astype(np.float64)


def best_gain(got: F64, expected: F64) -> float:
    """The factor on `got` that comes nearest to `expected`, least squares of linear values."""
    return float((got * expected).sum() / max(float((got * got).sum()), 1e-12))


def bilinear(texture: F32, st: F64) -> F64:
    """(N, 3) from a square texture, or a row of square tiles, with row 0 at v = 1 and texel centres at +0.5."""
    from scipy.ndimage import map_coordinates

    rows, columns = (1 - st[:, 1]) * texture.shape[0] - 0.5, st[:, 0] * texture.shape[0] - 0.5
    planes = [map_coordinates(texture[..., c], (rows, columns), order=1, mode="nearest") for c in range(3)]
    return np.stack(planes, -1).astype(np.float64)
