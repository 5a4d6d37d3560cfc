"""Finds the corneas of a head in a light stage: spheres in which lamps are reflected where the pictures show glints.

What is brighter than its surroundings between the lids, in a picture under one light, may be the lamp's reflection. A
sphere predicts the reflection's place in all cameras under all lamps (pipeline/eyes/mirror.py). Its centre and radius
are fitted to the bright spots by Gauss-Newton. The weights fall with the distance in pixels (Geman-McClure) and get
narrower; fits start from several depths about the surface, and the radius is drawn to that of an adult's cornea. So
other bright spots (the white of the eye, wet lids, skin) hardly count. The sphere is a cornea if FEWEST spots or more
lie within CLOSE pixels of where it predicts them, and these are SHARE of what it should show. Closed eyes have none.

The reflectance is that of the median spot: its summed radiance over that for F = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, find_objects, label, maximum_filter, median_filter

from pipeline.artifacts import Located, MaskSet
from pipeline.camera import PinholeCamera
from pipeline.eyes.ball import CORNEA
from pipeline.eyes.mirror import Cornea, intensity, reflected, summed
from pipeline.faces.labels import EYES, LABELS
from pipeline.images import F32, read_encoded, read_linear, shrink_whole
from pipeline.meshes import unit
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, pixel_centres
from stages.reflectance.field import Field, Lamp
from stages.reflectance.glints import arriving_at, unblocked
from stages.reflectance.rig import Rig
from stages.reflectance.score import camera_at

Mask = npt.NDArray[np.bool_]
Pictures = Mapping[tuple[int, int], Path]

TYPICAL = 18.0  # pixels: root of an eye's area, to which pictures are reduced
LEAST = 40  # pixels of an eye that is looked at
AROUND, DILATED, MOST = 7, 3, 4  # pixels of the median; by which lids are widened; spots of an eye in a picture
USUAL_F0, FAINT = 0.03, 0.08  # least peak of a spot: this share of the summed radiance of a glint of this reflectance
SAME_EYE = 0.02  # metres between places of one eye by two cameras
CONE = float(np.cos(np.radians(50.0)))  # of a cornea's normals, about their mean
DEPTHS = np.arange(-0.006, 0.0061, 0.002)  # metres along the line of sight, from which fits start
RADIUS_STD, PLACE_STD, NOISE = 0.0003, 0.004, 0.3  # metres among adults; metres from the start; pixels of a spot
WIDTHS = (4.0, 4.0, 2.0, 2.0, 1.0, 1.0, 0.7, 0.7, 0.7)  # pixels of the weights, round by round
STEP = 1e-5  # metres: of the derivatives
CLOSE, FEWEST, SHARE = 1.0, 10, 0.25
F0_RANGE = 0.01, 0.08
LIT = 0.5  # share of a lamp's light that must arrive for a glint to be asked for


@dataclass(frozen=True, slots=True)
class Shots:
    """P pictures of an eye. eye, lamp (P, 3): places of camera and lamp as the head sees them; strength (P,): of the
    lamp, grey; light (P,): its number; focal (P,): pixels of the reduced pictures; scale (P,): their summed radiance
    for a radiant intensity of 1 at the eye."""

    eye: F64
    lamp: F64
    strength: F64
    light: npt.NDArray[np.int64]
    focal: F64
    scale: F64


@dataclass(frozen=True, slots=True)
class Spots:
    """S bright spots between lids. shot (S,): number of the picture; ray (S, 3): unit direction as the head sees it;
    bright (S,): radiance over the surroundings, summed over 3 x 3 pixels."""

    shot: npt.NDArray[np.int64]
    ray: F64
    bright: F64


@dataclass(frozen=True, slots=True)
class _Opening:
    """place (3,): on the surface between lids; masks: its pixels, by camera."""

    place: F64
    masks: dict[int, Mask]


def find_corneas(
    field: Field, rig: Rig, pictures: Pictures, lids: Mapping[int, Mask], tick: Callable[[int, int, str], None]
) -> tuple[Cornea, ...]:
    """The corneas that pictures show, from the head's right to its left. lids: pixels (H, W) of open or closed eyes, by
    camera, at rest."""
    found, openings = [], _openings(rig, lids, field.whole)
    for number, opening in enumerate(openings):
        tick(number, len(openings), "corneas of the eyes")
        shots, spots = spots_of(rig, pictures, opening.masks, opening.place)
        sphere = fitted_sphere(shots, spots, opening.place)
        cornea = None if sphere is None else _checked(field, rig, shots, spots, sphere)
        if cornea is not None:
            found.append(cornea)
    return tuple(sorted(found, key=lambda c: float(c.centre[0])))


def lids_of(masks: Located[MaskSet], rig: Rig) -> dict[int, Mask]:
    """(H, W) pixels that are labelled as eyes, by camera of the rig; cameras without any are left out."""
    names = masks.artifact.label_names
    code = names.index(LABELS[EYES]) if LABELS[EYES] in names else -1
    files = {m.index: m.labels for m in masks.artifact.masks}
    out = {}
    for c, camera in enumerate(rig.cameras):
        file = files.get(camera.index)
        own = None if file is None else read_encoded(masks.path(file))[..., 0] == code
        if own is not None and own.any():
            out[c] = own
    return out


def _openings(rig: Rig, lids: Mapping[int, Mask], caster: RayCaster) -> list[_Opening]:
    """The eyes that cameras see, by their places on the surface."""
    out: list[_Opening] = []
    for c, mask in sorted(lids.items()):
        camera = PinholeCamera.of(rig.cameras[c])
        parts, count = label(mask)
        for number in range(1, count + 1):
            own = parts == number
            if own.sum() < LEAST:
                continue
            origin, rays = camera.rays(pixel_centres(camera.width, camera.height)[own.ravel()])
            far, face = caster.hits(np.broadcast_to(origin, rays.shape), rays)
            hit = face >= 0
            if not hit.any():
                continue
            place = np.median(origin + far[hit, None] * rays[hit], axis=0)
            near = [e for e in out if np.linalg.norm(e.place - place) < SAME_EYE and c not in e.masks]
            if near:
                near[0].masks[c] = own
            else:
                out.append(_Opening(place, {c: own}))
    return out


def spots_of(rig: Rig, pictures: Pictures, masks: Mapping[int, Mask], place: F64) -> tuple[Shots, Spots]:
    """The pictures of an eye at a place (3,), and the bright spots in them. masks: its pixels, by camera."""
    lamps, _ = rig.lamps()
    shots: list[tuple[F64, F64, float, int, float, float]] = []
    rows: list[tuple[int, F64, float]] = []
    for c, mask in masks.items():
        factor = max(1, round(float(np.sqrt(mask.sum())) / TYPICAL))
        wide = binary_dilation(shrink_whole(mask.astype(np.float32), factor) > 0.5, iterations=DILATED)
        y, x = find_objects(wide.astype(np.int8))[0]
        box = slice(max(y.start - AROUND, 0), y.stop + AROUND), slice(max(x.start - AROUND, 0), x.stop + AROUND)
        for i in range(len(rig.index)):
            if (c, i) not in pictures:
                continue
            camera, strength = camera_at(rig, c, i), float(rig.strength[i].mean())
            scale = float(summed(camera, place[None])[0]) / factor**2
            usual = intensity(CORNEA, USUAL_F0, place[None], lamps[i][None], np.full((1, 1), strength))[0, 0] * scale
            grey = shrink_whole(read_linear(pictures[c, i]), factor)[box].mean(2)
            places, bright = bright_spots(grey, wide[box], FAINT * float(usual))
            rays = camera.rays((places + [box[1].start, box[0].start]) * factor)[1] if len(places) else ()
            rows += [(len(shots), ray, float(b)) for ray, b in zip(rays, bright, strict=True)]
            shots.append((camera.eye, lamps[i], strength, i, float(camera.K[0, 0]) / factor, scale))
    eye, lamp, strong, light, focal, scales = zip(*shots, strict=True) if shots else ((),) * 6
    shot, ray, sums = zip(*rows, strict=True) if rows else ((),) * 3
    return (
        Shots(_rows(eye), _rows(lamp), np.array(strong), np.array(light, np.int64), np.array(focal), np.array(scales)),
        Spots(np.array(shot, np.int64), _rows(ray), np.array(sums, np.float64)),
    )


def _rows(vectors: tuple[F64, ...]) -> F64:
    return np.array(vectors, np.float64).reshape(-1, 3)


def bright_spots(grey: F32, inside: Mask, faint: float) -> tuple[F64, F64]:
    """Places (S, 2), x and y with 0 at the first pixel's corner, of the brightest spots of a picture (H, W), and their
    brightness (S,), summed over 3 x 3 pixels; both of what is above the median around. faint: least peak."""
    more = grey - median_filter(grey, AROUND)
    peak = (more == maximum_filter(more, 3)) & inside & (more > faint)
    rows, columns = np.nonzero(peak)
    order = np.argsort(-more[rows, columns], kind="stable")[:MOST]
    padded, around = np.pad(np.maximum(more, 0).astype(np.float64), 1), np.arange(3) - 1
    places, bright = [], []
    for y, x in zip(rows[order], columns[order], strict=True):
        weight = padded[y : y + 3, x : x + 3]
        total = weight.sum()
        places.append((x + 0.5 + (weight.sum(0) @ around) / total, y + 0.5 + (weight.sum(1) @ around) / total))
        bright.append(total)
    return np.array(places, np.float64).reshape(-1, 2), np.array(bright, np.float64)


def fitted_sphere(shots: Shots, spots: Spots, place: F64) -> F64 | None:
    """(4,) centre and radius of the sphere near a place (3,) on the surface that explains most spots; None if they are
    fewer than FEWEST."""
    if len(np.unique(spots.shot)) < FEWEST:
        return None
    towards = unit((shots.eye.mean(0) - place)[None])[0]
    fits = [_descended(shots, spots, np.append(place + (depth - CORNEA) * towards, CORNEA)) for depth in DEPTHS]
    return max(fits, key=lambda s: float(np.exp(-((_apart(shots, spots, s)[0] / CLOSE) ** 2)).sum()))


def _checked(field: Field, rig: Rig, shots: Shots, spots: Spots, sphere: F64) -> Cornea | None:
    """A sphere (4,) as a cornea, if the pictures show enough of the glints that it should have."""
    centre, radius = sphere[:3], float(sphere[3])
    apart, nearest = _apart(shots, spots, sphere)
    shown = apart < CLOSE
    if shown.sum() < FEWEST:
        return None
    x, n = reflected(centre, radius, shots.eye, shots.lamp)
    asked = n @ unit(n[shown].mean(0)[None])[0] > CONE
    for eye in np.unique(shots.eye, axis=0):
        own = (shots.eye == eye).all(1)
        asked[own] &= unblocked(field.whole, x[own], n[own], eye)
    _, axes = rig.lamps()
    texels = field.beside(centre, radius)
    for i in np.unique(shots.light):
        own = np.flatnonzero((shots.light == i) & asked)
        if len(own):
            asked[own] = arriving_at(texels, Lamp(shots.lamp[own[0]], axes[i], rig.strength[i]), x[own]) > LIT
    asked |= shown
    if shown.sum() < SHARE * asked.sum():
        return None
    each = intensity(radius, 1.0, x, shots.lamp, shots.strength[:, None])[:, 0] * shots.scale
    f0 = float(np.median(spots.bright[nearest[shown]] / each[shown]).clip(*F0_RANGE))
    return Cornea(centre, radius, f0, n[asked], shown[asked].astype(np.float64))


def _descended(shots: Shots, spots: Spots, start: F64) -> F64:
    """(4,) centre and radius from a start (4,), by Gauss-Newton."""
    draw = np.append(np.full(3, PLACE_STD), RADIUS_STD) ** -2.0
    found = start.copy()
    for width in WIDTHS:
        apart, nearest = _apart(shots, spots, found)
        own = np.flatnonzero(np.isfinite(apart))
        weight = (1 / (1 + (apart[own] / width) ** 2)) ** 2 / NOISE**2
        number = nearest[own]
        off = _residuals(shots, spots, found, own, number)
        moved = [_residuals(shots, spots, found + STEP * e, own, number) for e in np.eye(4)]
        slope = np.stack([(m - off) / STEP for m in moved], 2)
        gram = np.einsum("p,pkm,pkn->mn", weight, slope, slope) + np.diag(draw)
        pull = np.einsum("p,pkm,pk->m", weight, slope, off) + draw * (found - start)
        found = found - np.linalg.solve(gram, pull)
        found[3] = found[3].clip(0.5 * CORNEA, 2 * CORNEA)
    return found


def _apart(shots: Shots, spots: Spots, sphere: F64) -> tuple[F64, npt.NDArray[np.int64]]:
    """(P,) pixels from the predicted place of each picture's glint to the nearest spot, inf without spots, and (P,) the
    spot's number."""
    far = np.linalg.norm(_residuals(shots, spots, sphere, spots.shot, np.arange(len(spots.shot))), axis=1)
    out, nearest = np.full(len(shots.eye), np.inf), np.zeros(len(shots.eye), np.int64)
    for number in np.argsort(-far):  # the nearest is written last
        out[spots.shot[number]], nearest[spots.shot[number]] = far[number], number
    return out, nearest


def _residuals(
    shots: Shots, spots: Spots, sphere: F64, shot: npt.NDArray[np.int64], number: npt.NDArray[np.int64]
) -> F64:
    """(K, 3) pixels between predicted and seen directions, of pictures `shot` (K,) and spots `number` (K,)."""
    x, _ = reflected(sphere[:3], float(sphere[3]), shots.eye[shot], shots.lamp[shot])
    return np.asarray((unit(x - shots.eye[shot]) - spots.ray[number]) * shots.focal[shot, None], np.float64)
