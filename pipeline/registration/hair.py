"""Tells hair on the fitted surface: by its colour, by how far it stands out of the head that the face makes probable,
and by where it is. Beard and brows are not told: they stay with the skin.

Symbols: patches p of the surface (pipeline.patches) with albedo in CIELAB c; q the nearest place of the head's skin
with normal n, when its identity is fitted to the face alone; h = n . (p - q) in metres of the template, y how high q is
on the template; s in [0, 1] how well photos see p.

    cost of the cut = sum over hair of -log-odds(p)  +  sum over neighbours of LINE exp(-|c_a - c_b|^2 / 2 LIKE^2)
    log-odds = s COLOUR (log f(c | hair) - log max(f(c | skin), f(c | other))) + stands step(h) + prior of the place

f are kernel densities over seeds: skin on nose and upper cheeks (no beard grows there), hair where the surface stands
clearly off the scalp, other (clothes) below the chin and beside the neck. After the first cut its sides are the seeds.
Around eyes, nose and mouth, and on chin and throat, nothing is hair.

Long hair goes on below the head, beside cheeks and neck and on shoulders. There no height tells it from a collar, and
its own colour would be a seed of the clothes. So it is told last, by colour alone, from the hair of the head on, where
the clothes have another colour (`_with_hanging`).

Is it hair at all? The skull that a face makes probable is up to 10 mm off, and the colour of stubble is as far from
skin's as fair hair's is. But hair rises from the skin at its border, and there a skull that is wrong does not. So the
rise from the nearest skin to what lies RISE_AT inwards of the border must be enough, with the change of colour:

    rise / RISE + change / CHANGE >= LEAST_SCORE

Hair that is not told is worse than stubble that is: skin follows neither a fringe nor hair that stands off, while what
is told keeps the surface that the photos show. So the limits are low.

Source: Boykov and Jolly, Interactive graph cuts (2001), for the two terms; Rother, Kolmogorov and Blake, GrabCut
(2004), for the repeated seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.colour import srgb_from_linear
from pipeline.least_cut import least_cut
from pipeline.meshes import F64, Indices, Mask
from pipeline.patches import Patches
from pipeline.registration.cage import HIDDEN
from pipeline.registration.head import limit_surface
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.quality import NOT_SKIN
from pipeline.registration.subdivision import subdivided
from pipeline.template.model import Template

# metres of the template
PATCH = 0.003  # size of the patches
FLAT, STANDING = 0.003, 0.008  # heights between which a place of the scalp begins to speak for hair
REACH = 0.06  # hair stands out of the head by no more; what is further away hangs
CHEEK = (-0.045, -0.012)  # heights on the template between which skin is sought beside the nose
FRONT = 0.03  # how far in front of the head's middle
THROAT = -0.06  # height on the template below which places in front of the ears are throat, chin or beard
BELOW = -0.13  # from here on downwards, clothes are sought
LEAST_SEEDS = 60  # patches: 5 square centimetres
LEAST_SHARE = 0.12  # of the seen scalp that must stand off for there to be hair
RISE_AT = (0.010, 0.015)  # inwards of the border, where rise and change are measured
RISE, CHANGE = 0.0025, 20.0  # of height, and of colour in units of CIELAB: each counts as one
LEAST_RISE, LEAST_CHANGE = 0.0008, 2.5
LEAST_SCORE = 0.8  # of their sum; persons with hair have .97 (white on pale skin) to 4.3, a shaved scanned head .3
SMALL = 4e-4  # square metres: smaller islands and holes of hair are taken away
BENEATH, INWARD = (
    0.002,
    0.0005,
)  # how far the skin lies beneath hair at least, and how much more with each patch inwards

KERNEL, FLOOR = 5.0, 1e-7  # of the densities: units of CIELAB, and the least density
MOST_SEEDS = 500
AT_ONCE = 256  # colours whose kernels fit into a processor's cache
COLOUR, COLOUR_MOST = 1.0, 4.0  # weight of the log-odds of the colours, and the most that they count
# log-odds of a place that stands off; ears are too different in shape and place for their height to tell anything
STANDS = {"scalp": 4.0, "face": 3.0, "brows": 3.0, "neck": 1.5, "ears": 0.0}
LINE, LIKE = 3.0, 8.0  # cost of the border between two patches of one colour; difference of colour that lowers it
PRIOR = {"scalp": 1.0, "ears": -0.5, "face": -1.0, "brows": -3.0, "lids": -9.0, "lips": -9.0, "nose": -9.0,
         "nostrils": -9.0, "neck": -2.0}  # fmt: skip
NEVER = -9.0
ROUNDS = 3
LIKE_HAIR = 0.05  # quantile of the hair's density in its own colours, above which a colour is like hair
LEAST_OTHER = 0.2  # of the seen area below the head must have another colour, else nothing tells clothes from hair
HANGING, HANGS = 0.1, -1.0  # metres off the head within which hair hangs; log-odds of its place
BEARD = 0.045  # metres from the middle of the face and throat, where what hangs may be a beard
UNITS = 1000  # of the cut's whole numbers


@dataclass(frozen=True, slots=True)
class Places:
    """Of P patches: region (P,) index into names of the nearest place of the skin; height (P,) out of it, at (P, 3)
    that place on the template; metres of the template. shrink: such metres per world unit."""

    region: Indices
    names: tuple[str, ...]
    height: F64
    at: F64
    shrink: float = 1.0

    def on(self, *names: str) -> Mask:
        """(P,) patches whose region is one of these."""
        return np.isin(self.region, [self.names.index(n) for n in names if n in self.names])


@dataclass(frozen=True, slots=True)
class Hair:
    """inside (P,): patches that are hair; reason: why there is none, or "". share: of the seen scalp that stands off;
    rise, change: of height (metres of the template) and colour (CIELAB) from the skin to what lies inwards of the
    border, medians; 0 where there is no border."""

    inside: Mask
    share: float
    reason: str = ""
    rise: float = 0.0
    change: float = 0.0


def places_of(template: Template, head: PlacedHead, patches: Patches) -> Places:
    """Where the patches lie on the head."""
    names = tuple(template.regions)
    left = [n for n in names if n in HIDDEN or n in NOT_SKIN]
    region = np.full(len(template.quads), -1, np.int64)
    for i, name in enumerate(names):
        region[template.regions[name]] = i
    kept = np.flatnonzero(~np.isin(region, [names.index(n) for n in left]))
    level = subdivided(template.quads[kept], len(template.vertices), 2)
    points, normals, quads = limit_surface(head.vertices, level)
    flat = np.asarray(level.stencil @ template.vertices)
    used, first = np.unique(quads, return_index=True)
    away, nearest = cKDTree(points[used]).query(patches.where)
    row = used[nearest]
    out = ((patches.where - points[row]) * normals[row]).sum(1)
    signed = np.where(np.abs(out) > 0.5 * away, np.sign(out) * away, out)
    return Places(region[kept][first[nearest] // 4 // 16], names, signed / head.scale, flat[row], 1 / head.scale)


def tell_hair(patches: Patches, places: Places, albedo: F64, seen: F64) -> Hair:
    """The hair among P patches. albedo (P, 3) linear; seen (P,): how well photos show them, 0 to 1."""
    none = np.zeros(len(seen), np.bool_)
    shown = seen > 0.3
    on_scalp = places.on("scalp") & shown
    standing = on_scalp & (places.height > FLAT) & (places.height < REACH)
    share = float(patches.area[standing].sum() / max(patches.area[on_scalp].sum(), 1e-30))
    off = standing & (places.height > 0.5 * (FLAT + STANDING))
    if off.sum() < LEAST_SEEDS or share < LEAST_SHARE:
        return Hair(none, share, f"{share:.0%} of the seen scalp stands off the head, less than {LEAST_SHARE:.0%}")
    colour = lab(albedo)
    skin = shown & _cheeks(places)
    if skin.sum() < LEAST_SEEDS:
        return Hair(none, share, "the photos show too little of the cheeks")
    other = shown & (places.at[:, 1] <= BELOW) | shown & (places.height > REACH)
    inside = off
    for turn in range(ROUNDS):
        odds = _log_odds(places, seen, colour, skin, inside & shown, other)
        inside = _cut(patches, odds, colour)
        if not (inside & shown).any():
            return Hair(none, share, "the surface that stands off has the colour of skin")
        if turn == 0:
            skin = shown & ~inside & _bare(places) & (np.abs(places.height) < FLAT) | skin
    inside = _whole(patches, inside, off)
    whole = _with_hanging(patches, places, seen, colour, skin, inside)
    # where hair goes on below the head, the border of the head's own runs through hair
    borders = [_at_border(patches, places, colour, x, shown) for x in (inside, whole)]
    rise, change = max(borders, key=_score)
    if _score((rise, change)) >= LEAST_SCORE:
        return Hair(whole, share, "", rise, change)
    why = f"at its border it rises by {1000 * rise:.2g} mm and changes by {change:.2g} units of CIELAB: a shaved head"
    return Hair(none, share, why, rise, change)


def _score(border: tuple[float, float]) -> float:
    """How much a border's rise and change speak for hair; -inf where one of them is as good as none."""
    rise, change = border
    return rise / RISE + change / CHANGE if min(rise / LEAST_RISE, change / LEAST_CHANGE) >= 1 else -np.inf


