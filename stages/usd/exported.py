"""Reads an exported asset back: mesh from the USD file, maps and light from the files beside it.

The renderer works on this, so that what it shows is what was handed out, not what an earlier stage held in memory.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.errors import StageError
from pipeline.images import read_encoded, read_exr
from stages.usd.light import read_light
from stages.usd.mesh import UvSurface

F32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ExportedAsset:
    """Everything that the model's equations need.

    albedo (H, W, 3) linear reflectance; coefficients (H, W, k) = rho c_j; inv_kappa (H, W, 1); normal (H, W, 3) unit,
    tangent space, +y along v; irradiance_ratio (H, W, 3), see pipeline.fields.shadowing; basis (N, k) = B_j at
    n.v = (i + 0.5) / N; light ((L + 1)^2, 3).
    """

    mesh: UvSurface
    albedo: F32
    coefficients: F32
    inv_kappa: F32
    normal: F32 | None
    irradiance_ratio: F32 | None
    basis: F32
    light: F32
    attenuation: str


def load_exported(root: Path) -> ExportedAsset:
    """From NAME.usd (with payload.usdc, textures/ and light.json beside it). StageError names what is missing."""
    import json

    folder, name = root.parent, root.stem
    light_file = folder / "light.json"
    light = read_light(light_file)
    attenuation = str(json.loads(light_file.read_text()).get("attenuation", "exponential"))
    albedo, inv_kappa = (_map(folder, name, m) for m in ("albedo", "inv_kappa"))
    coefficients, basis = _numbered(folder, name, "specular_coefficients"), _numbered(folder, name, "basis_lut").mean(0)
    if coefficients.shape[2] != basis.shape[1]:
        raise StageError(
            "the specular maps do not fit each other",
            where=f"{name}_specular_coefficients.exr",
            value=f"{coefficients.shape[2]} coefficients",
            limit=f"{basis.shape[1]} bases in basis_lut.exr",
            remedy="run the bake stage again",
        )
    return ExportedAsset(
        read_usd_mesh(root),
        albedo[..., :3],
        coefficients,
        inv_kappa[..., :1],
        _normal(folder, name),
        _ratio(folder, name),
        basis,
        light,
        attenuation,
    )


def _map(folder: Path, name: str, which: str) -> F32:
    path = folder / "textures" / f"{name}_{which}.exr"
    if not path.is_file():
        raise StageError(
            "a map of the asset is missing",
            where=path.name,
            value="no such file",
            limit="the maps that the usd stage wrote",
            remedy="keep the asset's folder together",
        )
    return read_exr(path)[0]


def _numbered(folder: Path, name: str, which: str) -> F32:
    """A map whose channels are numbered, in the order of the numbers ("c10" after "c9")."""
    path = folder / "textures" / f"{name}_{which}.exr"
    values = _map(folder, name, which)
    names = read_exr(path)[1]
    if all(re.search(r"\d+$", n) for n in names):
        values = values[..., np.argsort([int(re.findall(r"\d+", n)[-1]) for n in names])]
    return values


def _ratio(folder: Path, name: str) -> F32 | None:
    """Shadows and bounces under the captured light, if the asset carries them."""
    path = folder / "textures" / f"{name}_irradiance_ratio.exr"
    return read_exr(path)[0][..., :3] if path.is_file() else None


def _normal(folder: Path, name: str) -> F32 | None:
    """From the PNG that the shader network reads: stored as (n + 1) / 2."""
    path = folder / "textures" / f"{name}_normal.png"
    if not path.is_file():
        return None
    stored = read_encoded(path)[..., :3]
    n = stored.astype(np.float32) / (255 if stored.dtype == np.uint8 else 65535) * 2 - 1
    return np.asarray(n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6), np.float32)


def read_usd_mesh(path: Path) -> UvSurface:
    """The mesh that is rendered (purpose default or render)."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputePurpose() in ("default", "render"):
            mesh, st = UsdGeom.Mesh(prim), UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
            return UvSurface(
                np.array(mesh.GetPointsAttr().Get(), np.float32),
                np.array(mesh.GetNormalsAttr().Get(), np.float32),
                np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int32).reshape(-1, 3),
                np.array(st.Get(), np.float32),
                np.array(st.GetIndices(), np.int32).reshape(-1, 3),
            )
    raise StageError(
        "the asset has no mesh to render",
        where=path.name,
        value="none of purpose default or render",
        limit="one",
        remedy="run the usd stage again",
    )
