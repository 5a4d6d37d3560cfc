"""Pictures of the exported asset: the held-out views, and previews of its shape and appearance from three sides."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import UNCHANGED, Camera, CameraSet, FittedFace, HeldOutView
from pipeline.camera import PinholeCamera
from pipeline.colour import as_photographed, srgb_from_linear
from pipeline.contract import Context
from pipeline.fitted_cameras import cameras_of
from pipeline.images import read_linear, write_exr, write_png
from stages.usd.render.camera import orbit_camera
from stages.usd.render.carried import Captured
from stages.usd.render.exported import load_exported
from stages.usd.render.render import CarriedLight, Light, Renderer
from stages.usd.render.standard_light import StandardLight

F32 = npt.NDArray[np.float32]
FITTED_SHOWN, FITTED_SIDE = 3, 640  # fitted views rendered if none is held out, and their largest side
SIDES = {"left": -55.0, "front": 0.0, "right": 55.0}  # degrees of azimuth
THUMBNAIL_SIDE, THUMBNAIL_TURN = 256, 25.0  # pixels, degrees
GREY_LIGHT = np.array([[2.0] * 3, [1.2] * 3, [1.2] * 3, [0.7] * 3], np.float32)
"""A soft light from above, front and the subject's left: orders 0 and 1, for pictures of the shape."""


@dataclass(frozen=True, slots=True)
class Scene:
    """The exported asset under the captured light: its rays and shadows are set up once for all pictures."""

    renderer: Renderer
    light: Light | CarriedLight | None


def load_scene(root: Path, check: Callable[[], None]) -> Scene:
    """The scene of the asset NAME.usd."""
    renderer = Renderer(load_exported(root))
    return Scene(renderer, captured(renderer, root, check))


def render_held_out(
    scene: Scene, cameras: CameraSet, face: FittedFace, samples: int, context: Context
) -> tuple[HeldOutView, ...]:
    """Write asset_views/I.exr and .png for each view that the fit predicted, at its scale, in its camera's colours.

    Without held-out views, a few fitted ones are rendered instead.
    """
    by_index = {c.index: c for c in cameras_of(cameras, face).cameras}
    wanted = [(v.index, v.scale) for v in face.held_out if v.index in by_index]
    wanted = wanted or [(i, factor_for(by_index[i])) for i in spread(face.fitted_views, FITTED_SHOWN) if i in by_index]
    if not wanted:
        return ()
    responses, out = {v.index: v.response for v in face.held_out}, []
    for number, (index, scale) in enumerate(wanted):
        context.check()
        context.progress(number, len(wanted), f"asset view {index}")
        response = responses.get(index, UNCHANGED)
        view = PinholeCamera.of(by_index[index])
        shown = scene.renderer.render(view, factor=scale, samples=samples, light=scene.light)
        rgba = as_photographed(shown, response)
        exr, png = (context.workdir / f"asset_views/{index}.{e}" for e in ("exr", "png"))
        write_exr(exr, rgba, half=True)
        write_rgba_png(png, rgba)
        files = {"exr": context.file(exr), "png": context.file(png)}
        out.append(HeldOutView(index=index, **files, scale=scale, response=response))
    return tuple(out)


def captured(renderer: Renderer, root: Path, check: Callable[[], None] = lambda: None) -> Light | CarriedLight | None:
    """The captured light as other programs see it, the exported dome on the standard material, or a light that moves
    with the camera; None, the model's closed form, for an asset whose standard material was not fitted."""
    if renderer.asset.moving is not None:
        return Captured(renderer.asset)
    if renderer.asset.f0 is None:
        return None
    dome = root.parent / "environment.exr"
    return StandardLight(renderer, read_linear(dome), dome.name, check=check)


def spread(items: tuple[int, ...], count: int) -> list[int]:
    """At most `count` of the items, evenly spaced."""
    picks = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in picks]


def factor_for(camera: Camera) -> int:
    """Side of the smallest block of photo pixels that divides the photo and reduces its longest side to FITTED_SIDE."""
    longest = max(camera.width, camera.height)
    fits = [
        f
        for f in range(1, longest + 1)
        if camera.width % f == 0 and camera.height % f == 0 and longest <= f * FITTED_SIDE
    ]
    return fits[0] if fits and min(camera.width, camera.height) // fits[0] >= 64 else 1


def render_previews(scene: Scene, size: int, folder: Path, check: Callable[[], None]) -> list[Path]:
    """Write SIDE.png under the captured light and shape_SIDE.png in grey, from three sides."""
    written = []
    for side, degrees in SIDES.items():
        view = framing(scene.renderer, np.radians(degrees), size)
        for name, options in ((side, {"light": scene.light}), (f"shape_{side}", {"light": GREY_LIGHT, "plain": True})):
            check()
            written.append(folder / f"{name}.png")
            write_rgba_png(written[-1], scene.renderer.render(view, **options))
    return written


def render_thumbnail(scene: Scene, path: Path) -> Path:
    """Write a picture of the head, slightly from one side, under the captured light."""
    view = framing(scene.renderer, np.radians(THUMBNAIL_TURN), THUMBNAIL_SIDE)
    path = Path(os.path.normpath(path))  # symbolic links stay: the store's folder may be one
    write_rgba_png(path, scene.renderer.render(view, light=scene.light))
    return path


def framing(renderer: Renderer, azimuth: float, size: int) -> PinholeCamera:
    """A square view of the whole asset from `azimuth` (radians from +Z towards +X)."""
    vertices = renderer.asset.mesh.vertices
    centre = (vertices.min(0) + vertices.max(0)).astype(np.float64) / 2
    return orbit_camera(float(np.linalg.norm(vertices - centre, axis=1).max()), azimuth, size, centre)


def write_rgba_png(path: Path, rgba: F32) -> None:
    """Write linear premultiplied RGBA (H, W, 4) as 8-bit sRGB with straight alpha, as PNG defines it."""
    alpha = rgba[..., 3:].clip(0, 1)
    straight = np.where(alpha > 0, rgba[..., :3] / np.maximum(alpha, 1e-6), 0).clip(0, 1)
    write_png(path, np.concatenate([srgb_from_linear(straight), alpha], -1))
