"""The checks of a light stage's pictures, on thumbnails.

Light adds: the sum S of the pictures under single lights is the picture F under all of them, up to lights that are
missing. And pictures change smoothly with the light's direction: each is predicted by those under the lights around it.

Symbols
    T_i     thumbnails of all cameras under light i, over its intensity: a vector
    P_i     its prediction, the mean of T over the nearest other lights, weighted by their angle
    g_i     T_i . P_i / P_i . P_i, how bright the light is against its prediction
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.capture_artifacts import StageLight
from pipeline.colour import LUMA
from pipeline.images import F32
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.transforms import F64
from pipeline.verdict import Finding, Limits, judged

SIDE = 24  # pixels of a thumbnail
NEAREST = 4  # lights that predict another
FAILED = 0.1  # of its prediction: a light that shows less did not flash
BETTER = 0.35  # an exchange is believed if it reduces the squared error of both pictures to this share
GRID, FARTHEST = (180, 90), 0.9  # directions all around, of a lat-long grid; the share of them that has a light near
BLACK = 1e-4  # of the brightest thumbnail: a picture with less shows nothing

# shares of pictures; what is missing leaves a gap in the directions only
MISSING = Limits(0.02, 0.3, lower=False)
SATURATED = Limits(0.0, 0.2, lower=False)
LIGHTS_OUT = Limits(0.0, 0.25, lower=False)
# degrees to the nearest light, 90 % of all directions have less: 15 with 84 lights all around, 22 with 42, 32 with 21,
# 51 with 11
DIRECTIONS = Limits(25.0, 45.0, lower=False)
# sum of single pictures against the picture under all lights: their exponent less 1, or their ratio above 1
LINEAR = Limits(0.12, 0.25, lower=False)
# change of the brightness from the first to the last frame
DRIFT = Limits(0.12, 0.4, lower=False)


@dataclass(frozen=True, slots=True)
class Single:
    """A picture under one light: thumbnail (SIDE, SIDE), hash of the user's file, and the copy."""

    thumb: F64
    sha256: str
    copy: Path


@dataclass(frozen=True, slots=True)
class Sequences:
    """What the checks compare. lights: by index; singles: by (camera, light); full: thumbnails under all lights, by
    camera."""

    lights: Mapping[int, StageLight]
    singles: Mapping[tuple[int, int], Single]
    full: Mapping[int, F64]


