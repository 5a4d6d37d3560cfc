"""Makes the skin of this asset scatter light below its surface in Blender, as look=subsurface does in OpenPBR.

    blender --python open_in_blender.py --python scatter_in_blender.py

or Run Script in the text editor, after the asset was imported. Blender's importer does not read MaterialX.
"""

import re
from pathlib import Path

import bpy

FREE_PATH = (0.001295, 0.000952, 0.000671)  # metres in skin, of red, green and blue
SKIN = ("skin", "captured")  # beginnings of the materials' names

places = [Path(bpy.path.abspath(p)) for p in (__file__, *(t.filepath for t in bpy.data.texts))]
weights = [w for p in places for w in sorted((p.parent / "textures").glob("*subsurface*.exr"))]
if not weights:
    raise FileNotFoundError("textures/ beside this script has no map of where skin scatters (*subsurface*.exr)")
for material in bpy.data.materials:
    tree = material.node_tree
    if not tree or not material.name.startswith(SKIN):
        continue
    for surface in [n for n in tree.nodes if n.type == "BSDF_PRINCIPLED" and n.inputs["Base Color"].is_linked]:
        shown = surface.inputs["Base Color"].links[0].from_node
        name = shown.image.name if shown.type == "TEX_IMAGE" and shown.image else ""
        udim = re.search(r"[._-](1\d{3})[._-]", name)
        own = [w for w in weights if not udim or udim[1] in w.name]
        scan = [w for w in own if ("_scan_" in w.name) == ("_scan_" in name)]
        if not name or not scan:
            continue
        weight = tree.nodes.new("ShaderNodeTexImage")
        weight.image, weight.extension = bpy.data.images.load(str(scan[0]), check_existing=True), "EXTEND"
        weight.image.colorspace_settings.name = "Non-Color"
        if shown.inputs["Vector"].is_linked:
            tree.links.new(shown.inputs["Vector"].links[0].from_socket, weight.inputs["Vector"])
        tree.links.new(weight.outputs["Color"], surface.inputs["Subsurface Weight"])
        surface.inputs["Subsurface Radius"].default_value = [path / FREE_PATH[0] for path in FREE_PATH]
        surface.inputs["Subsurface Scale"].default_value = FREE_PATH[0]
