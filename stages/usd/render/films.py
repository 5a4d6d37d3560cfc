"""Films of one turn of the asset for the report, under the captured light and a made one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear
from pipeline.film import animated_webp
from pipeline.maths import studio_lights
from stages.usd.render.previews import Scene, framing
from stages.usd.render.relight import Environment
from stages.usd.render.render import CarriedLight, Light
from stages.usd.render.standard_light import StandardLight

U8 = npt.NDArray[np.uint8]
SECONDS, QUALITY = 4.0, 80  # of a turn; of the WebP
MADE, MADE_WIDTH = "sunset", 256  # the light that differs most from what photos are taken in; columns of its picture
MADE_LAMPS = 128  # of the made light: pictures of this size differ from those under 384 by less than a level (55 dB)
GREY = 0.103  # linear: 90 of 255, what the report shows behind pictures


def render_films(scene: Scene, frames: int, size: int, folder: Path, check: Callable[[], None]) -> list[Path]:
    """Write turn_captured.webp and turn_sunset.webp: `frames` pictures of `size` pixels a side each; none for 0."""
    if not frames:
        return []
    written = []
    for name, light in _lights(scene, check):
        film = animated_webp(list(_turn(scene, light, frames, size, check)), SECONDS, QUALITY)
        written.append(folder / f"turn_{name}.webp")
        written[-1].write_bytes(film)
    return written


def _lights(scene: Scene, check: Callable[[], None]) -> Iterator[tuple[str, Light | CarriedLight | None]]:
    """The second is made when the first film is done: each takes memory."""
    yield "captured", scene.light
    picture = studio_lights.picture(MADE, MADE_WIDTH)
    if scene.renderer.asset.f0 is None:
        yield MADE, Environment(scene.renderer, picture, MADE, check=check)
    else:
        yield MADE, StandardLight(scene.renderer, picture, MADE, MADE_LAMPS, check)


def _turn(
    scene: Scene, light: Light | CarriedLight | None, frames: int, size: int, check: Callable[[], None]
) -> Iterator[U8]:
    """sRGB pictures (size, size, 3) over grey, from azimuth 0 on."""
    for azimuth in 2 * np.pi * np.arange(frames) / frames:
        check()
        rgba = scene.renderer.render(framing(scene.renderer, float(azimuth), size), samples=0, light=light)
        shown = rgba[..., :3] + GREY * (1 - rgba[..., 3:])
        yield np.round(255 * srgb_from_linear(shown.clip(0, 1))).astype(np.uint8)
