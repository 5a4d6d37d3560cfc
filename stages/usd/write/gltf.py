"""Writes NAME.glb: the same asset for the web and for game engines, in one binary file.

Core metallic-roughness material with metallic 0, and KHR_materials_specular: reflectance at normal incidence is

    F0 = 0.04 * specularColorFactor * specularColorTexture

whose texture is sRGB-encoded F0 over its largest value, so that eight bits are enough. The origin of texture
coordinates is top left in glTF, so v becomes 1 - v. glTF has no UDIM tiles: each tile becomes a primitive with its own
material and coordinates in the unit square. The same content gives the same bytes.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.colour import srgb_from_linear
from pipeline.images import read_encoded, read_exr
from stages.usd.write.mesh import UvSurface, on_tile, tile_count
from stages.usd.write.package import bounded_png
from stages.usd.write.shading import Look

FLOAT, UINT, ARRAY_BUFFER, ELEMENT_BUFFER = 5126, 5125, 34962, 34963
LINEAR, LINEAR_MIPMAPS, CLAMP = 9729, 9987, 33071
DIELECTRIC_F0 = 0.04
MIN_TOP, LARGEST_TOP = 0.02, 0.16  # range of F0's largest value: outliers of a fit must not use up the eight bits


class _Binary:
    """The binary chunk, its buffer views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        if target is not None:
            self.views[-1]["target"] = target
        self.data += content
        return len(self.views) - 1

    def accessor(self, values: npt.NDArray[Any], kind: str, target: int, *, bounds: bool = False) -> int:
        found: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(values).tobytes(), target),
            "componentType": UINT if values.dtype == np.uint32 else FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            found |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append(found)
        return len(self.accessors) - 1


def corners(mesh: UvSurface) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint32]]:
    """Vertices split at seams: (N,) indices into the vertices and into the uvs, and faces (F, 3) into these."""
    pairs = np.stack([mesh.faces.ravel(), mesh.uv_faces.ravel()], -1).astype(np.int64)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    return unique[:, 0], unique[:, 1], inverse.reshape(-1, 3).astype(np.uint32)


def write_glb(path: Path, name: str, mesh: UvSurface, look: Look, folder: Path, metadata: dict[str, str]) -> None:
    """Write the file. `folder`: base of the look's paths. `metadata`: from the user."""
    binary, count = _Binary(), tile_count(mesh)
    looks = [look.on_tile(t) for t in range(count)]
    primitives = [_primitive(on_tile(mesh, t, count), t, binary) for t in range(count)]
    images: list[dict[str, Any]] = []
    names = [name] if count == 1 else [f"{name}_{tiles.FIRST + t}" for t in range(count)]
    top = max((_top(folder / x.f0) for x in looks if x.f0), default=0.0)
    materials = [_material(n, x, folder, binary, images, top) for n, x in zip(names, looks, strict=True)]
    asset: dict[str, Any] = {"version": "2.0", "generator": "NeuFace Asset"}
    if metadata:
        asset["extras"] = metadata
        if "license" in metadata:
            asset["copyright"] = metadata["license"]
    document = {
        "asset": asset,
        "extensionsUsed": sorted(materials[0].get("extensions", {})),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"name": name, "primitives": primitives}],
        "materials": materials,
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAPS, "wrapS": CLAMP, "wrapT": CLAMP}],
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "images": images,
        "accessors": binary.accessors,
        "bufferViews": binary.views,
    }
    binary.data += bytes(-len(binary.data) % 4)
    document["buffers"] = [{"byteLength": len(binary.data)}]
    document = {k: v for k, v in document.items() if v != []}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as f:
        f.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary.data)))
        f.write(struct.pack("<I4s", len(text), b"JSON") + text)
        f.write(struct.pack("<I4s", len(binary.data), b"BIN\0") + bytes(binary.data))


def _primitive(mesh: UvSurface, material: int, binary: _Binary) -> dict[str, Any]:
    vertex, uv, faces = corners(mesh)
    points, normals = mesh.vertices[vertex].astype(np.float32), mesh.normals[vertex].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    st = mesh.uvs[uv].clip(0, 1).astype(np.float32)
    return {
        "attributes": {
            "POSITION": binary.accessor(points, "VEC3", ARRAY_BUFFER, bounds=True),
            "NORMAL": binary.accessor(normals.astype(np.float32), "VEC3", ARRAY_BUFFER),
            "TEXCOORD_0": binary.accessor(np.stack([st[:, 0], 1 - st[:, 1]], -1), "VEC2", ARRAY_BUFFER),
        },
        "indices": binary.accessor(faces.ravel(), "SCALAR", ELEMENT_BUFFER),
        "material": material,
    }


def _top(f0: Path) -> float:
    """The largest F0 of a map, without outliers."""
    return float(np.clip(np.percentile(read_exr(f0)[0][..., 0], 99.9), MIN_TOP, LARGEST_TOP))


def _material(
    name: str, look: Look, folder: Path, binary: _Binary, images: list[dict[str, Any]], top: float
) -> dict[str, Any]:
    """The material. `top`: the F0 of the texture's largest value."""

    def add(kind: str, content: bytes) -> dict[str, int]:
        images.append({"name": f"{name}_{kind}", "mimeType": "image/png", "bufferView": binary.view(content)})
        return {"index": len(images) - 1}

    surface: dict[str, Any] = {
        "baseColorTexture": add("albedo", bounded_png(folder / look.albedo)),
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0 if look.roughness else 0.5,
    }
    out: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface}
    if look.roughness:
        rough = read_encoded(folder / look.roughness)[..., :1]
        packed = np.concatenate([np.full_like(rough, np.iinfo(rough.dtype).max), rough, np.zeros_like(rough)], -1)
        surface["metallicRoughnessTexture"] = add("roughness", bounded_png(packed))
    if look.normal:
        out["normalTexture"] = add("normal", bounded_png(folder / look.normal))
    if look.f0:
        f0 = read_exr(folder / look.f0)[0][..., 0]
        stored = np.repeat(srgb_from_linear((f0 / top).clip(0, 1))[..., None], 3, -1)
        bits = np.round(stored * 255).astype(np.uint8)
        specular = {
            "specularColorTexture": add("specular_color", bounded_png(bits)),
            "specularColorFactor": [round(top / DIELECTRIC_F0, 6)] * 3,
        }
        out["extensions"] = {"KHR_materials_specular": specular}
    return out
