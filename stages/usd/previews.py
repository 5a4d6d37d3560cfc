"""Pictures of the exported asset: the held-out views, and its shape and look from three sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera, CameraSet, FittedFace, HeldOutView
from pipeline.colour import srgb_from_linear
from pipeline.contract import Context
from pipeline.images import write_exr, write_png
from pipeline.transforms import matrix
from stages.usd.exported import load_exported
from stages.usd.render import Renderer, View, orbit_view

F32 = npt.NDArray[np.float32]
SIDES = {"left": -55.0, "front": 0.0, "right": 55.0}  # degrees of azimuth
GREY_LIGHT = np.array([[3.2, 3.2, 3.2], [1.6, 1.6, 1.6], [1.9, 1.9, 1.9], [0.9, 0.9, 0.9]], np.float32)
"""A soft light from above, front and the subject's left: orders 0 and 1, for pictures of the shape alone."""


def view_of(camera: Camera) -> View:
    """A manifest's camera for the renderer."""
    return View(
        matrix(camera.K),
        matrix(camera.world_from_cam),
        camera.width,
        camera.height,
        np.asarray(camera.distortion, np.float64),
    )


def render_held_out(
    root: Path, cameras: CameraSet, face: FittedFace, samples: int, context: Context
) -> tuple[HeldOutView, ...]:
    """asset_views/I.exr and .png for each view that the fit predicted, at the same scale."""
    by_index = {c.index: c for c in cameras.cameras}
    wanted = [v for v in face.held_out if v.index in by_index]
    if not wanted:
        return ()
    renderer = Renderer(load_exported(root))
    out = []
    for number, view in enumerate(wanted):
        context.check()
        context.progress(number, len(wanted), f"asset view {view.index}")
        rgba = renderer.render(view_of(by_index[view.index]), factor=view.scale, samples=samples)
        exr, png = (context.workdir / f"asset_views/{view.index}.{e}" for e in ("exr", "png"))
        write_exr(exr, rgba)
        write_rgba_png(png, rgba)
        out.append(HeldOutView(index=view.index, exr=context.file(exr), png=context.file(png), scale=view.scale))
    return tuple(out)


def render_previews(root: Path, size: int, folder: Path, check: Callable[[], None]) -> list[Path]:
    """SIDE.png under the captured light and shape_SIDE.png in grey, from three sides."""
    renderer = Renderer(load_exported(root))
    vertices = renderer.asset.mesh.vertices
    centre = (vertices.min(0) + vertices.max(0)).astype(np.float64) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    written = []
    for side, degrees in SIDES.items():
        view = orbit_view(radius, np.radians(degrees), size, centre)
        for name, options in ((side, {}), (f"shape_{side}", {"light": GREY_LIGHT, "plain": True})):
            check()
            written.append(folder / f"{name}.png")
            write_rgba_png(written[-1], renderer.render(view, **options))  # type: ignore[arg-type]
    return written


def write_rgba_png(path: Path, rgba: F32) -> None:
    """8-bit sRGB with straight alpha, as PNG defines it, from linear premultiplied RGBA."""
    alpha = rgba[..., 3:].clip(0, 1)
    straight = np.where(alpha > 0, rgba[..., :3] / np.maximum(alpha, 1e-6), 0).clip(0, 1)
    write_png(path, np.concatenate([srgb_from_linear(straight), alpha], -1))
