"""Renders a look-dev scene in Blender from a captured camera, under the captured light, with Cycles.

    python blender_view.py ASSET/lookdev.usda INDEX OUT.exr [SAMPLES [SIDE]]

For a Python that has Blender's module (`bpy`); nothing of this project is needed. `compare_views.py` says how close the
picture is to the photo.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import bpy

path, index, out = sys.argv[1:4]
samples = int(sys.argv[4]) if len(sys.argv) > 4 else 64
side = int(sys.argv[5]) if len(sys.argv) > 5 else 1024
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.world = bpy.data.worlds.new("World")  # without one the importer drops the dome
bpy.ops.wm.usd_import(
    filepath=str(Path(path).resolve()),
    import_cameras=True,
    import_lights=True,
    create_world_material=True,
    import_usd_preview=True,
    import_textures_mode="IMPORT_NONE",
    import_proxy=False,
    import_render=True,
)
named = {o.name: o for o in bpy.data.objects if o.type == "CAMERA"}
scene.camera = named[f"view_{index}"]
scene.render.engine = "CYCLES"
scene.cycles.device = "CPU"
scene.cycles.samples = samples
scene.cycles.use_denoising = True
scene.render.film_transparent = True
sensor = scene.camera.data
scene.render.resolution_x = side
scene.render.resolution_y = round(side * sensor.sensor_height / sensor.sensor_width)
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
scene.render.image_settings.color_mode = "RGBA"
scene.render.filepath = str(Path(tempfile.mkdtemp()) / "view.exr")
bpy.ops.render.render(write_still=True)
shutil.move(scene.render.filepath, out)
