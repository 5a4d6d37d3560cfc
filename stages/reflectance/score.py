"""How well a field predicts pictures under lights that it was not fitted to, against blending of pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.camera import PinholeCamera
from pipeline.colour import srgb_from_linear
from pipeline.images import F32, read_linear
from pipeline.transforms import F64
from stages.reflectance.field import Field, Lamp
from stages.reflectance.relight import lit_by, look_up, picture
from stages.reflectance.rig import Rig, moved_camera

COVERED = 0.99  # of a pixel: those at the silhouette are not scored
NEAREST = 3
FLOOR = 10**-9.9  # least error that is told: 99 dB


@dataclass(frozen=True, slots=True)
class Score:
    """Mean squared errors over covered pixels, display-encoded, one for each picture: of the field, of blending the
    three nearest lights, and of the field as standard shaders show it (NaN: not asked); angle to the nearest light of
    the fit, degrees; camera and light, places in the rig; level: mean of the truth there, encoded."""

    camera: int
    light: int
    field: float
    blend: float
    angle: float
    level: float = 1.0
    standard: float = float("nan")


def decibels(errors: Sequence[float]) -> float:
    """PSNR of pictures together: of the mean of their squared errors, at most 99; NaN of none."""
    mean = float(np.mean(errors)) if len(errors) else float("nan")
    return round(float(-10 * np.log10(max(mean, FLOOR))), 3)


def encoded(linear: F32, gain: float) -> F64:
    """Display-encoded values of a linear picture times gain, cut to [0, 1]."""
    return np.asarray(srgb_from_linear(np.maximum(linear.astype(np.float64) * gain, 0)).clip(0, 1), np.float64)


def camera_at(rig: Rig, camera: int, light: int) -> PinholeCamera:
    """A camera as the head sees it at a light's frame."""
    shot = rig.cameras[camera]
    return PinholeCamera.of(shot, moved_camera(shot, rig.motion[light]))


def score(
    field: Field,
    rig: Rig,
    pictures: Mapping[tuple[int, int], Path],
    fitted: Sequence[int],
    wanted: Sequence[tuple[int, int]],
    gain: float,
    tick: Callable[[int, int], None],
    mask: Mapping[int, npt.NDArray[np.bool_]] | None = None,
    standard: Field | None = None,
) -> list[Score]:
    """A score for each wanted (camera, light). fitted: places of the lights in the fit, which are blended. gain: of the
    display. mask: pixels (H, W) that count, by camera; those that the mesh covers, without. standard: on the same
    texels, what is scored as such."""
    positions, axes = rig.lamps()
    arrives: dict[int, list[F32]] = {}
    fields = [field, *([standard] if standard is not None else [])]
    out = []
    for done, (c, i) in enumerate(wanted):
        tick(done, len(wanted))
        lamp = Lamp(positions[i], axes[i], rig.strength[i])
        if i not in arrives:
            arrives = {i: [f.arrives(lamp) for f in fields]}
        camera = camera_at(rig, c, i)
        table = look_up(field, camera)
        made, *other = (
            picture(camera, table, lit_by(f, camera, lamp, a)) for f, a in zip(fields, arrives[i], strict=True)
        )
        truth = encoded(read_linear(pictures[c, i]), gain)
        counted = made[..., 3] > COVERED if mask is None else mask[c]
        blend, angle = blended(rig, pictures, fitted, c, i)
        shown = (made[..., :3], blend, *(p[..., :3] for p in other))
        errors = [float(np.mean((encoded(p, gain) - truth)[counted] ** 2)) for p in shown]
        level = float(np.mean(truth[counted]))
        out.append(Score(c, i, errors[0], errors[1], angle, level, *errors[2:]))
    return out


def blended(
    rig: Rig, pictures: Mapping[tuple[int, int], Path], fitted: Sequence[int], camera: int, light: int
) -> tuple[F32, float]:
    """(H, W, 3) mean of a camera's pictures under the three nearest fitted lights, weighted by 1 / angle and scaled to
    the light's intensity; and the angle to the nearest, degrees."""
    known = [i for i in fitted if (camera, i) in pictures]
    angles = np.arccos(np.clip(rig.towards[known] @ rig.towards[light], -1, 1))
    order = np.argsort(angles, kind="stable")[:NEAREST]
    weight = 1 / np.maximum(angles[order], 1e-4)
    weight /= weight.sum()
    parts = [w * read_linear(pictures[camera, known[k]]) * (rig.strength[light] / rig.strength[known[k]])
             for w, k in zip(weight, order, strict=True)]  # fmt: skip
    return np.asarray(np.sum(parts, 0), np.float32), float(np.degrees(angles[order[0]]))
