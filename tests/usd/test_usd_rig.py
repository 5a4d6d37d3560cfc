"""Expressions and joints of the asset, as the USD library and a reader of glTF apply them."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt
from support.synthetic_asset import SyntheticInputs, run_stage
from support.synthetic_head import head_rig, template_inputs

from pipeline.registration.head import load_head
from stages.usd.check.validate import validate

NAMES = ("jawOpen", "cheekPuff")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> SyntheticInputs:
    return template_inputs(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def asset(inputs: SyntheticInputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rigged")
    made = run_stage(inputs, folder, render_views=False, high=False, obj=False)
    assert made.warnings == ()
    return folder / "asset"


def deformed(stage: Usd.Stage, path: str, weights: dict[str, float], jaw: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mesh at rest and as UsdSkel deforms them, with the jaw turned by so many degrees about x."""
    root = UsdSkel.Root(next(p for p in stage.Traverse() if p.IsA(UsdSkel.Root)))
    animation = UsdSkel.Animation(next(p for p in stage.Traverse() if p.IsA(UsdSkel.Animation)))
    shapes = list(animation.GetBlendShapesAttr().Get())
    animation.GetBlendShapeWeightsAttr().Set(Vt.FloatArray([weights.get(s, 0.0) for s in shapes]))
    turn = Gf.Rotation(Gf.Vec3d(1, 0, 0), jaw).GetQuat()
    joints = list(animation.GetJointsAttr().Get())
    animation.GetRotationsAttr().Set(
        Vt.QuatfArray([Gf.Quatf(turn) if j.endswith("jaw") else Gf.Quatf(1) for j in joints])
    )
    rest = np.array(UsdGeom.Mesh.Get(stage, path).GetPointsAttr().Get())
    UsdSkel.BakeSkinning(root, Gf.Interval(1, 1))
    points = UsdGeom.Mesh.Get(stage, path).GetPointsAttr()
    return rest, np.array(points.Get(points.GetTimeSamples()[0]) if points.GetTimeSamples() else points.Get())


def opened(file: Path) -> Usd.Stage:
    """A copy in memory: the tests change it."""
    layer = Usd.Stage.Open(str(file)).Flatten()
    stage = Usd.Stage.Open(layer)
    for p in stage.Traverse():
        if p.IsA(UsdSkel.Animation):  # a sample, so that there is a time to bake
            UsdSkel.Animation(p).GetBlendShapeWeightsAttr().Set([0.0] * len(NAMES), 1.0)
            UsdSkel.Animation(p).GetBlendShapeWeightsAttr().Clear()
    return stage


@pytest.mark.parametrize("name", NAMES)
def test_a_shape_moves_the_cage_as_the_rig_says(inputs: SyntheticInputs, asset: Path, name: str) -> None:
    rest, moved = deformed(opened(asset / "head.usd"), "/head/geo/render", {name: 0.5})
    rig, head = head_rig(), load_head(inputs.template.folder / "head.npz")
    i = rig.expressions.names.index(name)
    own = slice(int(rig.expressions.starts[i]), int(rig.expressions.starts[i + 1]))
    wanted = head.vertices.copy()
    wanted[rig.expressions.vertices[own]] += 0.5 * rig.expressions.offsets[own]
    rows = [int(np.linalg.norm(head.vertices - p, axis=1).argmin()) for p in rest]
    np.testing.assert_allclose(moved, wanted[rows], atol=1e-6)
    assert np.abs(moved - rest).max() > 1e-3


def test_the_proxy_follows_the_expressions(asset: Path) -> None:
    """It has the cage's vertices, on the surface."""
    rest, moved = deformed(opened(asset / "head.usd"), "/head/geo/proxy", {"jawOpen": 0.5})
    cage, open_ = deformed(opened(asset / "head.usd"), "/head/geo/render", {"jawOpen": 0.5})
    assert len(rest) == len(cage) and np.linalg.norm(rest - cage, axis=1).max() < 0.02
    np.testing.assert_allclose(moved - rest, open_ - cage, atol=1e-6)
    assert np.abs(moved - rest).max() > 1e-3