def thumbnail(picture: F32) -> F64:
    """(SIDE, SIDE) mean luminance over blocks of a linear picture (H, W, 3); H, W >= SIDE."""
    import cv2

    grey = np.asarray(picture @ np.array(LUMA, np.float32), np.float32)
    return np.asarray(cv2.resize(grey, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.float64)


def suspicious(found: Sequences) -> dict[int, str]:
    """Lights whose pictures can't be used, and why: the same file as another's, failed, exchanged."""
    out = _doubled(found)
    numbers, directions, seen = _vectors(found, out)
    if len(numbers) <= NEAREST + 1:
        return out
    gain = brightness(directions, seen)
    dead = [n for n, g in zip(numbers, gain, strict=True) if g < FAILED]
    out |= {n: f"it shows less than {FAILED:.0%} of what the lights around it predict; it failed" for n in dead}
    numbers, directions, seen = _vectors(found, out)
    for a, b in exchanged(directions, seen):
        first, second = numbers[a], numbers[b]
        out[first] = f"its pictures seem to be those of light {second}"
        out[second] = f"its pictures seem to be those of light {first}"
    return out


def _doubled(found: Sequences) -> dict[int, str]:
    """Lights that have the same file as another one in a camera. Black pictures are alike, and do not count."""
    top = max((float(s.thumb.max()) for s in found.singles.values()), default=0.0)
    owner: dict[str, tuple[int, int]] = {}
    out: dict[int, str] = {}
    for (camera, number), single in sorted(found.singles.items()):
        if not single.sha256 or float(single.thumb.max()) <= BLACK * top:
            continue
        other = owner.setdefault(single.sha256, (camera, number))
        if other != (camera, number):
            for n, m in ((number, other[1]), (other[1], number)):
                out[n] = f"camera {camera} has the same file for it as for light {m}"
    return out


def _vectors(found: Sequences, without: Mapping[int, str]) -> tuple[list[int], F64, F64]:
    """Indices (N,), directions (N, 3) and T (N, cameras SIDE^2) of the lights that all cameras show."""
    cameras = sorted(found.full)
    numbers = [n for n in sorted(found.lights) if n not in without and all((c, n) in found.singles for c in cameras)]
    directions = np.array([[-x for x in found.lights[n].axis] for n in numbers], np.float64).reshape(-1, 3)
    seen = [
        np.concatenate([found.singles[c, n].thumb.ravel() for c in cameras]) / float(np.mean(found.lights[n].intensity))
        for n in numbers
    ]
    return numbers, directions, np.array(seen, np.float64).reshape(len(numbers), -1)


def predictions(directions: F64, seen: F64, without: Sequence[int] = ()) -> F64:
    """(N, D) P: mean of T (N, D) over the NEAREST lights of each, weighted by 1 / angle. directions (N, 3). Lights
    without predict none."""
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    np.fill_diagonal(angle, np.inf)
    angle[:, list(without)] = np.inf
    near = np.argsort(angle, axis=1)[:, :NEAREST]
    weight = 1 / np.maximum(np.take_along_axis(angle, near, 1), 1e-3)
    weight /= weight.sum(1, keepdims=True)
    return np.asarray(np.einsum("nk,nkd->nd", weight, seen[near]), np.float64)


def brightness(directions: F64, seen: F64) -> F64:
    """(N,) g: how bright each light is, over its prediction; 1 where nothing is predicted."""
    said = predictions(directions, seen)
    power = (said * said).sum(1)
    return np.where(power > 0, (seen * said).sum(1) / np.maximum(power, 1e-300), 1.0)


def exchanged(directions: F64, seen: F64) -> list[tuple[int, int]]:
    """Pairs of lights, as rows of seen, whose pictures fit each other's place far better than their own, the most
    certain first. Lights near each other look alike: exchanging those is not noticed."""
    count, said = len(seen), predictions(directions, seen)
    own = ((seen - said) ** 2).sum(1)
    cross = (seen**2).sum(1)[:, None] + (said**2).sum(1)[None] - 2 * seen @ said.T
    usual = float(np.median(own))  # and cross is that of the row's picture at the column's place
    first, second = np.triu_indices(count, 1)
    near = (cross[first, second] + cross[second, first]) < 0.8 * (own[first] + own[second])
    certain = []
    for a, b in zip(first[near], second[near], strict=True):
        both = predictions(directions, seen, without=(a, b))[[a, b]]  # neither may predict the other
        as_is = ((seen[[a, b]] - both) ** 2).sum(1)
        swapped = ((seen[[b, a]] - both) ** 2).sum(1)
        if (swapped < BETTER * as_is).all() and as_is.sum() > 2 * usual:
            certain.append((float(swapped.sum() / as_is.sum()), int(a), int(b)))
    taken: set[int] = set()
    out = []
    for _, a, b in sorted(certain):
        if not {a, b} & taken:
            out.append((a, b))
            taken |= {a, b}
    return out


def additive(found: Sequences) -> tuple[float, float]:
    """How the sum S of the single pictures compares with the picture F under all lights: the slope of log S against
    log F, and the median of S / F. Linear pictures of one exposure have slope 1 and a ratio of at most 1, less where
    lights are missing. Encoded ones have far more: each dark picture is brightened. NaN where nothing can be compared.
    """
    x, y, _ = _summed(found)
    lit = (x > 0.05 * x.max(initial=0)) & (y > 0.05 * y.max(initial=0))
    if lit.sum() < SIDE:
        return float("nan"), float("nan")
    lx, ly = np.log(x[lit]), np.log(y[lit])
    # both have errors of like size (edges of the subject): the axis of the cloud, not a regression
    (a, b), (_, d) = np.cov(lx, ly)
    slope = (d - a + np.sqrt((d - a) ** 2 + 4 * b * b)) / (2 * b) if abs(b) > 1e-12 else 1.0
    return float(slope), float(np.exp(np.median(ly - lx)))


def accounted(found: Sequences) -> float:
    """Share of the picture under all lights that the single pictures add up to, at most 1; 1 if it can't be told."""
    ratio = additive(found)[1]
    return round(min(max(ratio, 0.05), 1.0), 4) if np.isfinite(ratio) else 1.0


def drift(found: Sequences) -> float:
    """Relative change of the lights' brightness from the first to the last frame.

    F = a sum (1 + b t_i) T_i over the pixels of all thumbnails, t from 0 to 1 over the frames, by least squares: parts
    of the head that early lights lit are then darker or brighter against F than those that late lights lit. b is the
    change that has to be undone, so the drift is 1 / (1 + b) - 1. 0 where nothing can be compared.
    """
    x, y, later = _summed(found)
    if x.max(initial=0) <= 0 or not later.any():
        return 0.0
    (level, change), *_ = np.linalg.lstsq(np.stack([y, later], 1), x, rcond=None)
    share = float(change / level) if level > 0 else 0.0
    return 1 / (1 + share) - 1 if share > -0.9 else 9.0


def _summed(found: Sequences) -> tuple[F64, F64, F64]:
    """Pixels of all thumbnails: F, sum T_i, and sum t_i T_i, (P,) each."""
    frames = [light.frame for light in found.lights.values()]
    first, span = min(frames, default=0), max(1, max(frames, default=0) - min(frames, default=0))
    whole, total, later = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for camera, full in found.full.items():
        own = [(n, s.thumb.ravel()) for (c, n), s in found.singles.items() if c == camera]
        if own:
            whole.append(full.ravel())
            total.append(np.sum([t for _, t in own], 0))
            later.append(np.sum([(found.lights[n].frame - first) / span * t for n, t in own], 0))
    return np.concatenate(whole), np.concatenate(total), np.concatenate(later)


def gap(directions: F64) -> float:
    """Degrees: the share FARTHEST of all directions is at most so far from the nearest of the lights (N, 3), unit
    directions; 180 without lights."""
    from scipy.spatial import cKDTree

    if not len(directions):
        return 180.0
    around, solid = latlong_directions(*GRID).reshape(-1, 3), np.repeat(latlong_weights(*GRID), GRID[0])
    chord = np.asarray(cKDTree(directions).query(around)[0], np.float64)
    angle = np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1)))
    order = np.argsort(angle, kind="stable")
    return float(np.interp(FARTHEST * 4 * np.pi, np.cumsum(solid[order]), angle[order]))


