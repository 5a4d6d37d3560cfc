"""The level of the albedo: the one factor that photos under an unknown light do not tell.

    albedo -> g albedo,  reflectance -> g reflectance,  light -> light / g        changes no photo, for every g > 0

So g comes from what else is known. Each source gives ln g with a standard deviation; they are averaged by their
weights 1 / sigma^2:

lobe     g = 1. The light was estimated from view-dependent residuals for skin's F0 (light_estimate.py). Where it
         explains the share e of the view-dependent variance of skin (or of all points, if that is more), sigma =
         LEVEL_STD (1 - e) / e. Truth: ln g = .03 at e = .47 (head_a), .14 at .65 (demo), .51 at .31 and .52 at .39
         (person_e).
start    g = 1. Without that estimate the level is that of the initial albedo, a middle tone: it says next to nothing.
eyes     g = SCLERA / (luminance of the whites of the eyes). Sclera is nearly the same for everyone, of any skin tone.
         Left out for closed or hidden eyes.

SCLERA is the value that the fit gives to open eyes if its level is right: 0.40 and 0.37 for two rendered persons with
known albedo. If the light was corrected by the skin (skin_light.py), which changes the level that is right for the
face, it is 0.52 and 0.51, and 0.43 for one of them with darkened skin; the constant is their geometric mean. It is
below the sclera's own reflectance, because lids shade the eye by more than the fit models.

Differs: not in the paper, whose level follows from the white-light loss and the initial values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.colour import LUMA, linear_from_srgb
from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel
from pipeline.fields.light import ShLight
from stages.inverse_rendering.config import AUTO
from stages.inverse_rendering.observations import surface_hits
from stages.inverse_rendering.ray_sampling import U8, WHOLE, PhotoView, PixelTable, codes_at

F64 = npt.NDArray[np.float64]
Fact = dict[str, str | float | bool]

FACE, EYES = "face", "eyes"  # names of the labels
LEVEL_STD, START_STD = 0.2, 0.6  # of ln g
LOBE_STD = 0.06  # what skin_light.py goes by
SCLERA, EYES_STD = 0.39, 0.2  # the latter of ln g
CORRECTED_SCLERA, CORRECTED_STD = 0.49, 0.12  # the same if the light was corrected by the skin
MIN_PIXELS = 200  # of the eyes, over all photos
MOST_PIXELS = 20_000
BRIGHTEST = 0.95  # quantile of the luminance between the lids: sclera
DARKEST, CONTRAST = 0.05, 0.4  # quantile of pupil and iris, and its largest ratio to the sclera
LESS_RED = 0.12  # least difference of ln(red / blue) between skin and sclera
WHITEST, WHITE_QUANTILE = 0.98, 0.99  # g leaves this quantile of the face's albedo below that value
SEED = 27_644_437


@dataclass(frozen=True, slots=True)
class LabelledAlbedos:
    """Albedo of surface points that photos show with the label face (N, 3), of the model, or eyes (M, 3), as the photos
    show it; linear."""

    face: F64
    eyes: F64


@dataclass(frozen=True, slots=True)
class AlbedoLevel:
    """gain: the factor g of the albedo. log_std: standard deviation of ln g, 0 if the level was given. facts: for the
    report."""

    gain: float
    log_std: float
    facts: Fact


def set_level(
    model: FaceModel,
    table: PixelTable,
    views: Sequence[PhotoView],
    labels: Sequence[U8 | None],
    names: Sequence[str],
    wanted: float | str,
    light: Fact,
) -> Fact:
    """Decide the level and apply it to the model; the facts for the report.

    wanted: setting `albedo_level`. light: the facts of the light's selection. A model of other parts than ours, or the
    setting `fitted`, keeps its level.
    """
    if not isinstance(model.spatial, SpatialField) or not isinstance(model.light, ShLight) or wanted == "fitted":
        return {"gain": 1.0, "why": "setting"}
    seen = labelled_albedos(model, table, views, labels, names)
    explained = light.get("explained_on_skin", light.get("explained"))
    given, known = (None if v is None or v == AUTO else float(v) for v in (wanted, explained))
    found = decide(seen, given, known, corrected="skin_explains" in light)
    apply_gain(model.spatial, model.light, found.gain)
    if model.second is not None and isinstance(model.second.light, ShLight):
        with torch.no_grad():
            model.second.light.coefficients.div_(found.gain)
    return found.facts


def labelled_albedos(
    model: FaceModel,
    table: PixelTable,
    views: Sequence[PhotoView],
    labels: Sequence[U8 | None],
    names: Sequence[str],
) -> LabelledAlbedos:
    """Albedos at random labelled pixels of all views. labels, names: as in residuals.view_errors."""
    generator = torch.Generator().manual_seed(SEED)
    pools: dict[str, list[Tensor]] = {FACE: [], EYES: []}
    for n, (view, codes) in enumerate(zip(views, labels, strict=True)):
        own = table.inside[table.view[table.inside] == n]
        if codes is None or not len(own):
            continue
        found = torch.from_numpy(codes_at(view, table.xy[own], codes).astype(np.int64)).to(own.device)
        for name, pool in pools.items():
            if name in names:
                pool.append(own[found == list(names).index(name)])
    x, _, _ = _hits(model, table, pools[FACE], generator)
    with torch.no_grad():
        face = model.spatial(x)[0]
    return LabelledAlbedos(_array(face), _array(_shown(model, table, *_hits(model, table, pools[EYES], generator))))


def _hits(
    model: FaceModel, table: PixelTable, pools: list[Tensor], generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Points and unit normals (N, 3) at at most MOST_PIXELS of these pixels, and the pixels (N,)."""
    pixels = torch.cat(pools) if pools else table.inside[:0]
    if len(pixels) > MOST_PIXELS:
        pixels = pixels[torch.randint(len(pixels), (MOST_PIXELS,), generator=generator).to(pixels.device)]
    return surface_hits(model.geometry, table.at(pixels).rays, pixels)