@pytest.mark.parametrize("file", ["head.usd", "head.usdz"])
def test_the_whole_head_is_in_the_box_of_what_moves_it(asset: Path, file: str) -> None:
    """Points at rest and with an open jaw; without the authored box, USD's own would miss what lies beside."""
    stage = opened(asset / file)
    root = next(p for p in stage.Traverse() if p.IsA(UsdSkel.Root))
    low, high = np.array(UsdGeom.Boundable(root).GetExtentAttr().Get(), np.float64)
    names = [str(p.GetPath()) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    for points in (x for name in names for x in deformed(opened(asset / file), name, {"jawOpen": 1.0})):
        assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()


@pytest.mark.parametrize("box", [None, [(-0.01, -0.01, -0.01), (0.01, 0.01, 0.01)]])
def test_a_box_that_is_missing_or_too_small_is_found(asset: Path, tmp_path: Path, box: list[Any] | None) -> None:
    copy = Path(shutil.copytree(asset, tmp_path / "asset"))
    stage = Usd.Stage.Open(str(copy / "payload.usdc"))
    extent = UsdGeom.Boundable(stage.GetPrimAtPath("/head/geo")).GetExtentAttr()
    extent.Clear() if box is None else extent.Set(Vt.Vec3fArray([Gf.Vec3f(*p) for p in box]))
    stage.GetRootLayer().Save()
    assert {f.check for f in validate(copy / "head.usd") if f.level == "error"} == {"extent"}


def test_the_jaw_turns_about_its_joint(asset: Path) -> None:
    rest, moved = deformed(opened(asset / "head.usd"), "/head/geo/render", {}, jaw=20.0)
    at, own = np.array([0, -0.01, 0.02]), np.linalg.norm(moved - rest, axis=1) > 1e-5
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    turned = (rest - at) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + at
    assert own.any()
    np.testing.assert_allclose(moved[own], 0.75 * turned[own] + 0.25 * rest[own], atol=1e-6)


def test_the_package_has_them_too(asset: Path) -> None:
    rest, moved = deformed(opened(asset / "head.usdz"), "/head/geo/render", {"jawOpen": 1.0})
    away = np.linalg.norm(moved - rest, axis=1)
    assert away.max() == pytest.approx(np.hypot(0.01, 0.002), rel=0.06) and (away < 1e-6).mean() > 0.3
    for file in ("head.usd", "head.usdz"):
        assert not [f for f in validate(asset / file) if f.level != "info"]


def test_they_can_be_left_out(inputs: SyntheticInputs, tmp_path: Path) -> None:
    run_stage(inputs, tmp_path, expressions=False, render_views=False, high=False, obj=False, usdz=False)
    stage = Usd.Stage.Open(str(tmp_path / "asset/head.usd"))
    assert not [p for p in stage.Traverse() if p.IsA(UsdSkel.BlendShape) or p.IsA(UsdSkel.Root)]
    assert "targets" not in document(tmp_path / "asset/head.glb")[0]["meshes"][0]["primitives"][0]


def document(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def values(gltf: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    """(count, 3) of an accessor, sparse or not."""

    def stored(view: int, kind: type, count: int) -> np.ndarray:
        return np.frombuffer(binary, kind, count, gltf["bufferViews"][view]["byteOffset"])

    a = gltf["accessors"][number]
    out = np.zeros((a["count"], 3), np.float32)
    if "bufferView" in a:
        out = stored(a["bufferView"], np.float32, 3 * a["count"]).reshape(-1, 3).copy()
    if "sparse" in a:
        s = a["sparse"]
        kind = {5123: np.uint16, 5125: np.uint32}[s["indices"]["componentType"]]
        rows = stored(s["indices"]["bufferView"], kind, s["count"])
        assert (np.diff(rows.astype(int)) > 0).all()  # glTF asks for it
        out[rows] = stored(s["values"]["bufferView"], np.float32, 3 * s["count"]).reshape(-1, 3)
    np.testing.assert_allclose(out.min(0), a["min"], atol=1e-7)
    np.testing.assert_allclose(out.max(0), a["max"], atol=1e-7)
    return out


def test_gltf_has_morph_targets_with_normals(asset: Path) -> None:
    gltf, binary = document(asset / "head.glb")
    head, rest = gltf["meshes"]
    assert tuple(head["extras"]["targetNames"]) == NAMES and head["weights"] == [0.0, 0.0]
    assert all("targets" not in p for p in rest["primitives"]) and gltf["scenes"][0]["nodes"] == [0, 1]
    moved = 0
    for p in head["primitives"]:
        assert len(p["targets"]) == 2
        points = values(gltf, binary, p["attributes"]["POSITION"])
        normals = np.frombuffer(
            binary, np.float32, points.size,
            gltf["bufferViews"][gltf["accessors"][p["attributes"]["NORMAL"]]["bufferView"]]["byteOffset"],
        ).reshape(-1, 3)  # fmt: skip
        for target in p["targets"]:
            offsets, bent = values(gltf, binary, target["POSITION"]), values(gltf, binary, target["NORMAL"])
            assert len(offsets) == len(points) and np.abs(bent[(offsets == 0).all(1)]).max(initial=0) == 0
            assert np.linalg.norm(normals + bent, axis=1).min() > 0.5
            moved += int((offsets != 0).any(1).sum())
    assert moved > 100


def test_a_shapes_normals_are_those_of_the_moved_mesh() -> None:
    """A flat square whose middle is lifted: beside it the normals tilt away, by half of a roof's slope."""
    from types import SimpleNamespace

    from stages.usd.write.gltf import bent_normals
    from stages.usd.write.mesh import UvSurface

    y, x = np.mgrid[0:5, 0:5]
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(np.float32)
    at = np.arange(25).reshape(5, 5)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    rows = np.array([7, 11, 12, 13, 17])
    offsets = np.where((rows == 12)[:, None], [0.0, 0, 0.5], 0.0)
    rig: Any = SimpleNamespace(weights=np.zeros((25, 2)), shapes=[SimpleNamespace(rows=rows, offsets=offsets)])
    mesh = UvSurface(points, np.tile(np.float32([0, 0, 1]), (25, 1)), faces, points[:, :2] / 4, faces)
    (bent,) = bent_normals(mesh, rig)
    moved = points.astype(float)
    moved[rows] += offsets
    corners = moved[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((25, 3))
    np.add.at(total, faces.ravel(), np.repeat(across, 3, 0))
    wanted = total / np.linalg.norm(total, axis=1, keepdims=True) - [0, 0, 1]
    np.testing.assert_allclose(bent, wanted[rows], atol=1e-6)
    assert bent[1, 0] < -0.1 < 0.1 < bent[3, 0], "left and right of the middle"
