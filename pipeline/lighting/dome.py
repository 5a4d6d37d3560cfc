"""The captured light: conversion between spherical harmonics and a lat-long picture, and its file.

The picture's directions: pipeline/maths/latlong.py.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from pipeline.errors import StageError
from pipeline.lighting.given import sh_of_latlong
from pipeline.lighting.moving import MovingLight, from_stored
from pipeline.maths import sh
from pipeline.maths.latlong import latlong_directions, latlong_weights

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

KEPT_ORDER, SOLVE_WIDTH, SOLVE_STEPS = 4, 128, 200  # of the correction of the positive picture
STEPS = (1.0, 1.0, 1.0, 0.03, 0.03), (1.0, 1.0, 1.0, 0.0, 0.0)  # of each band: diffuse light has hardly more than three
FAITHFUL = 0.05  # of the mean irradiance: largest error with which the bands 3 and 4 are kept

CONVENTION = (
    "Radiance L(d) = sum over l = 0..order, m = -l..l of coefficients[l * (l + 1) + m] * Y_lm(d), linear Rec.709, one "
    "column a colour. Y_lm are the real, orthonormal spherical harmonics without the Condon-Shortley phase "
    "(Y_00 = 0.28209, Y_1m = 0.48860 * (y, z, x)), with the polar axis along z of the asset coordinates (right-handed, "
    "Y up, metres). d is a unit vector from the surface towards the light. The raw sum may be slightly negative; "
    "environment.exr is the positive picture with the same harmonics up to order 4, or 2 where none has those."
)

MOVING = (
    "The light stands still relative to the camera, not to the subject; the coefficients above are those while the "
    "camera is in front of the face. frame camera: coefficients in the camera's axes (x right, y down, z forward). "
    "frame turntable: in these axes without the camera's tilt: y along -Y, z level. "
    "frame flash: z is the ray from the camera to the point, x the camera's x axis made perpendicular to it, and the "
    "radiance is times (distance / distance of the point from the camera)^2, metres. ambient: the part that stands "
    "still in the asset's coordinates, added to it."
)


def environment(light: F32, width: int) -> F32:
    """(width / 2, width, 3) picture of the light without negative values, for any renderer.

        max(L(d) + sum_{l <= 4} q_lm Y_lm(d), 0)

    A sum of harmonics rings below 0 beside bright lamps. Clamping alone would add light; q removes it again, so that
    the picture's harmonics up to order KEPT_ORDER equal those of the light. They determine its energy and, through the
    clamped cosine, nearly all of the irradiance of a surface. Perhaps no positive picture has these harmonics, where a
    light was fitted very dark somewhere. Bands 0 to 2 come first then, those of the irradiance, and alone where it
    would be wrong by more than FAITHFUL otherwise. A factor per colour keeps the energy.
    """
    height = width // 2
    small = _picture(light, SOLVE_WIDTH)
    basis, weights = harmonics(SOLVE_WIDTH, KEPT_ORDER), latlong_weights(SOLVE_WIDTH, SOLVE_WIDTH // 2)
    spread = np.broadcast_to(weights, small.shape[:2]).reshape(-1, 1)
    wanted = basis.T @ (spread * small.reshape(-1, 3))
    for steps in STEPS:
        q = np.zeros_like(wanted)
        step = np.repeat(steps, 2 * np.arange(KEPT_ORDER + 1) + 1)[:, None]
        for _ in range(SOLVE_STEPS):
            image = (small.reshape(-1, 3) + basis @ q).clip(min=0)
            left = wanted - basis.T @ (spread * image)
            q += step * left
        if _irradiance_of(left) <= FAITHFUL * _irradiance_of(wanted[:1]):
            break
    raw = _picture(light, width)
    image = (raw + (harmonics(width, KEPT_ORDER) @ q).reshape(height, width, 3)).clip(min=0)
    energy, found = ((x * latlong_weights(width, height)[..., None]).sum((0, 1)) for x in (raw, image))
    return np.asarray(image * (energy.clip(min=0) / np.where(found > 0, found, 1)), np.float32)


def _irradiance_of(coefficients: F64) -> float:
    """Largest irradiance in magnitude over all directions, of coefficients (n, 3) of complete bands."""
    directions = torch.from_numpy(latlong_directions(64, 32).reshape(-1, 3))
    return float(sh.irradiance(torch.from_numpy(coefficients), directions).abs().max())


def _picture(light: F32, width: int) -> F64:
    """(width / 2, width, 3) L(d), including its negative values."""
    directions = torch.from_numpy(latlong_directions(width, width // 2).reshape(-1, 3))
    found: F64 = sh.radiance(torch.from_numpy(np.asarray(light, np.float64)), directions).numpy()
    return found.reshape(width // 2, width, 3)


def harmonics(width: int, order: int) -> F64:
    """(pixels, (order + 1)^2) Y_lm in the directions of a picture."""
    directions = torch.from_numpy(latlong_directions(width, width // 2).reshape(-1, 3))
    found: F64 = sh.sh_basis(directions, order).numpy()
    return found


def environment_figures(light: F32, image: F32) -> dict[str, float]:
    """For the report: how negative the raw light is, and how well the picture (width / 2, width, 3) represents it.

    light_negative_share: of the larger of the raw light's positive and negative energy, in [0, 1];
    light_peak_ratio: picture's over raw maximum (of the absolute values, if the raw light is nowhere positive);
    light_irradiance_error: largest difference of E(n) over all n, relative to the mean of |E|.
    """
    raw = _picture(light, SOLVE_WIDTH)
    weights = latlong_weights(SOLVE_WIDTH, SOLVE_WIDTH // 2)[..., None]
    positive, negative = (float(((sign * raw).clip(min=0) * weights).sum()) for sign in (1, -1))
    peak = float(raw.max()) if raw.max() > 0 else float(np.abs(raw).max())
    n = torch.from_numpy(latlong_directions(64, 32).reshape(-1, 3).astype(np.float32))
    wanted = sh.irradiance(torch.from_numpy(np.asarray(light, np.float32)), n).numpy()
    found = sh.irradiance(torch.from_numpy(light_from_environment(image)), n).numpy()
    figures = {
        "light_negative_share": negative / max(positive, negative, 1e-30),
        "light_peak_ratio": float(image.max()) / max(peak, 1e-30),
        "light_irradiance_error": float(np.abs(found - wanted).max()) / max(float(np.abs(wanted).mean()), 1e-30),
    }
    return {k: round(v, 5) for k, v in figures.items()}


def light_from_environment(image: F32, order: int = sh.ORDER) -> F32:
    """((order + 1)^2, 3) coefficients of a lat-long picture (H, W, 3), by a sum over its pixels."""
    return sh_of_latlong(image, order, np.eye(3)).astype(np.float32)


def light_json(light: F32, attenuation: str, moving: MovingLight | None = None) -> str:
    """JSON of the raw coefficients, with their definition. moving: the light itself, if `light` is its stand-in."""
    rows = [[float(f"{x:.9g}") for x in row] for row in np.asarray(light, np.float64)]
    content = {
        "order": int(np.sqrt(len(light))) - 1,
        "convention": CONVENTION,
        "attenuation": attenuation,
        "colour_space": "linear Rec.709",
        "coefficients": rows,
    }
    if moving is not None:
        content["moving"] = {"meaning": MOVING, **moving.stored()}
    return json.dumps(content, indent=1) + "\n"


def read_moving(path: Path) -> MovingLight | None:
    """The light of light.json that moves with the camera; None if the light stands still, as in files of another kind.
    StageError if it is damaged."""
    if path.suffix != ".json":
        return None
    try:
        return from_stored(json.loads(path.read_text()).get("moving"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
        raise _bad_light(path, e) from e


def read_light(path: Path) -> F32:
    """((L + 1)^2, 3) coefficients from light.json, or from the fit's .npz or .npy file."""
    try:
        found: Any
        if path.suffix == ".json":
            found = json.loads(path.read_text())["coefficients"]
        else:
            stored = np.load(path, allow_pickle=False)
            found = (
                stored if isinstance(stored, np.ndarray) else stored["light" if "light" in stored else stored.files[0]]
            )
        light = np.asarray(found, np.float32)
    except (OSError, ValueError, KeyError, IndexError) as e:
        raise _bad_light(path, e) from e
    if (
        light.ndim != 2
        or light.shape[1] != 3
        or int(np.sqrt(len(light))) ** 2 != len(light)
        or not np.isfinite(light).all()
    ):
        raise _bad_light(path, f"array of {light.shape}, {int((~np.isfinite(light)).sum())} not finite")
    return light


def _bad_light(path: Path, value: object) -> StageError:
    return StageError(
        "the captured light can't be used",
        where=path.name,
        value=value,
        limit="(order + 1)^2 rows of three finite coefficients",
        remedy="run the inverse_rendering stage again",
    )