def _shown(model: FaceModel, table: PixelTable, x: Tensor, n: Tensor, pixels: Tensor) -> Tensor:
    """(N, 3) albedo that the photos themselves show under the fitted light, without the fitted reflection: the field's
    own albedo can't exceed 1, and blurs what is as small as an eye. Clipped pixels and the subject's rim are left
    out."""
    with torch.no_grad():
        batch = table.at(pixels)
        shaded = model.shade(x, n, -batch.rays.d, batch.rays.stations)
        colour = linear_from_srgb(batch.target)
        if model.spec.colour_matrices:
            colour = torch.linalg.solve(model.calibration()[batch.view], colour)
        albedo = (colour - shaded.specular) * shaded.albedo / shaded.diffuse.clamp(min=1e-6)
        return albedo[(batch.bound == 0).all(-1) & (batch.alpha > WHOLE) & albedo.isfinite().all(-1)]


def _array(colour: Tensor) -> F64:
    return np.asarray(colour.cpu().numpy(), np.float64)


def decide(
    seen: LabelledAlbedos, wanted: float | None, explained: float | None, *, corrected: bool = False
) -> AlbedoLevel:
    """The level from all sources.

    wanted: luminance of the face's albedo that was measured, None to decide. explained: share of the view-dependent
    variance that the light's estimate explains, on skin or everywhere, in (0, 1), None without. corrected: whether the
    light was corrected by the skin.
    """
    skin = float(np.median(seen.face @ LUMA)) if len(seen.face) >= MIN_PIXELS else None
    if wanted is not None:
        if skin is None:
            return AlbedoLevel(1.0, 0.0, {"gain": 1.0, "why": "setting, but no pixel has the label face"})
        gain = wanted / max(skin, 1e-6)
        return AlbedoLevel(gain, 0.0, {"gain": round(gain, 4), "face": round(wanted, 4), "why": "setting"})
    source, std = ("lobe", level_std(explained)) if explained is not None else ("start", START_STD)
    total, weight, facts = 0.0, std**-2, dict[str, str | float | bool]()
    white = sclera(seen)
    if white is not None:
        usual, deviation = (CORRECTED_SCLERA, CORRECTED_STD) if corrected else (SCLERA, EYES_STD)
        total, weight = deviation**-2 * math.log(usual / white), weight + deviation**-2
        facts["whites_of_the_eyes"] = round(white, 4)
        source += " and eyes"
    gain = math.exp(total / weight)
    if skin is not None:
        brightest = float(np.quantile(seen.face.max(1), WHITE_QUANTILE))
        gain = min(gain, max(WHITEST / max(brightest, 1e-6), 1.0))
        facts["face"] = round(gain * skin, 4)
    facts |= {"gain": round(gain, 4), "log_std": round(weight**-0.5, 3), "why": source}
    return AlbedoLevel(gain, weight**-0.5, facts)


def level_std(explained: float) -> float:
    """Standard deviation of ln g of a light estimate that explains this share, clamped to [0.01, 0.99]; never more than
    START_STD, the knowledge without an estimate."""
    e = min(max(explained, 0.01), 0.99)
    return min(LEVEL_STD * (1 - e) / e, START_STD)


def lobe_std(explained: float) -> float:
    """How far the light's low bands are believed where it explains this share, as level_std; skin_light.py corrects the
    light by it. Of those bands it is nearer to the truth than of the level."""
    e = min(max(explained, 0.01), 0.99)
    return min(LOBE_STD * math.pow((1 - e) / e, 1.5), START_STD)


def sclera(seen: LabelledAlbedos) -> float | None:
    """Luminance of the whites of the eyes; None for closed or hidden eyes, which are as red as skin and have no dark
    pupil."""
    if len(seen.eyes) < MIN_PIXELS or len(seen.face) < MIN_PIXELS:
        return None
    light = seen.eyes @ LUMA
    dark, white = np.quantile(light, (DARKEST, BRIGHTEST))
    if not white > 0 or dark > CONTRAST * white:
        return None
    top, skin = np.median(seen.eyes[light >= white], 0), np.median(seen.face, 0)
    return float(white) if _redness(skin) - _redness(top) > LESS_RED else None


def _redness(colour: F64) -> float:
    return math.log(max(float(colour[0]), 1e-6) / max(float(colour[2]), 1e-6))


def apply_gain(spatial: SpatialField, light: ShLight, gain: float) -> None:
    """Multiply albedo and reflectance by g > 0 and divide the light by it. Every photo stays as it is, except for light
    that skin reflects onto itself, which keeps the factor of the former level (a few percent in concave parts)."""
    with torch.no_grad():
        spatial.level.mul_(gain)
        light.coefficients.div_(gain)