def judge(
    found: Sequences, missing: Sequence[str], saturated: Sequence[str], wrong: Mapping[int, str], lights: int
) -> tuple[Finding, ...]:
    """All findings. missing, saturated: names CAMERA/LIGHT of pictures; wrong: lights left out; lights: calibrated."""
    shown = sorted({n for _, n in found.singles} - set(wrong))
    far = gap(-np.array([found.lights[n].axis for n in shown], np.float64).reshape(-1, 3))
    pictures = max(1, len(found.singles) + len(missing))
    (power, ratio), change = additive(found), drift(found)
    off = max(abs(power - 1), ratio - 1) if np.isfinite(power) else 0.0
    return (
        judged("stage_pictures", len(missing) / pictures, MISSING,
               f"{len(missing)} of {pictures} pictures under single lights are missing",
               "copy them, or remove their lights from lights.json", views=missing),
        judged("stage_saturated", len(saturated) / pictures, SATURATED,
               f"{len(saturated)} of {pictures} pictures under single lights are saturated, and are left out",
               "expose shorter", views=saturated),
        judged("stage_lights", len(wrong) / max(1, lights), LIGHTS_OUT,
               f"{len(wrong)} of {lights} lights failed, have another light's pictures or one file twice, and are left "
               "out", "compare the pictures' order with lights.json, and take these again",
               views=[f"light {n}" for n in sorted(wrong)]),
        judged("stage_directions", far, DIRECTIONS,
               f"{len(shown)} lights: nine of ten directions around are within {far:.0f} degrees of one",
               "use more lights, and spread them all around", unit="degrees"),
        judged("stage_linear", off, LINEAR,
               f"the sum of the single pictures is {ratio:.2f} times the picture under all lights, and grows as its "
               f"power {power:.2f}"
               if np.isfinite(power) else "the pictures are too dark to tell whether they are linear",
               "export linear pictures, without a tone curve and all with the same exposure"),
        judged("stage_drift", abs(change), DRIFT,
               f"the lights' brightness changes by {change:+.1%} from the first to the last frame",
               "let the lights warm up, and calibrate them again"),
    )  # fmt: skip
