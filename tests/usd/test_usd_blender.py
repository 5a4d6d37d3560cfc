"""The script that opens an asset in Blender: what it asks of Blender (a stand-in), and what Blender makes of it.

The second needs Blender: `NEUFACE_BLENDER` names a `blender`, or a Python that has Blender's module `bpy`.
"""

from __future__ import annotations

import inspect
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from support.synthetic_asset import run_stage
from support.synthetic_head import template_inputs

from pipeline.artifacts import Camera
from stages.usd.render.exported import read_usd_mesh
from stages.usd.write import export
from stages.usd.write.export import BLENDER

VIEWS, WIDTH, HEIGHT = (0, 3, 6, 9, 12), 96, 120  # of the synthetic asset; their photos are 0.png, 3.png, ...


class Images(list):
    """bpy.data.images: loads a picture's size as Blender does, which ignores a photo's EXIF orientation."""

    def load(self, path: str, check_existing: bool) -> SimpleNamespace:
        height, width = cv2.imread(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION).shape[:2]
        self.append(SimpleNamespace(size=(width, height), path=Path(path)))
        return self[-1]


def camera(name: str) -> SimpleNamespace:
    data = SimpleNamespace(sensor_width=36.0, sensor_height=54.0, background_images=MagicMock())
    return SimpleNamespace(name=name, type="CAMERA", data=data, modifiers=[], material_slots=[])


def stand_in(names: list[str]) -> Any:
    """As much of bpy as the script uses; the importer makes these cameras and a displaced, subdivided mesh."""
    output = SimpleNamespace(type="OUTPUT_MATERIAL", inputs={"Displacement": SimpleNamespace(is_linked=True)})
    material = SimpleNamespace(node_tree=SimpleNamespace(nodes=[output]), displacement_method="BUMP")
    cage = SimpleNamespace(name="render", type="MESH", modifiers=[SimpleNamespace(type="SUBSURF", levels=1)],
                           material_slots=[SimpleNamespace(material=material)])  # fmt: skip
    scene = MagicMock(objects=[*(camera(f"{n}.001") for n in names), cage])
    scene.name = "scene"
    bpy = MagicMock(path=SimpleNamespace(abspath=lambda p: p))
    bpy.data.scenes.new.return_value = scene
    bpy.data.texts, bpy.data.images = [], Images()
    space = SimpleNamespace(region_3d=SimpleNamespace(), shading=SimpleNamespace())
    area = SimpleNamespace(type="VIEW_3D", spaces=SimpleNamespace(active=space))
    bpy.context.window_manager.windows = [SimpleNamespace(screen=SimpleNamespace(areas=[area]))]
    known = {"import_cameras": 0, "import_lights": 0, "create_world_material": 0, "import_subdivision": 0}
    bpy.ops.wm.usd_import.get_rna_type.return_value.properties = known
    return SimpleNamespace(bpy=bpy, scene=scene, cage=cage, material=material, space=space)


@pytest.fixture
def asset(exported, tmp_path: Path) -> Path:
    shutil.copytree(exported[0] / "asset", tmp_path / "out/asset")
    return tmp_path / "out/asset"


