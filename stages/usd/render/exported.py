"""Reads an exported asset: the mesh from the USD file, maps and light from the files beside it.

The renderer uses these, so that it shows the written files and not data of an earlier stage.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.camera import PinholeCamera
from pipeline.errors import StageError
from pipeline.images import read_encoded, read_exr
from pipeline.lighting.dome import read_light, read_moving
from pipeline.lighting.moving import MovingLight
from pipeline.map_lookup import bilinear
from pipeline.meshes import fans, quads_of, vertex_normals
from pipeline.registration.facets import lifted
from pipeline.transforms import apply
from stages.usd.layout import existing, light_file
from stages.usd.write.mesh import UvSurface, tile_count

if TYPE_CHECKING:
    from pxr import UsdGeom

F32 = npt.NDArray[np.float32]
CAGE_HEIGHT = "cage_displacement"  # name of the map of displacement from the cage's limit surface


@dataclass(frozen=True, slots=True)
class ExportedAsset:
    """The data of the model's equations. Maps of several tiles are side by side, as large as the largest: W = tiles H.

    albedo (H, W, 3) linear reflectance; occlusion (H, W, 3) share of the captured light that arrives, with
    albedo * occlusion = fitted albedo, None for 1; coefficients (H, W, k) = rho c_j; inv_kappa (H, W, 1);
    normal (H, W, 3) unit, tangent space, +y along v; basis (N, k) = B_j at n.v = (i + 0.5) / N;
    light ((L + 1)^2, 3). neuface_albedo (H, W, 3), f0, roughness (H, W, 1): None in an asset whose standard material
    was not fitted; albedo is then NeuFace's. moving: the captured light, if it moves with the camera; `light` is then
    its still stand-in.
    """

    mesh: UvSurface
    albedo: F32
    coefficients: F32
    inv_kappa: F32
    normal: F32 | None
    basis: F32
    light: F32
    attenuation: str
    occlusion: F32 | None = None
    tiles: int = 1
    neuface_albedo: F32 | None = None
    f0: F32 | None = None
    roughness: F32 | None = None
    moving: MovingLight | None = None


def load_exported(root: Path) -> ExportedAsset:
    """Read NAME.usd, with payload.usdc, textures/ and internal/ beside it. StageError if a file is missing."""
    import json

    folder, name = root.parent, root.stem
    fitted = light_file(folder)
    light = read_light(fitted)
    attenuation = str(json.loads(fitted.read_text()).get("attenuation", "exponential"))
    mesh = read_usd_mesh(root)
    count = tile_count(mesh)
    albedo, inv_kappa = (_map(folder, name, m, count) for m in ("albedo", "inv_kappa"))
    coefficients = tiles.side_by_side([numbered(f) for f in _files(folder, name, "specular_coefficients", count)])
    basis = numbered(_files(folder, name, "basis_lut")[0]).mean(0)
    if coefficients.shape[2] != basis.shape[1]:
        raise StageError(
            "the specular maps do not match",
            where=f"{name}_specular_coefficients.exr",
            value=f"{coefficients.shape[2]} coefficients",
            limit=f"{basis.shape[1]} bases in basis_lut.exr",
            remedy="run the bake stage again",
        )
    return ExportedAsset(
        mesh,
        albedo[..., :3],
        coefficients,
        inv_kappa[..., :1],
        _normal(folder, name, count),
        basis,
        light,
        attenuation,
        _occlusion(folder, name, count),
        count,
        *_fitted(folder, name, count),
        moving=read_moving(fitted),
    )


def _fitted(folder: Path, name: str, count: int) -> tuple[F32 | None, F32 | None, F32 | None]:
    """NeuFace's own albedo, F0 and roughness, if the standard material was fitted."""
    kinds = (("neuface_albedo", 3), ("f0", 1), ("roughness", 1))
    if not all(p.is_file() for k, _ in kinds for p in _paths(folder, name, k, "exr", count)):
        return None, None, None
    albedo, f0, roughness = (_map(folder, name, k, count)[..., :channels] for k, channels in kinds)
    return albedo, f0, roughness


def _map(folder: Path, name: str, which: str, count: int) -> F32:
    return tiles.side_by_side([read_exr(f)[0] for f in _files(folder, name, which, count)])


def _files(folder: Path, name: str, which: str, count: int = 1) -> list[Path]:
    """A map's file for each tile; StageError if one is missing."""
    paths = _paths(folder, name, which, "exr", count)
    for path in paths:
        if not path.is_file():
            raise StageError(
                "a map of the asset is missing",
                where=path.name,
                value="no such file",
                limit="the maps that the usd stage wrote",
                remedy="keep the asset's folder together",
            )
    return paths


def _paths(folder: Path, name: str, which: str, kind: str, count: int) -> list[Path]:
    return [existing(folder, name, which, tiles.form(kind, t, count)) for t in range(count)]


def numbered(path: Path) -> F32:
    """(H, W, C) map with numbered channels, in the order of the numbers ("c10" after "c9")."""
    values, names = read_exr(path)
    if all(re.search(r"\d+$", n) for n in names):
        values = values[..., np.argsort([int(re.findall(r"\d+", n)[-1]) for n in names])]
    return values


def _occlusion(folder: Path, name: str, count: int) -> F32 | None:
    """Occlusion (H, W, 3): divided out of the albedo by the export, or modelled in the fit (fields.shadowing)."""
    for which in ("occlusion", "irradiance_ratio"):
        if _paths(folder, name, which, "exr", count)[0].is_file():
            return _map(folder, name, which, count)[..., :3]
    return None


