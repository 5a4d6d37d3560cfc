"""Opens this asset in Blender: the head, its captured light, the photos' cameras, and colours as in the photos.

    blender --python open_in_blender.py
    blender --background --python open_in_blender.py -- --render out.png --size 512 --samples 32

or from Blender's text editor (Run Script). It makes a scene of its own and leaves the others as they are. Options after
`--`: --photos FOLDER, --camera view_12, --render FILE, --size PIXELS (the longer side), --samples N.
Without --photos the photos are looked for where the run left them; a camera whose photo is gone has none behind it.
"""

import argparse
import ast
import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

Pictures = dict[str, tuple[str, int, int]]  # camera -> its photo's name, width and height in pixels
LOOKDEV, FIRST = "lookdev.usda", "main_cam"
LEVELS = 2  # of subdivision: as fine as the displacement map needs
IMPORT: dict[str, Any] = dict(
    import_cameras=True, import_lights=True, create_world_material=True, import_usd_preview=True,
    import_subdivision=True, import_proxy=False, import_render=True, import_textures_mode="IMPORT_NONE",
)  # fmt: skip


def asset_folder() -> Path:
    """The folder of this script. In the text editor __file__ does not tell it, the text's own path does."""
    for path in (__file__, *(t.filepath for t in bpy.data.texts if "open_in_blender" in t.name)):
        folder = Path(bpy.path.abspath(path)).absolute().parent
        if (folder / LOOKDEV).is_file():
            return folder
    raise FileNotFoundError(f"{LOOKDEV} is not beside this script: leave the script in the asset's folder")


def captured(folder: Path) -> tuple[Pictures, str]:
    """The cameras in lookdev.usda, and the one to show first ("" without one). The importer drops this metadata."""
    found: Pictures = {}
    first = ""
    for part in (folder / LOOKDEV).read_text(encoding="utf-8").split('def Camera "')[1:]:
        name = part.partition('"')[0]
        photo = re.search(r"string photo = (\"(?:[^\"\\\n]|\\.)*\"|'(?:[^'\\\n]|\\.)*')", part)
        if name == FIRST:
            first = "".join(re.findall(r"/cameras/(\w+)>", part)[:1])
        elif photo:
            width, height = (int(re.findall(rf"int {side} = (\d+)", part)[0]) for side in ("width", "height"))
            found[name] = (ast.literal_eval(photo[1]), width, height)
    return found, first


def photo_files(folder: Path, pictures: Pictures, given: str | None) -> dict[str, list[Path]]:
    """Files that may be each camera's photo, the best first: in the folder that the user gave; else the run's upright
    copies, then the capture itself. run.json beside the asset names both; it is not there when the asset was moved."""
    folders, copies = [Path(given)] if given else [], dict[str, Path]()
    if not given and (folder.parent / "run.json").is_file():
        try:
            run = json.loads((folder.parent / "run.json").read_text(encoding="utf-8"))
            folders = [Path(run["request"]["capture"]), Path(run["request"]["capture"]) / "images"]
            kept = Path(run["store"]) / "capture" / run["stages"]["capture"]["key"]
            views = json.loads((kept / "manifest.json").read_text(encoding="utf-8"))["views"]
            copies = {f"view_{v['index']}": kept / v["image"]["path"] for v in views}
        except (OSError, ValueError, KeyError, TypeError) as e:
            print(f"the run's copies of the photos are not reachable ({e!r})")
    files = {n: [*([copies[n]] if n in copies else []), *(f / p[0] for f in folders)] for n, p in pictures.items()}
    return {n: [f for f in found if f.is_file()] for n, found in files.items()}


def photo_behind(camera: Any, files: Iterable[Path], width: int, height: int) -> bool:
    """Show behind the scene the first file with the proportions of the camera's picture: others are not upright."""
    for path in files:
        image = bpy.data.images.load(str(path), check_existing=True)
        if image.size[0] and abs(image.size[0] * height - image.size[1] * width) < 0.01 * width * image.size[1]:
            camera.show_background_images = True
            behind = camera.background_images.new()
            behind.image, behind.alpha, behind.display_depth, behind.frame_method = image, 1.0, "BACK", "STRETCH"
            return True
    return False


def imported_scene(folder: Path, name: str) -> Any:
    """A new scene with the asset, light and cameras. The importer needs a World: without one it drops the light."""
    scene = bpy.data.scenes.new(name)
    scene.world = bpy.data.worlds.new(name)
    bpy.context.window.scene = scene
    known = bpy.ops.wm.usd_import.get_rna_type().properties.keys()  # versions differ in their options
    bpy.ops.wm.usd_import(filepath=str(folder / LOOKDEV), **{k: v for k, v in IMPORT.items() if k in known})
    return scene


def set_surface(scene: Any) -> None:
    """Subdivision of the cage, and displacement of the geometry where the material has a displacement."""
    for thing in scene.objects:
        for modifier in (m for m in thing.modifiers if m.type == "SUBSURF"):
            modifier.levels = modifier.render_levels = LEVELS
        for material in (slot.material for slot in thing.material_slots if slot.material):
            outputs = [n for n in material.node_tree.nodes if n.type == "OUTPUT_MATERIAL"]
            if any(n.inputs["Displacement"].is_linked for n in outputs):
                material.displacement_method = "BOTH"


def set_picture(scene: Any, camera: Any, width: int, height: int) -> None:
    """Renders have the photo's pixels, which need not be square, and its colours: no film curve, no exposure."""
    data, render, view = camera.data, scene.render, scene.view_settings
    scene.camera = camera
    tall = (data.sensor_height / height) / (data.sensor_width / width)  # a pixel's height over its width
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1 / tall), max(1.0, tall)
    render.engine, render.film_transparent = "CYCLES", True
    view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", 0.0, 1.0
    for area in (a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "VIEW_3D"):
        space = area.spaces.active
        space.region_3d.view_perspective, space.shading.type = "CAMERA", "MATERIAL"
        space.shading.use_scene_world = space.shading.use_scene_lights = True


def main(words: list[str]) -> None:
    """Set up the scene, and render it if asked to."""
    parser = argparse.ArgumentParser(prog="open_in_blender.py")
    for option, kind in (("photos", str), ("camera", str), ("render", str), ("size", int), ("samples", int)):
        parser.add_argument(f"--{option}", type=kind)
    asked = parser.parse_args(words)
    folder = asset_folder()
    pictures, first = captured(folder)
    chosen = asked.camera or first
    if chosen not in pictures:
        parser.error(f"there is no camera {chosen!r}; there are: {', '.join(pictures)}")
    scene = imported_scene(folder, folder.parent.name or "asset")
    cameras = {c.name.partition(".")[0]: c for c in scene.objects if c.type == "CAMERA"}
    for camera in cameras.values():
        camera.data.sensor_fit = "HORIZONTAL"  # the width of the sensor is the picture's, also of upright pictures
    files = photo_files(folder, pictures, asked.photos)
    seen = sum(photo_behind(cameras[n].data, files[n], *pictures[n][1:]) for n in pictures)
    set_surface(scene)
    set_picture(scene, cameras[chosen], *pictures[chosen][1:])
    print(f"{len(pictures)} cameras, {seen} with their photo; shown: {chosen} ({pictures[chosen][0]})")
    if asked.samples:
        scene.cycles.samples = asked.samples
    if asked.size:
        scene.render.resolution_percentage = max(1, round(100 * asked.size / max(pictures[chosen][1:])))
    if asked.render:
        scene.render.filepath = str(Path(asked.render).absolute())
        bpy.ops.render.render(write_still=True, scene=scene.name)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
