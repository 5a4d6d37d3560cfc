"""Writes NAME.glb: the same asset for the web and for game engines, in one binary file.

Core metallic-roughness material with metallic 0, and KHR_materials_specular: reflectance at normal incidence is

    F0 = 0.04 * specularColorFactor * specularColorTexture

whose texture is sRGB-encoded F0 over its largest value, so that eight bits are enough. The origin of texture
coordinates is top left in glTF, so v becomes 1 - v. glTF has no UDIM tiles: each tile becomes a primitive with its own
material and coordinates in the unit square. The same content gives the same bytes.

Fitted eyes are a primitive with a material of its own: the colours of their tile, and KHR_materials_ior of the cornea.

Expressions are morph targets of the primitives that they move, as sparse accessors: offsets of positions and normals
at the moved vertices only. Primitives of one mesh must have the same targets, so what no expression moves is a second
mesh. Hair is a mesh and a node of its own: the file has no joints, so that it stays with the head.
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
from pipeline.eyes.material import IOR, ROUGHNESS
from pipeline.images import read_encoded, read_exr, stepped
from pipeline.meshes import F32, Indices, Mask, split_at_seams, vertex_normals
from stages.usd.write.eyes import EYES
from stages.usd.write.mesh import UvSurface, tile_count
from stages.usd.write.package import bounded_png
from stages.usd.write.pieces import pieces
from stages.usd.write.rig import MeshRig
from stages.usd.write.shading import Look
from stages.usd.write.variants import HAIR

FLOAT, UINT, USHORT, ARRAY_BUFFER, ELEMENT_BUFFER = 5126, 5125, 5123, 34962, 34963
LINEAR, LINEAR_MIPMAPS, CLAMP = 9729, 9987, 33071
COMPONENTS = {np.float32: FLOAT, np.uint32: UINT, np.uint16: USHORT}
DIELECTRIC_F0 = 0.04
# Steps of a morph target's offsets (m) and of its changes of normals: without noise they take a third of the room in a
# page.
OFFSET_STEP, TURN_STEP = 2.0**-18, 2.0**-8
MIN_TOP, LARGEST_TOP = 0.02, 0.16  # range of F0's largest value: outliers of a fit must not use up the eight bits


class _Binary:
    """The binary chunk, its buffer views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []
        self.last: tuple[bytes, int] | None = None  # the rows of the latest sparse accessor

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
            "componentType": COMPONENTS[values.dtype.type],
            "count": len(values),
            "type": kind,
        }
        if bounds:
            found |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append(found)
        return len(self.accessors) - 1

    def sparse(self, rows: npt.NDArray[np.integer], values: F32, count: int) -> int:
        """`count` vectors that are 0 but for rows (n,) ascending, where they are values (n, 3). The rows are stored
        once for accessors that follow each other."""
        full = np.concatenate([values, np.zeros((int(len(rows) < count), 3), np.float32)])
        found: dict[str, Any] = {"componentType": FLOAT, "count": count, "type": "VEC3"}
        found |= {"min": full.min(0).tolist(), "max": full.max(0).tolist()}
        if len(rows):
            index = np.ascontiguousarray(rows, _index(count))
            found["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": self._rows(index.tobytes()), "componentType": COMPONENTS[index.dtype.type]},
                "values": {"bufferView": self.view(np.ascontiguousarray(values, np.float32).tobytes())},
            }
        self.accessors.append(found)
        return len(self.accessors) - 1

    def _rows(self, content: bytes) -> int:
        if self.last is None or self.last[0] != content:
            self.last = (content, self.view(content))
        return self.last[1]


