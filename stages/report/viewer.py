"""The 3D view of the page: the asset's glb, maps, light, cameras and photos as text, and the code that shows them.

The page is one file that is opened from a disk: nothing can be loaded beside it. Binary data are base64 of gzip; the
modules (three.js, unchanged, and ours) are one such file, which the page's only script unpacks and links.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from pipeline import tiles
from pipeline.images import HALF_MAX, read_exr, shrink
from pipeline.maths import studio_lights
from stages.report.collect import Results
from stages.report.pictures import exact_uri, scale_colours
from stages.report.viewer_cameras import cameras_shown
from stages.report.viewer_glb import packed_glb
from stages.report.viewer_maps import maps_shown, scan_look
from stages.report.viewer_marks import landmarks
from stages.report.viewer_meshes import ShownMesh, shown_meshes

F32 = npt.NDArray[np.float32]
LIGHT_WIDTH = 128  # columns of a light: more than the captured light's order 10 or a rough surface can show
LABELS = {"key": "studio, key lamp", "overcast": "overcast sky", "sunset": "sunset"}
MODULES = (  # in the order of their imports, by the name under which others import them
    ("./three.core.js", "three/three.core.js"),
    ("three", "three/three.module.js"),
    ("../utils/BufferGeometryUtils.js", "three/BufferGeometryUtils.js"),
    ("../utils/SkeletonUtils.js", "three/SkeletonUtils.js"),
    ("./GLTFLoader.js", "three/GLTFLoader.js"),
    ("./OrbitControls.js", "three/OrbitControls.js"),
    ("./data.js", "viewer/data.js"),
    ("./channels.js", "viewer/channels.js"),
    ("./lights.js", "viewer/lights.js"),
    ("./cameras.js", "viewer/cameras.js"),
    ("./marks.js", "viewer/marks.js"),
    ("./meshes.js", "viewer/meshes.js"),
    ("./main.js", "viewer/main.js"),
)
# Colours that differ for every kind of colour vision [Okabe and Ito 2008], after a grey for "none".
CODES = ("#c8c8c8", "#56b4e9", "#e69f00", "#f0e442", "#009e73", "#cc79a7", "#d55e00", "#0072b2")


@dataclass(frozen=True, slots=True)
class Viewer:
    """The parts of the view as the page's template takes them. `boot_hash`: of the only script that may run."""

    data: dict[str, Any]
    glb: Markup
    modules: Markup
    boot: Markup
    boot_hash: str
    style: Markup
    bar: str
    meshes: tuple[ShownMesh, ...]


def viewer(r: Results) -> Viewer | None:
    """The view of an asset; None if the run wrote no glb."""
    usd = r.usd.artifact
    glb = next((f for f in usd.files if f.path == f"asset/{usd.name}.glb"), None)
    if glb is None:
        return None
    boot = _text("viewer/boot.js")
    digest = base64.b64encode(hashlib.sha256(boot.encode()).digest()).decode()
    meshes = tuple(shown_meshes(r))
    return Viewer(
        _data(r, meshes), _base64(packed_glb(r.usd.path(glb).read_bytes())), _modules(), Markup(boot),
        f"sha256-{digest}",
        Markup(_text("templates/viewer.css")), exact_uri(np.repeat(scale_colours()[None], 10, 0)),
        meshes,
    )  # fmt: skip


def _data(r: Results, meshes: tuple[ShownMesh, ...]) -> dict[str, Any]:
    """What the view knows besides the glb."""
    bake, name = r.bake.artifact, r.usd.artifact.name
    maps = maps_shown(r.bake)
    return {
        "texels": [bake.side(t) for t in range(bake.tiles)],
        "materials": [name if bake.tiles == 1 else f"{name}_{tiles.FIRST + t}" for t in range(bake.tiles)],
        "channels": list(_channels(r, maps)),
        "maps": maps,
        "scale": base64.b64encode(scale_colours().tobytes()).decode(),
        "lights": list(_lights(r)),
        "cameras": cameras_shown(r),
        "landmarks": landmarks(r),
        "asset": f"asset: {name}.glb",
        "meshes": [
            {"name": m.name, "label": m.label, "smooth": m.smooth, "scan": m.scan, **m.packed.head()} for m in meshes
        ],
        "scan": scan_look(r.bake) if any(m.scan for m in meshes) else None,
    }


