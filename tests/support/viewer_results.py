"""Results of a run with a glb, an expression, levels of detail and a displacement map, for the 3D view."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom
from support.synthetic_results import SyntheticResults

from pipeline.artifacts import FileRef, Located, TextureMap
from pipeline.images import write_exr, write_png
from stages.usd.write.gltf import write_glb
from stages.usd.write.mesh import UvSurface, read_mesh
from stages.usd.write.shading import Look

OUT_MM = 5.0  # of the displacement map: everywhere


def with_glb(results: SyntheticResults) -> SyntheticResults:
    """The results with a glb that has one expression: the head grows by half; and with two landmarks."""
    usd, mesh = results.usd, read_mesh(results.uv.path(results.uv.artifact.mesh))
    look = Look("albedo.png", "roughness.png", "normal.png", 1.4, (0.5, 0.4, 0.3), f0="f0.exr")
    path = usd.folder / "asset/head.glb"
    write_glb(path, "head", mesh, look, results.bake.folder, {})
    path.write_bytes(with_expression(path.read_bytes()))
    write_levels(usd.folder / "asset", mesh)
    added = ("head.glb", "payload.usdc", "high.usdc")
    files = (*usd.artifact.files, *(FileRef.of(usd.folder, f"asset/{name}") for name in added))
    masks = results.masks
    np.savez(masks.folder / "landmarks.npz", xyz=[[0.0, 0.1, 0.09], [0.03, 0, 0.1], [np.nan] * 3])
    marks = {"landmarks": FileRef.of(masks.folder, "landmarks.npz"), "label_names": ("none", "skin", "hair")}
    plain = results.bake.artifact
    write_exr(results.bake.folder / "out.exr", np.full((64, 64, 1), OUT_MM, np.float32))
    exr = {"exr": FileRef.of(results.bake.folder, "out.exr")}
    level = {"minimum": OUT_MM, "mean": OUT_MM, "maximum": OUT_MM}
    out = TextureMap(name="displacement", channels=1, files=exr, space="raw", **level)
    write_png(results.bake.folder / "open.png", np.linspace(0.2, 1, 64)[:, None].repeat(64, 1))
    halves = np.repeat([[1, 2]], [32, 32], 1).repeat(64, 0) / 255  # codes of two labels, left and right
    write_png(results.bake.folder / "region.png", halves)
    region = out.model_copy(update={"name": "region", "files": {"png": FileRef.of(results.bake.folder, "region.png")}})
    shade = {"name": "ambient_occlusion", "files": {"png": FileRef.of(results.bake.folder, "open.png")}}
    more = {"displacement": out, "region": region, "ambient_occlusion": out.model_copy(update=shade)}
    baked = plain.model_copy(update={"scan": plain, "maps": {**plain.maps, **more}})
    return replace(
        results,
        bake=Located(baked, results.bake.folder),
        usd=Located(usd.artifact.model_copy(update={"files": files}), usd.folder),
        masks=Located(masks.artifact.model_copy(update=marks), masks.folder),
    )


def write_levels(folder: Path, mesh: UvSurface) -> None:
    """payload.usdc with a proxy that equals the mesh and a smaller scan, and high.usdc with a larger one."""
    for file, sizes in (("payload.usdc", {"proxy": 1.0, "scan": 0.8}), ("high.usdc", {"high": 1.2})):
        stage = Usd.Stage.CreateNew(str(folder / file))
        for name, size in sizes.items():
            made = UsdGeom.Mesh.Define(stage, f"/head/geo/{name}" if name != "high" else "/high")
            made.CreatePointsAttr((size * mesh.vertices).astype(np.float32).tolist())
            made.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
            made.CreateFaceVertexIndicesAttr(mesh.faces.ravel().tolist())
            kind, each = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
            st = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", kind, each)
            st.Set(mesh.uvs.tolist())
            st.SetIndices(mesh.uv_faces.ravel().tolist())
        stage.Save()


def with_expression(glb: bytes) -> bytes:
    """A morph target "jawOpen" whose offsets are half of the positions."""
    size = struct.unpack("<I", glb[12:16])[0]
    document, binary = json.loads(glb[20 : 20 + size]), bytearray(glb[28 + size :])
    mesh = document["meshes"][0]
    accessor = document["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]]
    view = document["bufferViews"][accessor["bufferView"]]
    start = view["byteOffset"]
    points = np.frombuffer(bytes(binary[start : start + view["byteLength"]]), np.float32) * np.float32(0.5)
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": points.nbytes})
    bounds = {k: [0.5 * x for x in accessor[k]] for k in ("min", "max")}
    document["accessors"].append({**accessor, **bounds, "bufferView": len(document["bufferViews"]) - 1})
    mesh["primitives"][0]["targets"] = [{"POSITION": len(document["accessors"]) - 1}]
    mesh["extras"], mesh["weights"] = {"targetNames": ["jawOpen"]}, [0]
    binary += points.tobytes()
    document["buffers"] = [{"byteLength": len(binary)}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + bytes(binary)