def _normal(folder: Path, name: str, count: int) -> F32 | None:
    """Normals (H, W, 3) from the PNG of the shader network, which stores (n + 1) / 2."""
    paths = _paths(folder, name, "normal", "png", count)
    if not paths[0].is_file():
        return None
    stored = tiles.side_by_side([read_encoded(p)[..., :3] for p in paths])
    n = stored.astype(np.float32) / (255 if stored.dtype == np.uint8 else 65535) * 2 - 1
    return np.asarray(n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6), np.float32)


def read_usd_mesh(path: Path) -> UvSurface:
    """The meshes that are rendered (purpose default or render) as one of triangles. A cage is subdivided as often as
    the asset says and displaced by the map in textures/; its facets follow the surface that renderers with finer
    subdivision show."""
    from pxr import Usd, UsdGeom

    from stages.usd.write.cage import is_cage, joined

    stage = Usd.Stage.Open(str(path))
    parts = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputePurpose() in ("default", "render"):
            mesh = UsdGeom.Mesh(prim)
            parts.append(_displaced(mesh, path) if is_cage(mesh) else _triangles(mesh))
    if parts:
        return parts[0] if len(parts) == 1 else joined(parts)
    raise StageError(
        "the asset has no mesh to render",
        where=path.name,
        value="none of purpose default or render",
        limit="one",
        remedy="run the usd stage again",
    )


def _triangles(mesh: UsdGeom.Mesh) -> UvSurface:
    """In the stage's world, quads as two triangles. Normals that are not authored, or of a moved mesh, are those of the
    triangles."""
    from pxr import UsdGeom

    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    corners = fans(np.asarray(mesh.GetFaceVertexCountsAttr().Get(), np.int64))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int32)[corners]
    vertices, normals = np.array(mesh.GetPointsAttr().Get(), np.float32), mesh.GetNormalsAttr()
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim())).T  # USD multiplies row vectors
    moved = not np.array_equal(world, np.eye(4))
    vertices = apply(world, vertices.astype(np.float64)).astype(np.float32) if moved else vertices
    own = normals.HasAuthoredValue() and not moved
    return UvSurface(
        vertices,
        np.array(normals.Get(), np.float32) if own else vertex_normals(vertices, faces),
        faces,
        np.array(st.Get(), np.float32),
        np.array(st.GetIndices(), np.int32)[corners] if st.IsIndexed() else corners.astype(np.int32),
    )


def _displaced(mesh: UsdGeom.Mesh, path: Path) -> UvSurface:
    from stages.usd.write.cage import evaluated

    smooth = evaluated(mesh)
    count = tile_count(smooth)
    if not _paths(path.parent, path.stem, CAGE_HEIGHT, "exr", count)[0].is_file():
        return smooth
    height = _map(path.parent, path.stem, CAGE_HEIGHT, count)[..., :1]
    moved, finer = (_at_height(x, height, count) for x in (smooth, evaluated(mesh, 1)))
    normals = vertex_normals(moved, smooth.faces)
    exact, up, middles = (x.astype(np.float64) for x in (moved, normals, finer))
    vertices = lifted(exact, up, quads_of(smooth.faces), middles)
    return replace(smooth, vertices=vertices.astype(np.float32), normals=normals)


def _at_height(smooth: UvSurface, height: F32, count: int) -> F32:
    """(n, 3) vertices, moved along their normals by a map of heights."""
    uv = np.zeros((len(smooth.vertices), 2), np.float32)
    uv[smooth.faces] = smooth.uvs[smooth.uv_faces]
    return np.asarray(smooth.vertices + bilinear(height, uv, count) * smooth.normals, np.float32)


def read_cameras(lookdev: Path) -> dict[int, tuple[PinholeCamera, bool]]:
    """The captured cameras of lookdev.usda by photo index, and whether the photo was held out.

    The inverse of stages.usd.write.lookdev: K from apertures and offsets, the lens distortion from the metadata.
    """
    from pxr import Usd, UsdGeom

    from pipeline.transforms import USD_CAM_FROM_OPENCV_CAM

    if not lookdev.is_file():
        raise StageError(
            "the asset's cameras are missing",
            where=lookdev.name,
            value="no such file",
            limit="lookdev.usda beside the asset",
            remedy="keep the asset's folder together, or give --cameras params.json",
        )
    stage = Usd.Stage.Open(str(lookdev))
    out = {}
    for prim in stage.Traverse():
        metadata = prim.GetCustomDataByKey("capture") or {}
        if not prim.IsA(UsdGeom.Camera) or not prim.GetName().startswith("view_"):
            continue
        camera = UsdGeom.Camera(prim)
        width, height = int(metadata["width"]), int(metadata["height"])
        focal, across, down, shift_x, shift_y = (
            float(a.Get())
            for a in (
                camera.GetFocalLengthAttr(),
                camera.GetHorizontalApertureAttr(),
                camera.GetVerticalApertureAttr(),
                camera.GetHorizontalApertureOffsetAttr(),
                camera.GetVerticalApertureOffsetAttr(),
            )
        )
        fx, fy = width * focal / across, height * focal / down
        K = np.array([[fx, 0, width / 2 - shift_x * fx / focal], [0, fy, height / 2 + shift_y * fy / focal], [0, 0, 1]])
        pose = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
        distortion = np.array([float(x) for x in metadata["distortion_k1_k2_p1_p2_k3"].split()])
        view = PinholeCamera(K, pose @ USD_CAM_FROM_OPENCV_CAM, width, height, distortion)
        out[int(prim.GetName().removeprefix("view_"))] = (view, bool(metadata["heldOut"]))
    return out
