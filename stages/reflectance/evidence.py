"""What the report shows of a field: scores of left-out lights, pictures of some, and what fewer lamps cost.

Pictures of left-out lights stand beside the truth, display-encoded. `--quick` is compared with the full number of lamps
for one made environment, on a subset of the texels that the first camera sees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.images import F32, read_linear, write_png
from pipeline.maths import studio_lights
from pipeline.reflectance_artifacts import LeftOutPicture
from stages.reflectance.field import Field, Lamp
from stages.reflectance.relight import FULL, QUICK, lamps_of, lit_by, look_up, picture
from stages.reflectance.rig import Rig
from stages.reflectance.score import Score, camera_at, decibels, encoded

ENVIRONMENT, WIDTH = "sunset", 128  # the hardest of the made lights; columns of its picture
TEXELS = 6000  # at most, for the environment
SHOWN = ("best", "median", "worst")  # pictures of left-out lights
FOLDER = "shown"


def listed(found: Sequence[Score], rig: Rig) -> tuple[LeftOutPicture, ...]:
    """The scores of single pictures, for the manifest."""
    return tuple(
        LeftOutPicture(camera=rig.cameras[s.camera].index, light=rig.index[s.light], angle=round(s.angle, 2),
                       psnr=decibels([s.field]), blend_psnr=decibels([s.blend]))
        for s in found
    )  # fmt: skip


def chosen(found: Sequence[Score]) -> dict[str, Score]:
    """The pictures with the least, the median and the largest error, by these names; none of fewer than three. The
    darker half does not take part: of a light behind the head hardly anything is seen."""
    dark = float(np.median([s.level for s in found])) if found else 0.0
    order = sorted((s for s in found if s.level >= dark), key=lambda s: (s.field, s.camera, s.light))
    places = {"best": 0, "median": len(order) // 2, "worst": len(order) - 1}
    return {name: order[places[name]] for name in SHOWN if order} if len(order) >= len(SHOWN) else {}


def write_pictures(
    field: Field, rig: Rig, pictures: Mapping[tuple[int, int], Path], found: Sequence[Score], gain: float, folder: Path
) -> list[Path]:
    """NAME_CAMERA_LIGHT.png: truth on the left, field on the right, for each of `chosen`. gain: of the display."""
    positions, axes = rig.lamps()
    out = []
    for name, s in chosen(found).items():
        lamp, view = Lamp(positions[s.light], axes[s.light], rig.strength[s.light]), camera_at(rig, s.camera, s.light)
        made = picture(view, look_up(field, view), lit_by(field, view, lamp, field.arrives(lamp)))
        truth = read_linear(pictures[s.camera, s.light]) * made[..., 3:]
        path = folder / f"{name}_{rig.cameras[s.camera].index}_{rig.index[s.light]}.png"
        write_png(path, np.hstack([encoded(truth, gain), encoded(made[..., :3], gain)]))
        out.append(path)
    return out


def fewer_lamps(field: Field, eye: np.ndarray, seen: np.ndarray, tick: Callable[[int, int], None]) -> dict[str, float]:
    """How far an environment by QUICK lamps is from one by FULL: `quick_psnr`, dB over texels that a camera at eye (3,)
    sees, `seen` (T,); and both numbers of lamps, to which the time is proportional."""
    texels = np.flatnonzero(seen & field.known)
    if not len(texels):
        return {}
    some = field.part(texels[:: max(1, len(texels) // TEXELS)])
    made: list[F32] = []
    for number, quick in enumerate((True, False)):
        total = np.zeros((len(some.known), 3), np.float32)
        lamps = lamps_of(studio_lights.picture(ENVIRONMENT, WIDTH), ENVIRONMENT, quick=quick)
        for done, lamp in enumerate(lamps):
            tick(number * QUICK + done, QUICK + FULL)
            total += some.radiance(lamp, eye, some.arrives(lamp, 1))
        made.append(total)
    gain = 0.9 / max(float(np.quantile(made[1].max(1), 0.99)), 1e-9)
    error = float(np.mean((encoded(made[0], gain) - encoded(made[1], gain)) ** 2))
    return {"quick_psnr": decibels([error]), "quick_lamps": QUICK, "full_lamps": FULL}