def _at_border(patches: Patches, places: Places, colour: F64, inside: Mask, shown: Mask) -> tuple[float, float]:
    """Rise and change of colour from the nearest skin to the hair inside (P,) that lies RISE_AT inwards; both shown."""
    rim = np.flatnonzero(patches.beside(inside) & shown & places.on("face", "scalp", "neck") & (places.height < REACH))
    hair = np.flatnonzero(inside & shown)
    if not len(rim) or not len(hair):
        return 0.0, 0.0
    away, nearest = cKDTree(patches.where[rim]).query(patches.where[hair])
    away = away * places.shrink
    use = (away > RISE_AT[0]) & (away <= RISE_AT[1])
    if use.sum() < LEAST_SEEDS:
        return 0.0, 0.0
    a, b = hair[use], rim[nearest[use]]
    change = np.linalg.norm(colour[a] - colour[b], axis=1)
    return float(np.median(places.height[a] - places.height[b])), float(np.median(change))


def depth_beneath(patches: Patches, inside: Mask) -> F64:
    """(P,) metres of the template that the skin lies beneath the hair inside (P,) at least: little at the hairline,
    BENEATH from some patches inwards on; 0 beside the hair."""
    rings, out = inside.copy(), np.zeros(len(inside))
    while rings.any() and out.max(initial=0.0) < BENEATH - 1e-12:
        out[rings] += INWARD
        rings = rings & ~patches.beside(~rings)
    return np.minimum(out, BENEATH)


