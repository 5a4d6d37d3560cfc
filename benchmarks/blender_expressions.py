"""Renders expressions of an asset in Blender, seen from the front in the asset's light.

    python benchmarks/blender_expressions.py ASSET/lookdev.usda OUT [SHAPE ...]

For a Python that has Blender's module (`bpy`). Writes OUT_neutral.png and OUT_SHAPE.png, and prints how many vertices
each shape moves and how far. It imports what an artist gets: shape keys, the subdivision modifier, the material's
displacement, the dome as World.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

SHAPES = ("jawOpen", "eyeBlinkLeft", "mouthSmileRight")
SIDE, SAMPLES, ANGLE = 420, 24, 20.0  # pixels, rays a pixel, degrees of the view
TURN = 15.0  # degrees from the front, to the person's left


def imported(path: Path) -> bpy.types.Object:
    """The head of the imported asset."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("World")  # without one the importer drops the dome
    bpy.ops.wm.usd_import(filepath=str(path.resolve()), import_cameras=False, import_subdivision=True)
    head = next(o for o in bpy.data.objects if o.type == "MESH" and o.data.shape_keys)
    for modifier in head.modifiers:
        if modifier.type == "SUBSURF":
            modifier.levels = modifier.render_levels = 2
    return head


def look_at(head: bpy.types.Object) -> None:
    """A camera in front of the face."""
    points = np.empty(3 * len(head.data.vertices), np.float32)
    head.data.vertices.foreach_get("co", points)
    world = np.array(head.matrix_world)
    points = points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
    low, high = points.min(0), points.max(0)
    centre = Vector(((low + high) / 2).tolist())
    camera = bpy.data.objects.new("front", bpy.data.cameras.new("front"))
    bpy.context.scene.collection.objects.link(camera)
    camera.data.angle = np.radians(ANGLE)
    away = 0.5 * float(high[2] - low[2]) / np.tan(np.radians(ANGLE / 2))
    turn = np.radians(TURN)
    away *= 1.25
    camera.location = centre + float(away) * Vector((float(np.sin(turn)), -float(np.cos(turn)), 0.0))
    camera.rotation_euler = (centre - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_start, camera.data.clip_end = 0.01, 100.0
    bpy.context.scene.camera = camera


def render(path: Path) -> None:
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", SAMPLES
    scene.cycles.use_denoising, scene.render.film_transparent = True, True
    scene.render.resolution_x = scene.render.resolution_y = SIDE
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True)


def main(asset: Path, out: str, names: list[str]) -> None:
    head = imported(asset)
    keys = head.data.shape_keys.key_blocks
    base = np.array([v.co for v in keys[0].data])
    print(len(keys) - 1, "shape keys:", ", ".join(k.name for k in keys[1:]))
    look_at(head)
    for name in ["neutral", *names]:
        for key in keys[1:]:
            key.value = float(key.name == name)
        if name != "neutral":
            away = np.linalg.norm(np.array([v.co for v in keys[name].data]) - base, axis=1)
            print(f"{name}: {int((away > 1e-6).sum())} vertices, at most {1000 * away.max():.1f} mm")
        render(Path(f"{out}_{name}.png"))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:] or list(SHAPES))