def opened(asset: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> Any:
    """The stand-in after the script ran in it."""
    made = stand_in([f"view_{i}" for i in VIEWS] + ["main_cam"])
    monkeypatch.setitem(sys.modules, "bpy", made.bpy)
    monkeypatch.setattr(sys, "argv", ["blender", "--python", "open_in_blender.py", "--", *words])
    runpy.run_path(str(asset / BLENDER), run_name="__main__")
    return made


def shown(made: Any) -> dict[str, Path]:
    """The photo behind each camera that has one."""
    out = {}
    for thing in made.scene.objects:
        if thing.type == "CAMERA" and getattr(thing.data, "show_background_images", False):
            out[thing.name.partition(".")[0]] = thing.data.background_images.new.return_value.image.path
    return out


def write_photo(path: Path, width: int = WIDTH, height: int = HEIGHT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((height, width, 3), np.uint8))


def test_it_asks_blender_for_the_scene_of_the_photos(asset: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    made = opened(asset, monkeypatch)
    called = made.bpy.ops.wm.usd_import.call_args.kwargs
    assert called == {"filepath": str(asset / "lookdev.usda"), "import_cameras": True, "import_lights": True,
                      "create_world_material": True, "import_subdivision": True}  # fmt: skip
    assert made.scene.world is made.bpy.data.worlds.new.return_value  # before the import, or the light is dropped
    assert made.bpy.context.window.scene is made.scene
    text = (asset / "lookdev.usda").read_text()
    first = text.partition("references = </head/lookdev/cameras/")[2].partition(">")[0]
    assert made.scene.camera.name == f"{first}.001" and made.scene.camera.data.sensor_fit == "HORIZONTAL"
    render, view = made.scene.render, made.scene.view_settings
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (WIDTH, HEIGHT, 100)
    assert (render.pixel_aspect_x, render.pixel_aspect_y) == (1.0, pytest.approx(1.2))  # (54 mm / 120) / (36 mm / 96)
    assert (view.view_transform, view.look, view.exposure, view.gamma) == ("Standard", "None", 0.0, 1.0)
    assert (made.cage.modifiers[0].levels, made.cage.modifiers[0].render_levels) == (2, 2)
    assert made.material.displacement_method == "BOTH"
    assert made.space.region_3d.view_perspective == "CAMERA" and made.space.shading.use_scene_world
    assert "--photos FOLDER names them" in capsys.readouterr().out
    assert not shown(made) and not made.bpy.ops.render.render.called


def test_it_renders_what_it_is_asked_to(asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = opened(asset, monkeypatch, "--render", str(tmp_path / "a.png"), "--samples", "4")
    assert made.scene.cycles.samples == 4 and made.scene.render.filepath == str(tmp_path / "a.png")
    made.bpy.ops.render.render.assert_called_once_with(write_still=True, scene="scene")


def test_it_stays_short() -> None:
    """A user reads it before running it."""
    lines = Path(inspect.getfile(export)).with_name(BLENDER).read_text().partition("import argparse")[2].splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 68


def test_photos_of_the_users_folder_are_behind_the_cameras(
    asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a photo that lies on its side in the file no picture is shown: it would not match."""
    write_photo(tmp_path / "mine/0.png", WIDTH // 2, HEIGHT // 2)
    write_photo(tmp_path / "mine/3.png", HEIGHT, WIDTH)
    made = opened(asset, monkeypatch, "--photos", str(tmp_path / "mine"))
    assert shown(made) == {"view_0": tmp_path / "mine/0.png"}
    behind = made.scene.objects[0].data.background_images.new.return_value
    assert (behind.display_depth, behind.frame_method, behind.alpha) == ("BACK", "STRETCH", 1.0)


def test_the_runs_upright_copies_are_behind_the_cameras(
    asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    store = tmp_path / "store"
    write_photo(store / "capture/KEY/photos/0_0.png")
    views = [{"index": 0, "image": {"path": "photos/0_0.png"}}, {"index": 3, "image": {"path": "photos/gone.png"}}]
    (store / "capture/KEY/manifest.json").write_text(json.dumps({"views": views}))
    run = {"store": str(store), "stages": {"capture": {"key": "KEY"}}}
    (asset.parent / "run.json").write_text(json.dumps(run))
    assert shown(opened(asset, monkeypatch)) == {"view_0": store / "capture/KEY/photos/0_0.png"}
    shutil.rmtree(store)  # as after `store gc`
    assert not shown(opened(asset, monkeypatch)) and "--photos FOLDER names them" in capsys.readouterr().out


@pytest.mark.parametrize("record", ["", "[]", '{"store": 3}'])
def test_without_a_usable_record_there_are_no_photos(asset: Path, record: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (asset.parent / "run.json").write_text(record)
    assert not shown(opened(asset, monkeypatch))


def test_in_the_text_editor_the_texts_path_tells_the_folder(asset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = stand_in([f"view_{i}" for i in VIEWS])
    made.bpy.data.texts = [SimpleNamespace(name="open_in_blender.py", filepath=str(asset / BLENDER))]
    monkeypatch.setitem(sys.modules, "bpy", made.bpy)
    monkeypatch.setattr(sys, "argv", ["blender"])
    space = {"__name__": "__main__", "__file__": "/nowhere/scene.blend/open_in_blender.py"}
    exec(compile((asset / BLENDER).read_text(), BLENDER, "exec"), space)
    assert made.bpy.ops.wm.usd_import.call_args.kwargs["filepath"] == str(asset / "lookdev.usda")
    made.bpy.data.texts = []
    with pytest.raises(FileNotFoundError, match="leave the script in the asset's folder"):
        exec(compile((asset / BLENDER).read_text(), BLENDER, "exec"), space)


# ------------------------------------------------------------------ Blender itself
PROBE = """
import json, runpy, sys, bpy
runpy.run_path(sys.argv[sys.argv.index("--") - 1], run_name="__main__")
scene = bpy.context.scene
found = {o.name: [(m.levels, m.render_levels) for m in o.modifiers if m.type == "SUBSURF"] for o in scene.objects}
methods = {s.material.name: s.material.displacement_method for o in scene.objects for s in o.material_slots}
world = [n.image.name for n in scene.world.node_tree.nodes if n.type == "TEX_ENVIRONMENT"]
photos = {o.name: [b.image.name for b in o.data.background_images] for o in scene.objects if o.type == "CAMERA"}
print("PROBE " + json.dumps([found, methods, world, photos, scene.camera.name, scene.view_settings.view_transform]))
"""


def blender() -> str:
    """The user's Blender, or a Python with bpy; skips the test where there is none."""
    found = os.environ.get("NEUFACE_BLENDER") or shutil.which("blender")
    if not found:
        pytest.skip("no Blender here: NEUFACE_BLENDER names a blender, or a Python with bpy, to try the script in")
    return found


def outline(asset: Path, camera: Camera) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of the asset in a camera's picture without distortion, pixels."""
    points = read_usd_mesh(asset).vertices.astype(np.float64)
    seen = (np.c_[points, np.ones(len(points))] @ np.linalg.inv(np.array(camera.world_from_cam)).T)[:, :3]
    x, y = (seen @ np.array(camera.K).T)[:, :2].T / seen[:, 2]
    return x.min(), x.max(), y.min(), y.max()


@pytest.mark.slow
def test_blender_shows_the_asset_as_its_photos(tmp_path: Path) -> None:
    program = blender()
    inputs = template_inputs(tmp_path / "inputs")
    run_stage(inputs, tmp_path / "work", render_views=False)
    for i in VIEWS:
        write_photo(tmp_path / f"photos/{i}.png")
    (tmp_path / "probe.py").write_text(PROBE)
    script = [str(tmp_path / "probe.py"), str(tmp_path / "work/asset" / BLENDER)]
    if "python" not in Path(program).name:
        script = ["--background", "--factory-startup", "--python", *script]
    words = [
        "--photos",
        str(tmp_path / "photos"),
        "--render",
        str(tmp_path / "a.png"),
        "--samples",
        "8",
    ]
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    ran = subprocess.run([program, *script, "--", *words], capture_output=True, text=True, timeout=300, env=clean)
    said = [line for line in ran.stdout.splitlines() if line.startswith("PROBE ")]
    assert said, ran.stdout[-2000:] + ran.stderr[-2000:]
    found, methods, world, photos, camera, transform = json.loads(said[0].removeprefix("PROBE "))
    assert found["render"] == [[2, 2]] and methods["skin_1001"] == "BOTH" and transform == "Standard"
    assert world == ["environment.exr"] and photos[camera] == [f"{camera.removeprefix('view_')}.png"]
    picture = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (HEIGHT, WIDTH, 4)
    inside = picture[..., 3] > 127
    assert picture[inside][:, :3].mean() > 20  # in its light
    of = next(c for c in inputs.poses.artifact.cameras if f"view_{c.index}" == camera)
    wanted = outline(tmp_path / "work/asset/head.usd", of)
    rows, columns = inside.any(1).nonzero()[0], inside.any(0).nonzero()[0]
    found_at = (columns[0], columns[-1] + 1, rows[0], rows[-1] + 1)
    # At its place in the photo, to a pixel; our facets are raised to keep the outline, Blender's lie inside of it.
    np.testing.assert_allclose(found_at, wanted, atol=1.3)
