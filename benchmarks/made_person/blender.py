"""Renders a made-up person with Blender's Cycles: for a Python that has Blender's module (`bpy`).

    python blender.py FOLDER SAMPLES [VIEW ...]

FOLDER has person.npz, light.npy and rig.json of `python -m benchmarks.made_person`; VIEW.exr is written there, with
linear radiance, coverage, albedo and the number of the material. Nothing of this project is needed.
"""

import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

SKIN, HAIR, EYES, CLOTH = 1, 2, 3, 4  # numbers of the materials, as in the labels


def z_up(points):
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], -1)


def mesh(name, vertices, quads, colour=None, subdivided=0):
    data = bpy.data.meshes.new(name)
    data.from_pydata(z_up(vertices).tolist(), [], quads.tolist())
    data.update()
    if colour is not None:
        layer = data.color_attributes.new("colour", "FLOAT_COLOR", "POINT")
        layer.data.foreach_set("color", np.c_[colour, np.ones(len(colour))].astype(np.float32).ravel())
    for polygon in data.polygons:
        polygon.use_smooth = True
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    if subdivided:
        modifier = thing.modifiers.new("subdivision", "SUBSURF")
        modifier.levels = modifier.render_levels = subdivided
    return thing


def material(name, number):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.pass_index = number
    return made, made.node_tree.nodes, made.node_tree.links


def noise(nodes, links, scale, low, high):
    """The output of a noise between two values."""
    place, made, mapped = (nodes.new(f"ShaderNode{n}") for n in ("TexCoord", "TexNoise", "MapRange"))
    made.inputs["Scale"].default_value, made.inputs["Detail"].default_value = scale, 4
    links.new(place.outputs["Object"], made.inputs["Vector"])
    for key, value in (("From Min", 0.3), ("From Max", 0.7), ("To Min", low), ("To Max", high)):
        mapped.inputs[key].default_value = value
    links.new(made.outputs[0], mapped.inputs[0])
    return mapped.outputs[0]


def skin_material():
    made, nodes, links = material("skin", SKIN)
    shader = nodes["Principled BSDF"]
    colour, both, scaled = (nodes.new(f"ShaderNode{n}") for n in ("Attribute", "Math", "VectorMath"))
    colour.attribute_name, both.operation, scaled.operation = "colour", "MULTIPLY", "SCALE"
    links.new(noise(nodes, links, 28, 0.80, 1.20), both.inputs[0])
    links.new(noise(nodes, links, 260, 0.86, 1.14), both.inputs[1])
    links.new(colour.outputs["Color"], scaled.inputs[0])
    links.new(both.outputs[0], scaled.inputs["Scale"])
    links.new(scaled.outputs[0], shader.inputs["Base Color"])
    links.new(noise(nodes, links, 40, 0.34, 0.55), shader.inputs["Roughness"])
    shader.inputs["IOR"].default_value = 1.402
    shader.inputs["Subsurface Weight"].default_value = 0.75
    shader.inputs["Subsurface Radius"].default_value = (1, 0.35, 0.18)
    shader.inputs["Subsurface Scale"].default_value = 0.003
    pores, place, bump = (nodes.new(f"ShaderNode{n}") for n in ("TexNoise", "TexCoord", "Bump"))
    pores.inputs["Scale"].default_value = 900
    bump.inputs["Strength"].default_value, bump.inputs["Distance"].default_value = 0.25, 0.0006
    links.new(place.outputs["Object"], pores.inputs["Vector"])
    links.new(pores.outputs[0], bump.inputs["Height"])
    links.new(bump.outputs[0], shader.inputs["Normal"])
    return made


