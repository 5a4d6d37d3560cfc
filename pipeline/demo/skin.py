"""The demo skin: colour and gloss as functions of the place on the head.

Symbols
    p          surface positions, (N, 3), metres, world frame
    albedo     diffuse reflectance, (N, 3), linear RGB in [0, 1]
    f0         specular reflectance at normal incidence, (N,), in [0.02, 0.06]
    roughness  GGX roughness, (N,), in [0.30, 0.55]; the lobe's width is roughness squared

    albedo = base exp(-blood e_blood - melanin e_melanin) (1 - hair) + hair's colour

Blood reddens cheeks, nose, ears and lips; melanin browns freckles and mottles; hair is brows, lashes and a
close crop. Everything is a fixed function of the position and of the seed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.demo import head
from pipeline.demo.compiled import compiled

F64 = npt.NDArray[np.float64]

BASE = np.array([0.60, 0.405, 0.315])  # linear RGB of bloodless, unpigmented skin
BLOOD = np.array([0.10, 0.62, 0.56])  # absorbance at full blood
MELANIN = np.array([0.42, 0.68, 0.95])  # absorbance at full pigment
HAIR = np.array([0.055, 0.036, 0.026])

# Height of the hairline over z, millimetres: nape, behind the ear, sideburn, temple, forehead.
_HAIRLINE = (
    (-110.0, -60.0, -34.0, -10.0, 4.0, 14.0, 26.0, 38.0, 48.0, 66.0, 90.0),
    (-62.0, -60.0, -48.0, -30.0, -26.0, -6.0, 14.0, 34.0, 54.0, 65.0, 66.0),
)

F0_RANGE = (0.02, 0.06)
ROUGHNESS_RANGE = (0.30, 0.55)


@dataclass(frozen=True, slots=True)
class Material:
    """`albedo` (N, 3) linear RGB, `f0` (N,), `roughness` (N,)."""

    albedo: F64
    f0: F64
    roughness: F64


def material(points: F64, seed: int = 0) -> Material:
    """Skin at surface `points` (N, 3), metres."""
    p = points * 1000.0
    side = np.abs(p[:, 0])
    lips, brow, lash, crop = _lips(points), _brows(p, side, seed), _lashes(p, side), _crop(p, side, seed)
    flush = 0.16 * _noise(p, 22.0, 2, seed + 1) + 0.10 * _noise(p, 3.0, 2, seed + 2)
    blood = _blood(p, side) + 0.80 * lips + flush
    melanin = 0.10 + 0.14 * _noise(p, 9.0, 3, seed + 3) + 0.75 * _freckles(p, side, seed) * (1.0 - lips)
    # Pores are small dark dots; their relief is too fine for the pictures and is left to the colour.
    pores = 0.10 * _noise(p, 0.9, 2, seed + 4) + 0.05 * _noise(p, 2.0, 1, seed + 5)
    beard = _beard(p, side) * (0.55 + 0.45 * _noise(p, 1.1, 1, seed + 6))
    absorbed = np.maximum(blood, 0.0)[:, None] * BLOOD + np.maximum(melanin + pores, 0.0)[:, None] * MELANIN
    skin = BASE * np.exp(-absorbed) * (1.0 - beard[:, None] * np.array([0.32, 0.26, 0.20]))
    hair = np.clip(np.maximum(np.maximum(brow, lash), crop), 0.0, 1.0)
    albedo = skin * (1.0 - hair[:, None]) + HAIR * hair[:, None]
    f0, roughness = _gloss(p, side, lips, hair, seed)
    return Material(np.clip(albedo, 0.0, 1.0), f0, roughness)


def _gloss(p: F64, side: F64, lips: F64, hair: F64, seed: int) -> tuple[F64, F64]:
    """Specular reflectance and roughness: an oily T-zone, moist lips, dull hair."""
    oily = _spot(p, side, (0, 52, 86), (34, 22, 40)) + 1.1 * _spot(p, side, (0, -26, 104), (13, 26, 26))
    oily = np.clip(oily + 0.5 * _spot(p, side, (0, -99, 88), (18, 12, 22)), 0.0, 1.0)
    patches = _noise(p, 14.0, 2, seed + 7)
    grain = _noise(p, 2.2, 1, seed + 8)
    f0 = 0.030 + 0.014 * oily + 0.010 * lips - 0.005 * hair + 0.004 * patches + 0.003 * grain
    roughness = 0.47 - 0.10 * oily - 0.09 * lips + 0.05 * hair + 0.03 * patches + 0.02 * grain
    return np.clip(f0, *F0_RANGE), np.clip(roughness, *ROUGHNESS_RANGE)


def _blood(p: F64, side: F64) -> F64:
    """How much blood shows: cheeks, nose, ears, lids and chin."""
    cheek, nose = _spot(p, side, (44, -30, 62), (20, 17, 34)), _spot(p, side, (0, -38, 108), (17, 12, 18))
    ear, chin = _spot(p, side, (84, -20, -18), (15, 34, 26)), _spot(p, side, (0, -100, 88), (20, 12, 20))
    lid = _spot(p, side, (32, -4, 76), (18, 10, 14))
    return np.asarray(0.05 + 0.42 * cheek + 0.40 * nose + 0.42 * ear + 0.16 * chin + 0.22 * lid)


def _lips(points: F64) -> F64:
    """Coverage of the red of the lips, in [0, 1]."""
    x, y, height = head.mouth_coordinates(points)
    upper, lower = head.lip_borders(x)
    inside = _step(upper - y, -0.7, 0.7) * _step(y - lower, -0.7, 0.7)
    return np.asarray(inside * _step(height, -14.0, -10.0) * _step(27.5 - np.abs(x), -1.0, 2.0))


def _brows(p: F64, side: F64, seed: int) -> F64:
    """Brow hair: a tapering arc, combed into strands."""
    along = (side - 9.0) / 44.0
    middle = 16.5 + 8.5 * along - 11.5 * along**2 + 0.5
    width = 3.6 * (1.0 - 0.75 * np.clip(along, 0.0, 1.0) ** 1.5)
    inside = _step(width - np.abs(p[:, 1] - middle), -1.6, 1.2)
    inside = inside * _step(along, -0.06, 0.10) * _step(1.0 - along, 0.0, 0.15) * _step(p[:, 2], 30.0, 40.0)
    # Strands are noise stretched along the comb's direction.
    lean = p[:, 0] * 0.35 + p[:, 1] * 0.25 * np.sign(p[:, 0])
    combed = np.stack([lean, p[:, 1] - 0.25 * side, p[:, 2] * 0.3])
    strands = 0.72 + 0.4 * _noise(np.ascontiguousarray(combed.T), 0.9, 2, seed + 9)
    return np.asarray(0.88 * inside * np.clip(strands, 0.0, 1.0))


def _lashes(p: F64, side: F64) -> F64:
    """The dark line of the closed lashes."""
    line, half = head.lid_line(side)
    near = np.exp(-(((p[:, 1] - line + 0.4) / 0.9) ** 2))
    return np.asarray(0.8 * near * _step(half - np.abs(side - 32.0), 0.0, 2.5) * _step(p[:, 2], 60.0, 64.0))


def _crop(p: F64, side: F64, seed: int) -> F64:
    """Closely cropped hair above a ragged hairline."""
    ragged = 2.5 * _noise(p, 6.0, 2, seed + 10)
    above = p[:, 1] - np.interp(p[:, 2], _HAIRLINE[0], _HAIRLINE[1]) + ragged
    not_ear = 1.0 - _step(side, 72.5, 75.5) * _step(20.0 - p[:, 1], 0.0, 5.0)
    grain = 0.72 + 0.30 * _noise(p, 0.8, 2, seed + 11) + 0.10 * _noise(p, 5.0, 1, seed + 12)
    return np.asarray(0.80 * _step(above, -4.0, 9.0) * np.clip(not_ear, 0.0, 1.0) * np.clip(grain, 0.0, 1.0))


def _beard(p: F64, side: F64) -> F64:
    """Shaven beard: a cooler, darker veil on jaw, chin and upper lip."""
    jaw = _step(-58.0 - p[:, 1] - 0.32 * np.maximum(p[:, 2] - 40.0, 0.0) + 0.55 * side, 0.0, 18.0)
    jaw = jaw * _step(p[:, 1] + 128.0, 0.0, 18.0) * _step(p[:, 2], 2.0, 18.0)
    lip = _spot(p, side, (12, -56, 92), (17, 7, 14))
    return np.asarray(np.clip(0.75 * jaw + 0.6 * lip, 0.0, 1.0))


def _freckles(p: F64, side: F64, seed: int) -> F64:
    """Coverage of freckles, thickest across nose and cheeks."""
    where = _spot(p, side, (30, -20, 80), (30, 16, 30)) + 0.8 * _spot(p, side, (0, -14, 96), (14, 16, 20))
    cover = np.zeros(len(p))
    freckled = np.flatnonzero(where > 0.05)
    cover[freckled] = _speckles(p[freckled] / 4.0, seed + 13) * np.clip(where[freckled], 0.0, 1.0)
    return cover


def _spot(p: F64, side: F64, centre: tuple[float, float, float], widths: tuple[float, float, float]) -> F64:
    """Gaussian spot, one on each side of the face; millimetres."""
    x, y = (side - centre[0]) / widths[0], (p[:, 1] - centre[1]) / widths[1]
    z = (p[:, 2] - centre[2]) / widths[2]
    return np.asarray(np.exp(-(x * x + y * y + z * z)))


def _step(value: F64, low: float, high: float) -> F64:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def _noise(p: F64, cell: float, octaves: int, seed: int) -> F64:
    """Noise (N,) in about [-1, 1] at `p` (N, 3), with features of size `cell` and finer."""
    return _value_noise(np.ascontiguousarray(p) / cell, octaves, seed)


@compiled
def _lattice(i: int, j: int, k: int, seed: int) -> float:
    """Fixed pseudo-random number in [-1, 1) of an integer place."""
    h = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791) ^ (seed * 2654435761)
    h = (h ^ (h >> 13)) * 1274126177 & 0x7FFFFFFF
    h = (h ^ (h >> 15)) * 668265263 & 0x7FFFFFFF
    return (h ^ (h >> 14)) / 1073741824.0 - 1.0


@compiled
def _value_noise(p: F64, octaves: int, seed: int) -> F64:
    """Sum of smooth lattice noise; each octave has twice the frequency and half the height."""
    out = np.zeros(p.shape[0])
    for n in range(p.shape[0]):
        scale, weight = 1.0, 1.0
        for octave in range(octaves):
            x, y, z = p[n, 0] * scale, p[n, 1] * scale, p[n, 2] * scale
            i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            x, y, z = x - i, y - j, z - k
            x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
            total = 0.0
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                share = (x if a else 1 - x) * (y if b else 1 - y) * (z if c else 1 - z)
                total += share * _lattice(i + a, j + b, k + c, seed + 101 * octave)
            out[n] += weight * total
            scale, weight = scale * 2.0, weight * 0.5
    return out


@compiled
def _speckles(p: F64, seed: int) -> F64:
    """Coverage (N,) by round spots, one of random place, size and strength in each unit cell; `p` (N, 3)."""
    out = np.zeros(p.shape[0])
    for n in range(p.shape[0]):
        i, j, k = int(np.floor(p[n, 0])), int(np.floor(p[n, 1])), int(np.floor(p[n, 2]))
        for cell in range(27):
            a, b, c = i + cell % 3 - 1, j + (cell // 3) % 3 - 1, k + cell // 9 - 1
            strength = _lattice(a, b, c, seed)
            if strength < 0.1:  # most cells stay empty
                continue
            dx = p[n, 0] - a - 0.5 - 0.45 * _lattice(a, b, c, seed + 1)
            dy = p[n, 1] - b - 0.5 - 0.45 * _lattice(a, b, c, seed + 2)
            dz = p[n, 2] - c - 0.5 - 0.45 * _lattice(a, b, c, seed + 3)
            radius = 0.24 + 0.12 * _lattice(a, b, c, seed + 4)
            t = min(max(1.6 - math.sqrt(dx * dx + dy * dy + dz * dz) / radius, 0.0), 1.0)
            out[n] = max(out[n], (0.35 + 0.65 * strength) * t * t * (3.0 - 2.0 * t))
    return out
