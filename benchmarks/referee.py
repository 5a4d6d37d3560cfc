"""A path tracer of somebody else's (Mitsuba 3) renders an exported asset under its captured light.

    python benchmarks/referee.py RUN INDEX OUT [--look standard|openpbr|neuface_basis]
        [--env FILE.exr] [--side 256] [--spp 64]

Reads what any tool would: NAME.obj, the textures, environment.exr and the camera of lookdev.usda. Mitsuba knows
neither UsdPreviewSurface nor OpenPBR: its `principled` (a GGX dielectric over a diffuse base) stands for both.
`standard` has one index of refraction; `openpbr` has F0 as a map: a blend, texel by texel, of two such surfaces with
F0 0 and 0.16. `neuface_basis` has the tint that the exported table gives as seen from this camera, as the weight of a
blend of F0 0 and the table's own surface; it is bounded by 1 there. Assets of one UDIM tile only.
Writes OUT.exr.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from pipeline.camera import PinholeCamera
from pipeline.images import read_exr, write_exr
from pipeline.map_lookup import bilinear
from stages.usd.layout import map_file
from stages.usd.render.exported import read_cameras, read_usd_mesh
from stages.usd.write.ggx_conversion import INV_KAPPA_SCALE, REFERENCE_F0
from stages.usd.write.maps import vertex_image
from stages.usd.write.shading import ior_from_f0

mi.set_variant("scalar_rgb")
TOP = 0.16


def bitmap(path: Path, raw: bool) -> dict[str, Any]:
    """A texture, clamped."""
    return {"type": "bitmap", "filename": str(path), "raw": raw, "wrap_mode": "clamp"}


def surface(textures: Path, name: str, **specular: float) -> dict[str, Any]:
    """One layer over a diffuse base, bent by the normal map."""
    return {
        "type": "principled",
        "base_color": bitmap(textures / f"{name}_albedo.png", False),
        "roughness": bitmap(textures / f"{name}_roughness.png", True),
        **specular,
    }


def tint(asset: Path, name: str, eye: np.ndarray) -> np.ndarray:
    """(H, W) sum_j c_j T_j(n.v, 1/kappa) at every texel, for an eye at one place; n without the normal map."""
    mesh = read_usd_mesh(asset / f"{name}.usd")
    coefficients = read_exr(map_file(asset, name, "coefficients_rgb0", "exr"))[0]
    s = read_exr(map_file(asset, name, "inv_kappa", "exr"))[0][..., 0]
    table = read_exr(map_file(asset, name, "basis_rgb0", "exr"))[0]
    place, normal = (vertex_image(mesh, a.astype(np.float64), len(s)) for a in (mesh.vertices, mesh.normals))
    toward = eye - place
    cosine = (normal * toward).sum(-1) / (np.linalg.norm(normal, axis=-1) * np.linalg.norm(toward, axis=-1))
    at = np.stack([cosine.clip(0, 1), (INV_KAPPA_SCALE * s).clip(0, 1)], -1).reshape(-1, 2)
    return np.asarray((coefficients.reshape(-1, 3) * bilinear(table, at)).sum(1)).reshape(s.shape)


def rendered(asset: Path, index: int, look: str, env: Path | None, side: int, spp: int) -> np.ndarray:
    """(H, W, 4) linear RGBA of an asset's folder from a camera of lookdev.usda, `side` pixels wide. env: None is the
    captured light."""
    name = next(asset.glob("*.obj")).stem
    textures = asset / "textures"
    f0 = read_exr(textures / f"{name}_f0.exr")[0][..., :1]
    covered = read_exr(map_file(asset, name, "coverage", "exr"))[0][..., 0] > 0.5
    view = read_cameras(asset / "lookdev.usda")[index][0]
    if look == "standard":
        bsdf = surface(textures, name, eta=ior_from_f0(float(f0[covered].mean())))
    else:
        top, share = TOP, f0 / TOP
        if look == "neuface_basis":
            top, share = REFERENCE_F0, tint(asset, name, view.world_from_cam[:3, 3])[..., None]
        weight = np.repeat(share.clip(0, 1), 3, 2).astype(np.float32)
        bsdf = {
            "type": "blendbsdf",
            "weight": {"type": "bitmap", "bitmap": mi.Bitmap(weight), "raw": True, "wrap_mode": "clamp"},
            "none": surface(textures, name, eta=1.0001),
            "full": surface(textures, name, eta=ior_from_f0(top)),
        }
    normal = {"type": "normalmap", "normalmap": bitmap(textures / f"{name}_normal.png", True), "bsdf": bsdf}
    head = {
        "type": "obj",
        "filename": str(asset / f"{name}.obj"),
        "bsdf": {"type": "twosided", "bsdf": normal},
    }
    return traced(view, {"light": envmap(env or asset / "environment.exr"), "head": head}, side, spp)


def envmap(path: Path) -> dict[str, Any]:
    """A lat-long picture as the light."""
    return {"type": "envmap", "filename": str(path)}


def traced(view: PinholeCamera, scene: dict[str, Any], side: int, spp: int, depth: int = 6) -> np.ndarray:
    """(H, W, 4) of a scene from a camera without distortion and with its principal point in the middle."""
    to_world = view.world_from_cam @ np.diag([-1.0, -1, 1, 1])  # Mitsuba's cameras have +x to the left, +y up
    made = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": depth, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.degrees(2 * np.arctan(0.5 * view.width / view.K[0, 0]))),
                "to_world": mi.ScalarTransform4f(to_world.tolist()),
                "sampler": {"type": "multijitter", "sample_count": spp},
                "film": {
                    "type": "hdrfilm",
                    "width": side,
                    "height": round(side * view.height / view.width),
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
            },
            **scene,
        }
    )
    return np.array(mi.render(made))


def main() -> None:
    """See the module."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path)
    p.add_argument("index", type=int)
    p.add_argument("out", type=Path)
    p.add_argument("--look", choices=("standard", "openpbr", "neuface_basis"), default="standard")
    p.add_argument("--env", type=Path)
    p.add_argument("--side", type=int, default=256)
    p.add_argument("--spp", type=int, default=64)
    options = p.parse_args()
    asset = options.run / "asset"
    image = rendered(asset, options.index, options.look, options.env, options.side, options.spp)
    write_exr(options.out.with_suffix(".exr"), image.astype(np.float32))


if __name__ == "__main__":
    main()
