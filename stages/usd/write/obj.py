"""Writes NAME.obj and NAME.mtl, for tools without USD. The maps are those in textures/.

The format has no UDIM tiles: each becomes a material of its own, with texture coordinates in the unit square.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline import tiles
from pipeline.meshes import Charts
from stages.usd.write.mesh import UvSurface, faces_of, tile_count
from stages.usd.write.shading import MATERIAL, Look
from stages.usd.write.variants import HAIR


def write_obj(folder: Path, name: str, mesh: UvSurface, look: Look, hair: Look | None = None) -> list[Path]:
    """Write the files: metres, +Y up, as the asset. Indices start at 1; v, vt and vn are indexed separately. hair: the
    look of the last tile, if that is hair, which becomes an object of its own."""
    count = tile_count(mesh)
    sizes, corners, uv_corners = faces_of(mesh)
    tile = tiles.of_face(Charts(mesh.uvs, mesh.uv_faces))
    home = np.zeros((len(mesh.uvs), 2), np.float32)
    home[mesh.uv_faces.ravel(), 0] = np.repeat(tile, 3)
    of_face = home[uv_corners[np.cumsum(sizes) - sizes], 0].astype(int).tolist()
    texts = [f"{a}/{p}" for a, p in zip((corners + 1).tolist(), (uv_corners + 1).tolist(), strict=True)]
    ends = np.cumsum(sizes).tolist()
    faces = ["f " + " ".join(texts[end - n : end]) for n, end in zip(sizes.tolist(), ends, strict=True)]
    lines = ["# Captured head, metres, +Y up. Made by NeuFace Asset.", f"mtllib {name}.mtl", f"o {name}"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices.tolist()]  # a micrometre
    lines += [f"vt {u:.5f} {v:.5f}" for u, v in (mesh.uvs - home).clip(0, 1).tolist()]
    materials = []
    for t in range(count):
        called, own = MATERIAL if count == 1 else f"{MATERIAL}_{tiles.FIRST + t}", look
        if hair is not None and t == count - 1:
            called, own = HAIR, hair
            lines.append(f"o {name}_{HAIR}")
        materials += _material(called, own.on_tile(t))
        lines += [f"usemtl {called}", "s 1"]
        lines += [face for face, at in zip(faces, of_face, strict=True) if at == t]
    obj, mtl = folder / f"{name}.obj", folder / f"{name}.mtl"
    obj.write_text("\n".join(lines) + "\n")
    mtl.write_text("\n".join(materials) + "\n")
    return [obj, mtl]


def _material(name: str, look: Look) -> list[str]:
    """Kd and its map (sRGB), F0 as Ks and as Ni, and the PBR extension of MTL: roughness and normal map (raw)."""
    f0 = ((look.ior - 1) / (look.ior + 1)) ** 2
    maps = {"map_Kd": look.albedo, "map_Pr": look.roughness, "norm": look.normal}
    return [
        f"newmtl {name}",
        "Kd 1 1 1",
        f"Ks {f0:.5f} {f0:.5f} {f0:.5f}",
        f"Ni {look.ior:.5f}",
        "Pm 0",
        "illum 2",
        *(f"{key} {file.removeprefix('./')}" for key, file in maps.items() if file),
    ]