def cloth_material(stripes):
    made, nodes, links = material("cloth", CLOTH)
    shader = nodes["Principled BSDF"]
    place, wave, ramp = (nodes.new(f"ShaderNode{n}") for n in ("TexCoord", "TexWave", "ValToRGB"))
    wave.bands_direction = "Z"
    wave.inputs["Scale"].default_value, wave.inputs["Distortion"].default_value = 18, 0.4
    links.new(place.outputs["Object"], wave.inputs["Vector"])
    for element, colour, at in zip(ramp.color_ramp.elements, stripes, (0.45, 0.55), strict=True):
        element.color, element.position = (*colour, 1), at
    links.new(wave.outputs[1], ramp.inputs[0])
    links.new(ramp.outputs[0], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value, shader.inputs["Specular IOR Level"].default_value = 0.85, 0.2
    return made


def eye(name, centre, radius, iris):
    """A ball with a bulging cornea, an iris and a pupil, that looks along +Z of the world."""
    theta, phi = np.meshgrid(np.linspace(0, math.pi, 49), np.linspace(0, 2 * math.pi, 97)[:-1], indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    bulge = np.where(theta < 0.36, 1 + 0.06 * (1 - (theta / 0.36) ** 2), 1)[..., None]
    n, t = 96, theta.ravel()
    quads = np.array([[i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n]
                      for i in range(48) for j in range(n)])  # fmt: skip
    colour = np.tile([0.78, 0.74, 0.70], (len(t), 1))
    colour[t < 0.36] = iris
    colour[(t > 0.32) & (t < 0.36)] *= 0.4
    colour[t < 0.14] = 0.004
    thing = mesh(name, (ball * bulge * radius * 0.985 + centre).reshape(-1, 3), quads, colour)
    made, nodes, links = material(name, EYES)
    shader, layer = nodes["Principled BSDF"], nodes.new("ShaderNodeAttribute")
    layer.attribute_name = "colour"
    links.new(layer.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value, shader.inputs["IOR"].default_value = 0.06, 1.376
    thing.data.materials.append(made)


def strands(name, points, last, radius, melanin):
    curves, count = bpy.data.hair_curves.new(name), np.maximum(last + 1, 3)
    curves.add_curves(count.tolist())
    flat = np.concatenate([s[:n] for s, n in zip(points, count, strict=True)])
    curves.points.foreach_set("position", z_up(flat).astype(np.float32).ravel())
    thick = np.concatenate([radius * np.linspace(1, 0.35, n) for n in count]).astype(np.float32)
    if "radius" not in curves.attributes:
        curves.attributes.new("radius", "FLOAT", "POINT")
    curves.attributes["radius"].data.foreach_set("value", thick)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, curves))
    made, nodes, links = material(name, HAIR)
    nodes.clear()
    out, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfHairPrincipled")
    shader.parametrization = "MELANIN"
    for key, value in (("Melanin", melanin), ("Roughness", 0.3), ("Random Color", 0.25)):
        if key in shader.inputs:
            shader.inputs[key].default_value = value
    links.new(shader.outputs[0], out.inputs[0])
    curves.materials.append(made)


def light(values):
    """The world's light: lat-long (H, W, 3), centre column +Z, columns towards -X."""
    h, w = values.shape[:2]
    image = bpy.data.images.new("light", w, h, float_buffer=True)
    pixels = np.ones((h, w, 4), np.float32)
    pixels[..., :3] = values
    image.pixels.foreach_set(pixels[::-1].ravel())
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    sky, place, turn = (nodes.new(f"ShaderNode{n}") for n in ("TexEnvironment", "TexCoord", "Mapping"))
    sky.image, turn.inputs["Rotation"].default_value = image, (0, 0, math.pi / 2)
    links.new(place.outputs["Generated"], turn.inputs[0])
    links.new(turn.outputs[0], sky.inputs[0])
    links.new(sky.outputs[0], nodes["Background"].inputs[0])


def box(name, low, high, colours, scale, texture="ShaderNodeTexVoronoi", glow=0.0):
    """A box between two corners (x, height, towards the front) with a pattern of two colours, or one that shines."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    vertices = np.asarray(low) + corners * (np.asarray(high) - np.asarray(low))
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    thing = mesh(name, vertices, quads)
    for polygon in thing.data.polygons:
        polygon.use_smooth = False
    made, nodes, links = material(name, 0)
    shader, place, pattern, ramp = nodes["Principled BSDF"], *(
        nodes.new(n) for n in ("ShaderNodeTexCoord", texture, "ShaderNodeValToRGB"))  # fmt: skip
    pattern.inputs["Scale"].default_value = scale
    links.new(place.outputs["Object"], pattern.inputs["Vector"])
    links.new(pattern.outputs[0], ramp.inputs[0])
    for element, colour, at in zip(ramp.color_ramp.elements, colours, (0.3, 0.7), strict=True):
        element.color, element.position = (*colour, 1), at
    links.new(ramp.outputs[0], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value = 0.7
    if glow:
        links.new(ramp.outputs[0], shader.inputs["Emission Color"])
        shader.inputs["Emission Strength"].default_value = glow
    thing.data.materials.append(made)


def room():
    """A furnished room around the person, with a window at the person's right and a lamp at the ceiling."""
    rng = np.random.default_rng(3)
    paint, wood = ((0.62, 0.60, 0.55), (0.50, 0.49, 0.46)), ((0.30, 0.17, 0.08), (0.16, 0.08, 0.04))
    walls = (((-1.9, -1.3, -1.6), (-1.85, 1.4, 2.2)), ((1.85, -1.3, -1.6), (1.9, 1.4, 2.2)),
             ((-1.9, -1.3, -1.65), (1.9, 1.4, -1.6)), ((-1.9, -1.3, 2.2), (1.9, 1.4, 2.25)),
             ((-1.9, 1.4, -1.6), (1.9, 1.45, 2.2)))  # fmt: skip
    for k, (low, high) in enumerate(walls):
        box(f"wall{k}", low, high, paint, 9, "ShaderNodeTexNoise")
    box("floor", (-1.9, -1.35, -1.6), (1.9, -1.3, 2.2), wood, 14)
    box("window", (-1.86, -0.2, -0.1), (-1.84, 1.0, 1.3), ((0.9, 0.95, 1.0), (0.9, 0.95, 1.0)), 1, glow=9.0)
    box("lamp", (-0.3, 1.38, 0.4), (0.3, 1.4, 1.0), ((1.0, 0.86, 0.68), (1.0, 0.86, 0.68)), 1, glow=5.0)
    box("chair", (-0.24, -0.75, -0.30), (0.24, -0.16, -0.26), wood, 20)
    for k in range(26):  # shelves, pictures and boxes along three walls
        wall, along, height = k % 3, rng.uniform(-1.4, 1.4), rng.uniform(-1.0, 0.9)
        size, deep = rng.uniform(0.1, 0.32, 2), rng.uniform(0.02, 0.25)
        colours = rng.uniform(0.03, 0.75, (2, 3))
        low, high = np.array([along, height, -1.6]), np.array([along + size[0], height + size[1], -1.6 + deep])
        if wall:  # at the person's left or right, but for the window
            side = 1.85 if wall == 1 else -1.85
            low, high = (
                np.array([side - deep, height, along]),
                np.array([side + deep, height + size[1], along + size[0]]),
            )
            if wall == 2 and -0.4 < along < 1.3 and height > -0.5:
                continue
        box(
            f"thing{k}",
            low,
            high,
            colours,
            rng.uniform(10, 40),
            "ShaderNodeTexVoronoi" if k % 2 else "ShaderNodeTexNoise",
        )


def prepare(samples):
    """Settings of the picture; the camera."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = samples, True
    scene.cycles.max_bounces = scene.cycles.transparent_max_bounces = 8
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    layer = scene.view_layers[0]
    layer.use_pass_diffuse_color = layer.use_pass_material_index = True
    picture = scene.render.image_settings
    if hasattr(picture, "media_type"):
        picture.media_type = "MULTI_LAYER_IMAGE"
    picture.file_format, picture.color_depth = "OPEN_EXR_MULTILAYER", "16"
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    return scene


def aim(scene, view):
    """The scene's camera as a view of rig.json: K with pixel centres at integers, and Rt, OpenCV axes."""
    K, Rt = np.array(view["K"]), np.vstack([view["Rt"], [0, 0, 0, 1]])
    w, h = view["size"]
    up = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    scene.camera.matrix_world = Matrix((up @ np.linalg.inv(Rt) @ np.diag([1, -1, -1, 1])).tolist())
    lens = scene.camera.data
    lens.sensor_fit, lens.sensor_width, lens.lens, lens.clip_start = "HORIZONTAL", 36, K[0, 0] * 36 / w, 0.01
    lens.shift_x, lens.shift_y = -(K[0, 2] + 0.5 - w / 2) / w, (K[1, 2] + 0.5 - h / 2) / w
    scene.render.resolution_x, scene.render.resolution_y = w, h


def main():
    folder, samples = Path(sys.argv[1]).resolve(), int(sys.argv[2])
    person, rig = np.load(folder / "person.npz"), json.loads((folder / "rig.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body = mesh("skin", person["skin"], person["skin_quads"], person["colour"], 3)
    body.data.materials.append(skin_material())
    shirt = mesh("cloth", person["shirt"], person["shirt_quads"], subdivided=2)
    shirt.modifiers.new("smooth", "SMOOTH").iterations = 6
    shirt.modifiers.new("thick", "SOLIDIFY").thickness = 0.003
    shirt.data.materials.append(cloth_material(person["stripes"]))
    for k, (centre, radius) in enumerate(zip(person["eyes"], person["eye_radii"], strict=True)):
        eye(f"eye{k}", centre, radius, person["iris"])
    strands("hair", person["hair"], person["hair_last"], 0.00011, float(person["melanin"]))
    strands("brows", person["brows"], np.full(len(person["brows"]), 4), 0.00005, float(person["melanin"]))
    person_parts = list(bpy.context.scene.collection.objects)
    light(np.load(folder / "light.npy"))
    scene = prepare(samples)
    if "head" in next(iter(rig.values())):
        room()
        scene.cycles.max_bounces = 4  # light goes on for ever in a room
    up = Matrix([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    for name in sys.argv[3:] or rig:
        aim(scene, rig[name])
        moved = up @ Matrix(rig[name].get("head", np.eye(4).tolist())) @ up.inverted()
        for part in person_parts:
            part.matrix_world = moved
        scene.render.filepath = str(folder / f"{name}.exr")
        bpy.ops.render.render(write_still=True)
    surface = body.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    surface.calc_loop_triangles()
    vertices = np.array([v.co[:] for v in surface.vertices])
    np.savez(folder / "skin.npz", vertices=np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], 1),
             faces=np.array([t.vertices[:] for t in surface.loop_triangles]))  # fmt: skip


main()