def _channels(r: Results, maps: dict[str, list[str]]) -> Iterator[dict[str, Any]]:
    """Name, label, kind (channels.js) and range of everything that can be shown, on scales that never change."""
    yield {"name": "look", "label": "full look", "kind": "look"}
    yield {"name": "albedo", "label": "albedo", "kind": "colour"}
    if "f0" in r.bake.artifact.maps:
        yield _value("f0", "F0 (reflectance at normal incidence)", high=0.06, of="specularColorMap")
    if "roughness" in r.bake.artifact.maps:
        yield _value("roughness", "roughness", of="roughnessMap")
    yield {"name": "normal", "label": "normal, seen from the camera", "kind": "normal"}
    for name, label in (("ambient_occlusion", "ambient occlusion"), ("confidence", "confidence")):
        if name in maps:
            yield _value(name, label, map=name)
    if "coverage" in maps:
        colours = [CODES[0]] * 64 + [CODES[2]] * 128 + [CODES[1]] * 64
        yield _codes("coverage", "coverage: measured or assumed", colours, ["no chart", "assumed", "seen by a photo"])
    if "region" in maps:
        names = ["no label", *r.masks.artifact.label_names[1:]]
        colours = [CODES[min(i, len(CODES) - 1)] for i in range(len(names))]
        yield _codes("region", "labels", colours, names)
    yield {"name": "checker", "label": "UV checker", "kind": "checker"}
    yield {"name": "density", "label": "texel density", "kind": "density", "low": 0.1, "high": 3.2,
           "unit": "mm per texel (logarithmic)"}  # fmt: skip
    yield {"name": "wireframe", "label": "wireframe", "kind": "wireframe"}


def _value(name: str, label: str, *, high: float = 1, **of: str) -> dict[str, Any]:
    return {"name": name, "label": label, "kind": "value", "low": 0, "high": high, "unit": "", **of}


def _codes(name: str, label: str, colours: list[str], names: list[str]) -> dict[str, Any]:
    """`colours`: by code; `names`: of the distinct colours in their order."""
    legend = colours if len(colours) == len(names) else list(dict.fromkeys(colours))
    return {"name": name, "label": label, "kind": "code", "map": name, "colours": colours, "names": names,
            "legend": legend}  # fmt: skip


def _lights(r: Results) -> Iterator[dict[str, Any]]:
    """The captured light first, then the made ones."""
    for file in r.usd.artifact.files:
        if file.path == "asset/environment.exr":
            image = read_exr(r.usd.path(file))[0][..., :3]
            factor = max(1, image.shape[1] // LIGHT_WIDTH)
            fits = image.shape[0] % factor == 0 and image.shape[1] % factor == 0
            yield {
                "name": "captured",
                "label": "captured light",
                **light_data(shrink(image, factor) if fits else image),
            }
    for name, label in LABELS.items():
        yield {"name": name, "label": label, **light_data(studio_lights.picture(name, LIGHT_WIDTH))}


def light_data(image: F32) -> dict[str, Any]:
    """A lat-long picture (H, W, 3) of USD's dome as three.js reads it: half floats, the lowest row first.

    three.js has +X in the middle and columns that grow towards +Z: our picture, moved by a quarter of its width.
    """
    moved = np.roll(image, image.shape[1] // 4, 1)[::-1].clip(0, HALF_MAX).astype(np.float16)
    return {"width": image.shape[1], "height": image.shape[0], "rgb": base64.b64encode(moved.tobytes()).decode()}


def _modules() -> Markup:
    sources = [[name, _text(path)] for name, path in MODULES]
    return _base64(gzip.compress(json.dumps(sources).encode(), 6, mtime=0))


def _base64(content: bytes) -> Markup:
    return Markup(base64.b64encode(content).decode())


def _text(path: str) -> str:
    return files("stages.report").joinpath(path).read_text(encoding="utf-8")