def lab(linear: F64) -> F64:
    """(N, 3) CIELAB (D65) of linear Rec.709 (N, 3)."""
    import cv2

    coded = np.asarray(srgb_from_linear(np.clip(linear, 0, 1)), np.float32)
    return np.asarray(cv2.cvtColor(coded[None], cv2.COLOR_RGB2LAB)[0], np.float64)


def log_density(colour: F64, seeds: F64) -> F64:
    """(N,) log of the kernel density of seeds (S, 3) at colour (N, 3); the floor keeps what is like no seed finite."""
    if not len(seeds):
        return np.full(len(colour), np.log(FLOOR))
    some, at = (x / KERNEL for x in (seeds[:: -(-len(seeds) // MOST_SEEDS)], colour))
    kernel = np.concatenate([_kernel(at[i : i + AT_ONCE], some) for i in range(0, len(at), AT_ONCE)] or [np.zeros(0)])
    return np.asarray(np.log(kernel / (2 * np.pi * KERNEL**2) ** 1.5 + FLOOR))


def _kernel(at: F64, seeds: F64) -> F64:
    """(N,) mean of the kernel between at (N, 3) and the seeds (S, 3)."""
    half = at @ seeds.T - 0.5 * (at**2).sum(1)[:, None] - 0.5 * (seeds**2).sum(1)  # -|a - b|^2 / 2
    return np.asarray(np.exp(half.astype(np.float32), dtype=np.float32).mean(1, dtype=np.float64))


def _cheeks(places: Places) -> Mask:
    x, y, z = places.at.T
    cheeks = places.on("face") & (y > CHEEK[0]) & (y < CHEEK[1]) & (z > FRONT)
    return np.asarray((places.on("nose") | cheeks) & (np.abs(places.height) < STANDING), np.bool_)


def _bare(places: Places) -> Mask:
    """(P,) the face above the cheeks' lower end, forehead too."""
    return places.on("face", "nose", "ears") & (places.at[:, 1] > CHEEK[0])


def _never(places: Places) -> Mask:
    """(P,) places that are never hair: the middle of the face, and what is in front of the ears below the cheeks."""
    y, z = places.at[:, 1], places.at[:, 2]
    beard = (y < CHEEK[1]) & (z > 0.0) & places.on("face", "neck")
    return beard | places.on("lids", "lips", "nose", "nostrils") | (places.height < -STANDING)


def _log_odds(places: Places, seen: F64, colour: F64, skin: Mask, hair: Mask, other: Mask) -> F64:
    one, two, three = (log_density(colour, colour[m]) for m in (hair, skin, other))
    told = np.clip(COLOUR * (one - np.maximum(two, three)), -COLOUR_MOST, COLOUR_MOST) * seen
    step = np.clip((places.height - FLAT) / (STANDING - FLAT), 0, 1)
    prior, stands = (
        np.array([of.get(n, least) for n in places.names])[places.region]
        for of, least in ((PRIOR, NEVER), (STANDS, 0.0))
    )
    hanging = np.clip((BELOW + 0.04 - places.at[:, 1]) / 0.04, 0, 1) + np.clip(places.height / REACH - 1, 0, 4)
    odds = told + stands * step * step * (3 - 2 * step) + prior - 3 * hanging
    return np.where(_never(places), NEVER, odds)


def _with_hanging(patches: Patches, places: Places, seen: F64, colour: F64, skin: Mask, inside: Mask) -> Mask:
    """The hair inside (P,) of the head with what hangs from it. skin (P,): seeds."""
    shown = seen > 0.3
    own = colour[inside & shown]
    told = log_density(colour, own)
    like = told > np.quantile(told[inside & shown], LIKE_HAIR)
    below = shown & ~inside & (places.at[:, 1] <= BELOW)
    other = below & ~like
    if patches.area[other].sum() < LEAST_OTHER * patches.area[below].sum():
        return inside
    against = np.maximum(log_density(colour, colour[skin]), log_density(colour, colour[other]))
    odds = np.clip(COLOUR * (told - against), -COLOUR_MOST, COLOUR_MOST) * seen + HANGS
    y, z = places.at[:, 1], places.at[:, 2]
    beard = (y < CHEEK[1]) & (z > 0.0) & (np.abs(places.at[:, 0]) < BEARD) & (places.height < REACH)
    never = beard | (places.height < FLAT) | (places.height > HANGING) | places.on("lids", "lips", "nose", "nostrils")
    never |= (y > CHEEK[1]) & ~places.on("ears")  # height has told there already
    odds = np.where(inside, -NEVER, np.where(never, NEVER, odds))
    return _whole(patches, _cut(patches, odds, colour), inside)


def _cut(patches: Patches, odds: F64, colour: F64) -> Mask:
    like = ((colour[patches.a] - colour[patches.b]) ** 2).sum(1)
    cost = LINE * (0.1 + np.exp(-0.5 * like / LIKE**2))
    whole = np.round(UNITS * cost).astype(np.int32), np.round(UNITS * odds).astype(np.int32)
    return least_cut(patches.a, patches.b, *whole)


def _whole(patches: Patches, inside: Mask, seeds: Mask) -> Mask:
    """Without holes, and without islands that are small or hold no seed."""
    filled = inside.copy()
    for piece, area in _pieces(patches, ~inside):
        if area < SMALL:
            filled[piece] = True
    out = np.zeros_like(inside)
    for piece, area in _pieces(patches, filled):
        if area >= SMALL and seeds[piece].any():
            out[piece] = True
    return out


def _pieces(patches: Patches, of: Mask) -> list[tuple[Indices, float]]:
    """The connected parts of some patches (P,), with their areas."""
    both = of[patches.a] & of[patches.b]
    a, b = patches.a[both], patches.b[both]
    label = connected_components(coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(of), len(of))))[1]
    rows = np.flatnonzero(of)
    order = np.argsort(label[rows], kind="stable")
    groups = np.split(rows[order], np.flatnonzero(np.diff(label[rows][order])) + 1) if len(rows) else []
    return [(g, float(patches.area[g].sum())) for g in groups]