def write_glb(
    path: Path,
    name: str,
    mesh: UvSurface,
    look: Look,
    folder: Path,
    metadata: dict[str, str],
    rig: MeshRig | None = None,
    eyes: Mask | None = None,
    hair: Look | None = None,
) -> None:
    """Write the file. `folder`: base of the look's paths. `metadata`: from the user. rig: of the mesh's first vertices;
    eyes (n,): of its first triangles, those with the eyes' material; hair: the look of the last tile, if that is
    hair."""
    binary, count = _Binary(), tile_count(mesh)
    looks = [(look if hair is None or t < count - 1 else hair).on_tile(t) for t in range(count)]
    bent = [] if rig is None else bent_normals(mesh, rig)
    meshes: list[dict[str, Any]] = []
    moving: list[dict[str, Any]] = []
    still: list[dict[str, Any]] = []
    hairs: list[dict[str, Any]] = []
    wet: list[int] = []  # tiles with eyes
    for piece in pieces(mesh, count, eyes):
        part = piece.mesh
        if piece.eyes:
            wet.append(piece.tile)
        made = _primitive(part, count + len(wet) - 1 if piece.eyes else piece.tile, binary)
        if rig is not None and part.faces.max() < len(rig.weights):
            made["targets"] = _targets(split_at_seams(part.faces, part.uv_faces)[0], rig, bent, binary)
        is_hair = hair is not None and piece.tile == count - 1
        (hairs if is_hair else moving if "targets" in made else still).append(made)
    if moving and rig is not None:
        names = [s.name for s in rig.shapes]
        meshes.append(
            {"name": name, "primitives": moving, "weights": [0.0] * len(names), "extras": {"targetNames": names}}
        )
    if still:
        meshes.append({"name": f"{name}_rest" if moving else name, "primitives": still})
    if hairs:
        meshes.append({"name": f"{name}_{HAIR}", "primitives": hairs})
    images: list[dict[str, Any]] = []
    names = [name] if count == 1 else [f"{name}_{tiles.FIRST + t}" for t in range(count)]
    if hair is not None:
        names[-1] += f"_{HAIR}"
    top = max((_top(folder / x.f0) for x in looks if x.f0), default=0.0)
    materials = [_material(n, x, folder, binary, images, top) for n, x in zip(names, looks, strict=True)]
    if hair is not None:
        materials[-1]["doubleSided"] = True  # an open shell, which is seen from inside at its rim
    materials += [_eye_material(names[t], materials[t]) for t in wet]
    asset: dict[str, Any] = {"version": "2.0", "generator": "NeuFace Asset"}
    if metadata:
        asset["extras"] = metadata
        if "license" in metadata:
            asset["copyright"] = metadata["license"]
    document = {
        "asset": asset,
        "extensionsUsed": sorted({e for m in materials for e in m.get("extensions", {})}),
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": i, "name": m["name"]} for i, m in enumerate(meshes)],
        "meshes": meshes,
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
    vertex, uv, faces = split_at_seams(mesh.faces, mesh.uv_faces)
    points, normals = mesh.vertices[vertex].astype(np.float32), mesh.normals[vertex].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    st = mesh.uvs[uv].clip(0, 1).astype(np.float32)
    return {
        "attributes": {
            "POSITION": binary.accessor(points, "VEC3", ARRAY_BUFFER, bounds=True),
            "NORMAL": binary.accessor(normals.astype(np.float32), "VEC3", ARRAY_BUFFER),
            "TEXCOORD_0": binary.accessor(np.stack([st[:, 0], 1 - st[:, 1]], -1), "VEC2", ARRAY_BUFFER),
        },
        "indices": binary.accessor(faces.ravel().astype(_index(len(vertex))), "SCALAR", ELEMENT_BUFFER),
        "material": material,
    }


def bent_normals(mesh: UvSurface, rig: MeshRig) -> list[F32]:
    """For each expression the change (n, 3) of the triangles' normals at the vertices that it moves."""
    own = np.asarray(mesh.faces[(mesh.faces < len(rig.weights)).all(1)])
    vertices = mesh.vertices[: len(rig.weights)].astype(np.float64)
    smooth, out = vertex_normals(vertices, own), []
    for shape in rig.shapes:
        moved = vertices.copy()
        moved[shape.rows] += shape.offsets
        out.append((vertex_normals(moved, own) - smooth)[shape.rows])
    return out


def _targets(vertex: Indices, rig: MeshRig, bent: list[F32], binary: _Binary) -> list[dict[str, int]]:
    """The morph targets of a primitive whose corners have the mesh's vertices `vertex` (n,)."""
    out = []
    for shape, turned in zip(rig.shapes, bent, strict=True):
        row = np.full(len(rig.weights), -1, np.int64)
        row[shape.rows] = np.arange(len(shape.rows))
        corner = np.flatnonzero(row[vertex] >= 0)
        at = row[vertex[corner]]
        out.append(
            {
                "POSITION": binary.sparse(corner, stepped(shape.offsets[at], OFFSET_STEP), len(vertex)),
                "NORMAL": binary.sparse(corner, stepped(turned[at], TURN_STEP), len(vertex)),
            }
        )
    return out


def _index(count: int) -> type[np.uint16] | type[np.uint32]:
    """The type of indices of `count` vertices; the largest value of a type means a restart."""
    return np.uint16 if count <= np.iinfo(np.uint16).max else np.uint32


def _eye_material(name: str, skin: dict[str, Any]) -> dict[str, Any]:
    """The eyes' material beside that of their tile, whose colours it shows."""
    surface = {"baseColorTexture": skin["pbrMetallicRoughness"]["baseColorTexture"], "metallicFactor": 0.0}
    return {
        "name": f"{name}_{EYES}",
        "pbrMetallicRoughness": surface | {"roughnessFactor": ROUGHNESS},
        "extensions": {"KHR_materials_ior": {"ior": IOR}},
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
