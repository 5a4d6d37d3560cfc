"""Which materials the tiles of a mesh have, and their names: a few faces, sorted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

from stages.usd.check.reader_checks import moves, reader_findings
from stages.usd.write.cage import CageSurface, TemplateMesh
from stages.usd.write.mesh import UvSurface
from stages.usd.write.tile_materials import names_on, skins, tile_materials

SQUARE = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]], np.float32)
VALUE = Sdf.ValueTypeNames


def surface(*at: int) -> UvSurface:
    """One triangle on each of these tiles."""
    points = np.arange(9 * len(at), dtype=np.float32).reshape(-1, 3)
    rows = np.arange(3 * len(at), dtype=np.int32).reshape(-1, 3)
    uvs = np.concatenate([SQUARE[:3] + [t, 0] for t in at]).astype(np.float32)
    return UvSurface(points, points, rows, uvs, rows)


def template(
    at: list[int], outer: list[bool], eyes: list[bool], rest: int | None = None, hair: int | None = None
) -> TemplateMesh:
    """A cage with one quad on each of these tiles."""
    quads = np.arange(4 * len(at)).reshape(-1, 4)
    uvs = np.concatenate([SQUARE + [t, 0] for t in at]).astype(np.float32)
    cage = CageSurface(
        np.zeros((quads.size, 3)), quads, uvs, quads, np.arange(quads.size), 1, np.array(eyes), np.array(outer)
    )
    parts = [None if t is None else surface(t) for t in (rest, hair)]
    return TemplateMesh(cage, surface(0), parts[0], np.zeros(0, np.float32), hair=parts[1])


def named(mesh: UvSurface | TemplateMesh, base: str = "captured") -> list[tuple[str, int, bool, bool]]:
    return [(m.name, m.tile, m.eyes, m.displaced) for m in tile_materials(mesh, base)]


def test_one_tile_keeps_its_name() -> None:
    assert named(surface(0)) == [("captured", 0, False, True)]
    assert named(surface(0), "captured_scan")[0][0] == "captured_scan"
    both = template([0, 0], [True, False], [False, True])
    assert named(both) == [("captured", 0, False, True), ("eyes", 0, True, True)]


def test_tiles_of_a_scan_have_numbers() -> None:
    assert [m[:2] for m in named(surface(0, 2, 1))] == [(f"captured_{1001 + t}", t) for t in (0, 1, 2)]


@pytest.mark.parametrize("fitted", [False, True])
def test_tiles_of_the_template_have_names(fitted: bool) -> None:
    found = named(template([0, 0, 1, 1], [True, True, False, False], [False, False, False, fitted], 2, 3))
    inside = [("mouth", 1, False, True), ("eyes", 1, True, True)] if fitted else [("eyes_and_mouth", 1, False, True)]
    beside = [("clothes", 2, False, False), ("hair", 3, False, False)]
    assert found == [("skin", 0, False, True), *inside, *beside]


def test_names_that_tiles_share_have_numbers() -> None:
    """A template of another layout: skin on two tiles, an eye on each of two."""
    found = named(template([0, 1, 2, 3], [True, True, False, False], [False, False, True, True], hair=4))
    assert [m[0] for m in found] == [
        "skin_1001", "skin_1002", "mouth_1003", "eyes_1003", "mouth_1004", "eyes_1004", "hair",
    ]  # fmt: skip


def test_the_dense_mesh_has_the_materials_of_its_tiles() -> None:
    materials = tile_materials(template([0, 1], [True, False], [False, True], 2))
    assert skins(materials) == ("skin", "mouth", "clothes")
    assert names_on(surface(0, 2), materials) == ("skin", "clothes")


# ------------------------------------------------------------------ checks of readers
def moved(scale: tuple[float, float], turn: float, shift: tuple[float, float], wrap: str = "clamp") -> Usd.Stage:
    """A quad whose material reads a picture through UsdTransform2d."""
    stage = Usd.Stage.CreateInMemory()
    mesh, path = UsdGeom.Mesh.Define(stage, "/mesh"), "/look"
    mesh.CreateFaceVertexCountsAttr([4])
    material = UsdShade.Material.Define(stage, path)
    made = {}
    for name, kind in (("st", "PrimvarReader_float2"), ("move", "Transform2d"), ("read", "UVTexture"),
                       ("surface", "PreviewSurface")):  # fmt: skip
        made[name] = UsdShade.Shader.Define(stage, f"{path}/{name}")
        made[name].CreateIdAttr(f"Usd{kind}")
    for target, name, source, output in (("move", "in", "st", "result"), ("read", "st", "move", "result"),
                                         ("surface", "diffuseColor", "read", "rgb")):  # fmt: skip
        given = made[target].CreateInput(name, VALUE.Float2)
        given.ConnectToSource(made[source].CreateOutput(output, VALUE.Float2))
    for name, kind, value in (("scale", VALUE.Float2, scale), ("rotation", VALUE.Float, turn),
                              ("translation", VALUE.Float2, shift)):  # fmt: skip
        made["move"].CreateInput(name, kind).Set(value)
    made["read"].CreateInput("file", VALUE.Asset).Set("./a.png")
    for name in ("wrapS", "wrapT"):
        made["read"].CreateInput(name, VALUE.Token).Set(wrap)
    material.CreateSurfaceOutput().ConnectToSource(made["surface"].CreateOutput("surface", VALUE.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return stage


@pytest.mark.parametrize(
    ("scale", "turn", "shift", "inside"),
    [
        ((1, 1), 0, (-2, 0), True),
        ((1, 1), 0, (-1, 0), False),
        ((1, 1), 0, (-2, 0.2), False),  # 0.9 + 0.2
        ((0.25, 1), 0, (0, 0), True),
        ((0.5, 1), 0, (-2, 0), False),  # the scale is applied before the translation
        ((1, 1), 90, (1, -2), True),  # (u, v) -> (-v, u): 1 - v, u - 2
        ((1, 1), -90, (1, -2), False),
    ],
)
def test_a_face_lies_in_the_picture_that_it_reads(
    scale: tuple[float, float], turn: float, shift: tuple[float, float], inside: bool
) -> None:
    """A quad on the third tile, from 2.1 to 2.9."""
    stage, st = moved(scale, turn, shift), SQUARE.astype(np.float64) + [2, 0]
    mesh = UsdGeom.Mesh.Get(stage, "/mesh")
    assert moves(mesh)
    assert [f.check for f in reader_findings(mesh, st)] == ([] if inside else ["st"])


def test_a_picture_that_repeats_has_no_outside() -> None:
    stage = moved((4, 4), 0, (0, 0), "repeat")
    assert not reader_findings(UsdGeom.Mesh.Get(stage, "/mesh"), SQUARE.astype(np.float64))
