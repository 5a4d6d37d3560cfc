"""Opens this asset in Blender: the head, its captured light, the photos' cameras, and colours as in the photos.

    blender --python open_in_blender.py [-- --photos FOLDER --render out.png --samples 32]

or Run Script in the text editor. Photos are those that the run keeps, found by run.json beside the asset's folder.
"""

import argparse
import ast
import json
import re
import sys
from pathlib import Path

import bpy

IMPORT = dict(import_cameras=True, import_lights=True, create_world_material=True, import_subdivision=True)
IMPORT |= dict(import_proxy=False)
CAMERA = r'def Camera "(view_\d+)".*?int height = (\d+).*?string photo = (.*?)\n.*?int width = (\d+)'

parser = argparse.ArgumentParser(prog="open_in_blender.py")
parser.add_argument("--photos", type=Path)
parser.add_argument("--render", type=Path)
parser.add_argument("--samples", type=int, default=128)
asked = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])

# The text editor does not set __file__ to the script's place; the text knows it.
places = [Path(bpy.path.abspath(p)) for p in (__file__, *(t.filepath for t in bpy.data.texts))]
asset = next((p.absolute().parent for p in places if (p.parent / "lookdev.usda").is_file()), None)
if asset is None:
    raise FileNotFoundError("lookdev.usda is not beside this script: leave the script in the asset's folder")
lookdev = (asset / "lookdev.usda").read_text(encoding="utf-8")  # the importer drops what it says of the photos
found = {
    name: (ast.literal_eval(photo), int(w), int(h)) for name, h, photo, w in re.findall(CAMERA, lookdev, re.DOTALL)
}
photos = {name: asked.photos / photo for name, (photo, _, _) in found.items()} if asked.photos else {}
if not asked.photos:
    try:
        run = json.loads((asset.parent / "run.json").read_text(encoding="utf-8"))
        kept = Path(run["store"]) / "capture" / run["stages"]["capture"]["key"]
        views = json.loads((kept / "manifest.json").read_text(encoding="utf-8"))["views"]
        photos = {f"view_{v['index']}": kept / v["image"]["path"] for v in views}
    except (OSError, ValueError, KeyError, TypeError):
        print("the run's photos are not here: --photos FOLDER names them")

scene = bpy.data.scenes.new(asset.parent.name or "asset")
scene.world = bpy.data.worlds.new(scene.name)  # without a World the importer drops the light
bpy.context.window.scene = scene
known = bpy.ops.wm.usd_import.get_rna_type().properties.keys()  # versions differ in their options
bpy.ops.wm.usd_import(filepath=str(asset / "lookdev.usda"), **{o: v for o, v in IMPORT.items() if o in known})
cameras = {o.name.partition(".")[0]: o for o in scene.objects if o.type == "CAMERA"}
for name, (_, width, height) in found.items():
    camera, path = cameras[name].data, photos.get(name)
    camera.sensor_fit = "HORIZONTAL"  # the sensor's width is the picture's, also of upright pictures
    image = bpy.data.images.load(str(path), check_existing=True) if path and path.is_file() else None
    if image and image.size[0] and abs(image.size[0] * height / (image.size[1] * width) - 1) < 0.01:  # it is upright
        camera.show_background_images, behind = True, camera.background_images.new()
        behind.image, behind.alpha, behind.display_depth, behind.frame_method = image, 1.0, "BACK", "STRETCH"
for thing in scene.objects:
    for modifier in (m for m in thing.modifiers if m.type == "SUBSURF"):
        modifier.levels = modifier.render_levels = 2  # as fine as the displacement map needs
    for material in (slot.material for slot in thing.material_slots if slot.material):
        if any(n.type == "OUTPUT_MATERIAL" and n.inputs["Displacement"].is_linked for n in material.node_tree.nodes):
            material.displacement_method = "BOTH"

shown = next((n for n in re.findall(r"/cameras/(\w+)>", lookdev) if n in found), "")  # the first is main_cam's
if shown:  # renders have the photo's pixels, which need not be square, and its colours: no film curve
    _, width, height = found[shown]
    scene.camera, data, render, view = cameras[shown], cameras[shown].data, scene.render, scene.view_settings
    tall = (data.sensor_height / height) / (data.sensor_width / width)
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1 / tall), max(1.0, tall)
    render.engine, render.film_transparent, scene.cycles.samples = "CYCLES", True, asked.samples
    view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", 0.0, 1.0
    for area in (a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "VIEW_3D"):
        space = area.spaces.active
        space.region_3d.view_perspective, space.shading.type = "CAMERA", "MATERIAL"
        space.shading.use_scene_world = space.shading.use_scene_lights = True
if asked.render:
    scene.render.filepath = str(asked.render.absolute())
    bpy.ops.render.render(write_still=True, scene=scene.name)
