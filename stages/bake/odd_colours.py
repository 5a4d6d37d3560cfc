"""Colours that hardly any photo shows, and that the rest of the head does not have or that these photos contradict.

At the border of what photos see, under hair, behind a neck, a place is in one or two of them, and these may show
something else there: the wall, hair in front, surface that lies elsewhere. The place then takes a colour that the
person has nowhere. Places that many photos show, and colours that occur elsewhere, are believed. Things without a head
may have a colour in one place only, so that nothing of them is doubted.

    doubt = the larger of p U / (p U + (1 - p) f(x)) and p R(m) / (p R(m) + 1 - p)        p = WRONG^k
    R(m) = (RIGHT / WIDE) exp(m / RIGHT - m / WIDE)

and where the mean doubt of such places nearby, weighted by p over NEAR, is larger, that: what few photos show wrongly
is a patch, and parts of it have a usual colour. Contradictions spread over SPREAD if most of what is around has them.

Symbols: x of a vertex: log luminance of its colour, and the logs of red and of blue over the luminance; k number of
photos that see it, of those at grazing angles a part, times USUAL / median where the median of the seen vertices is
lower; U density of a wrong colour, the same for all; f density of right colours: kernel estimate (Gaussians of the
widths WIDTH) over well seen vertices, OWN of it over those of the same region of the head, the rest over all; m: how
far the photos are apart (below), whose density is exponential, of the mean RIGHT for a place that is where the photos
see it, and WIDE for one that is not. Two photos of the wall and of hair are apart, and both may have colours of the
shirt.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from pipeline.colour import LUMA
from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import F64, Indices, Mask, Mesh
from pipeline.smoothing import Smoother
from pipeline.visibility import Sight
from stages.bake.unseen import CLEAR

WRONG = 0.5  # that one photo shows something else
USUAL = 10.0  # photos: of captures with fewer, each counts more
WIDTH = np.array([0.25, 0.12, 0.12])  # logs: freckles and folds differ by that
UNIFORM = 1 / 16  # logs over a span of 4, 2 and 2
OWN = 0.8  # weight of the own region in f
SAMPLES, ENOUGH = 400, 50  # vertices that stand for a region; with fewer it has no density of its own
MOST = 0.7, 0.3  # doubt from which a colour is replaced, and up to which it is kept
LEAST = 1e-3  # linear: darker colours count as that
NEAR = 0.005  # metres: standard deviation of the mean
# metres; a back that few photos show is wrong as a whole from this share on: an eye's corner has well seen skin around
SPREAD, ALL = 0.02, 2 / 3
BLOCK = 4096  # vertices at once: 13 MB
RIGHT, WIDE, FARTHEST = 0.1, 0.5, 1.5  # nine in ten well seen vertices of people are up to .2 apart
BELIEVED = 12.0  # k from which the doubt is left out: p is .0002


def doubted(mesh: Mesh, colour: F64, region: Indices, sight: Sight, apart: F64 | None = None) -> F64:
    """(V,) how far the colours (V, 3), linear, of vertices in regions (V,) are to be replaced, in [0, 1]; 0 where no
    photo sees a vertex. apart (V,): m, NaN where it is not known; None: nowhere."""
    seen = sight.photos > 0
    out = np.zeros(len(colour))
    if not seen.any():
        return out
    usual = float(np.median(sight.photos[seen]))
    k = sight.photos * max(1.0, USUAL / usual)
    well = (sight.cosine >= CLEAR) & (sight.photos >= usual / 2)
    x, few = _logs(colour), seen & (k < BELIEVED)
    p = np.where(few, WRONG**k, 0.0)
    for code in np.unique(region[few]):
        asked = np.flatnonzero(few & (region == code))
        f = _density(x[asked], x, well, well & (region == code))
        out[asked] = p[asked] * UNIFORM / (p[asked] * UNIFORM + (1 - p[asked]) * f)
    if apart is not None:
        out = np.maximum(out, _contradicted(mesh, p, np.where(seen, apart, np.nan)))
    if out.max() > MOST[1]:
        nearby = Smoother(mesh, NEAR).mean(out[:, None], p)[:, 0]
        out[few] = np.maximum(out, nearby)[few]
    return smoothstep(out, MOST[1], MOST[0])


def _contradicted(mesh: Mesh, p: F64, apart: F64) -> F64:
    """The doubt (V,) of places with p (V,) whose photos are apart (V,), and of all such places where they are many."""
    told = np.isfinite(apart)
    m = np.minimum(np.where(told, apart, 0.0), FARTHEST)
    wide = p * RIGHT / WIDE * np.exp(m / RIGHT - m / WIDE)
    out: F64 = np.where(told, wide / (wide + 1 - p), 0.0)
    if out.max() > MOST[1]:
        around = Smoother(mesh, SPREAD).mean(out[:, None], told.astype(np.float64))[:, 0]
        out = np.where(p > 0, np.maximum(out, around / ALL), 0.0)
    return out


def apart(vertex: Indices, colour: F64, predicted: F64, count: int) -> F64:
    """m (V,) of `count` vertices: the median over the photos of |log Y - log Y'|, NaN with fewer than two photos.

    Y: luminance of the colour (M, 3) in a photo, Y' of the predicted one (M, 3); vertex (M,): which vertex each is of.
    """
    y, expected = (np.log(np.maximum(c @ np.array(LUMA), LEAST)) for c in (colour, predicted))
    off = np.abs(y - expected)
    ranked = off[np.lexsort((off, vertex))]
    photos = np.bincount(vertex, minlength=count)
    first = np.cumsum(photos) - photos
    out, told = np.full(count, np.nan), photos > 1
    low, high = (first[told] + (photos[told] - 1) // 2), (first[told] + photos[told] // 2)
    out[told] = 0.5 * (ranked[low] + ranked[high])
    return out


def _logs(colour: F64) -> F64:
    """x (V, 3) of colours (V, 3)."""
    safe = np.maximum(colour, LEAST)
    y = np.log(safe @ np.array(LUMA))
    return np.stack([y, np.log(safe[:, 0]) - y, np.log(safe[:, 2]) - y], 1)


def _density(at: F64, x: F64, well: Mask, own: Mask) -> F64:
    """f (N,) at (N, 3), over the vertices well (V,) and those of them in the same region own (V,), of x (V, 3)."""
    everywhere = _kernels(at, x[_some(well)])
    return OWN * _kernels(at, x[_some(own)]) + (1 - OWN) * everywhere if own.sum() >= ENOUGH else everywhere


def _some(of: Mask) -> Indices:
    """At most SAMPLES of them, evenly spaced."""
    rows = np.flatnonzero(of)
    return np.asarray(rows[np.linspace(0, len(rows) - 1, min(len(rows), SAMPLES)).astype(np.int64)], np.int64)


def _kernels(at: F64, x: F64) -> F64:
    """(N,) kernel density at (N, 3) of samples (M, 3), 0 without any."""
    out = np.zeros(len(at))
    for first in range(0, len(at) if len(x) else 0, BLOCK):
        near = np.exp(-0.5 * cdist(at[first : first + BLOCK] / WIDTH, x / WIDTH, "sqeuclidean"))
        out[first : first + BLOCK] = near.mean(1) / ((2 * np.pi) ** 1.5 * WIDTH.prod())
    return out
