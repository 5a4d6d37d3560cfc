"""Light estimation in closed form from view-dependent residuals.

    c_pv = D_p + w(n . wo) sum_lm A_l(1 / kappa) L_lm Y_lm(w_r)

Symbols as in cross_validation.py; w(n . wo) = F0 A + B is the reflectance of rough skin of index 1.42 under a uniform
light (split-sum table of a GGX lobe). So L has the units of the photos, and no albedo is needed: D_p is free for every
point and is eliminated with its mean over the views. L_lm is then a linear least-squares problem. On two heads with
known light, the radiance over the sphere, bands 1 to 4, correlates 0.97 to 0.99 with the truth, and its level is within
3 % (docs/model.md); a fit that starts from a uniform light reaches 0.6 to 0.8.

The ratio of band 0 to the others changes least with the view, so it is the least accurate. The bands from 1 on are
scaled by the factor that makes the albedo pi D_p / E(n_p) most uniform; their shape and band 0 are unchanged. Uniform:
with the least product of its unevenness over all points and over the skin of the face. Dark hair above and a shirt
below look like light from below, skin alone is a small part of the directions. Where the albedo gets more even up
to the largest factor, there is no estimate: on a man beside a window that one gave a light that was negative on his
face. The least factor stays: a light that is too even does no such harm.

w is known of skin alone. Matt cloth and hair reflect less, so that all points together take the light for too dim, and
the albedo for too bright. So where skin tells the level better than all points do, it comes from skin
(`level_by_skin`).

Polarised pairs show the lobe alone: s_pv = w(n . wo) sum_lm A_l L_lm Y_lm(w_r). Then no D_p is eliminated, and band 0
is as accurate as the others.

Differs: not in the paper, which learns light, albedo and lobe together from a white light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.maths import sh
from pipeline.maths.ggx_width import gauge_alpha
from pipeline.maths.microfacet import SKIN_F0
from pipeline.maths.split_sum import environment_brdf
from pipeline.maths.vmf import ATTENUATIONS
from stages.inverse_rendering.albedo_level import lobe_std
from stages.inverse_rendering.observations import Observations, lobe_basis, point_means

F64 = npt.NDArray[np.float64]
RIDGE = 1e-3  # of the mean eigenvalue
MIN_VIEWS = 3  # of a point
MIN_POINTS = 200
MIN_EXPLAINED = 0.2  # smallest explained share of the view-dependent variance; at .165 an albedo lost 4 dB
SCALES = np.geomspace(0.25, 4.0, 91)  # of the bands from 1 on
MIN_SKIN = 50  # points of skin from which on it counts
DARKEST = 0.02  # of the mean irradiance: lower limit on all sides of the head
LIT_SHARE = 0.9  # smallest share of points above that limit and with a positive D


@dataclass(frozen=True, slots=True)
class LightEstimate:
    """coefficients: ((L + 1)^2,) SH of a white light in the photos' units. explained: share of the view-dependent
    variance that it explains. scale: factor of the bands from 1 on. level: factor of all of it by the skin.
    explained_on_skin: the larger of `explained` and the same share on the skin alone."""

    coefficients: F64
    explained: float
    scale: float
    level: float = 1.0
    explained_on_skin: float = 0.0


def reflectance(cosine: F64) -> F64:
    """w(n . wo) (N,): specular reflectance of skin under a uniform light, for n . wo (N,) in [0, 1]."""
    c = torch.from_numpy(np.asarray(cosine, np.float64))
    alpha = gauge_alpha(torch.full_like(c, TYPICAL_INV_KAPPA))
    return np.asarray(
        environment_brdf(torch.full((len(c), 1), SKIN_F0, dtype=c.dtype), c, alpha)[:, 0].numpy(), np.float64
    )


def light_from_lobe(seen: Observations, order: int, gain: F64, attenuation: str) -> LightEstimate | None:
    """The light up to SH `order` from observations; None if the view-dependent part is too small.

    gain: (V, 3) of each view's camera, 1 if all are equal.
    """
    counts = np.bincount(seen.point, minlength=len(seen.x))
    often = counts >= MIN_VIEWS
    if order < 1 or often.sum() < MIN_POINTS:
        return None
    keep = often[seen.point]
    point, cosine = seen.point[keep], seen.cosine[keep]
    colour = (seen.colour[keep] / gain[seen.view[keep]]).mean(1)
    usual = torch.full((1,), TYPICAL_INV_KAPPA, dtype=torch.float64)
    f = lobe_basis(seen.mirror[keep], ATTENUATIONS[attenuation](usual, order).numpy()) * reflectance(cosine)[:, None]

    def mean(values: F64) -> F64:
        return point_means(point, values, np.maximum(counts, 1))

    inside = f - mean(f)[point]
    y = colour - mean(colour)[point]
    gram = inside.T @ inside
    gram += RIDGE * max(float(np.trace(gram)) / len(gram), 1e-300) * np.eye(len(gram))
    b = np.linalg.solve(gram, inside.T @ y)
    explained = 1 - float(((y - inside @ b) ** 2).sum() / max((y * y).sum(), 1e-300))
    if explained < MIN_EXPLAINED or b[0] <= 0:
        return None
    scale = _evenest(seen, b, mean(colour), mean(f[:, 1:] @ b[1:]), mean(f[:, 0]), often)
    if scale is None:
        return None
    skin = seen.on_skin
    level, best = 1.0, explained
    if (skin & often).sum() >= MIN_SKIN:
        on_skin = skin[point]
        level, best = level_by_skin(inside[on_skin] @ b, y[on_skin], explained)
    return LightEstimate(level * np.concatenate([b[:1], scale * b[1:]]), explained, scale, level, best)


def level_by_skin(lobe: F64, seen: F64, explained: float) -> tuple[float, float]:
    """Factor g of the light's level by what changes with the view on skin, and the larger share explained.

    lobe, seen (M,): predicted by the light of all points, and seen, each without its mean over the views; radiance.
    explained: share of the variance over all points that the light explains, in (0, 1).

        g = s^(1 - (sigma_s / sigma)^2),    s = lobe . seen / lobe . lobe

    s is the best factor on skin. sigma_s and sigma are the standard deviations of ln g that belong to the shares that
    skin (with s) and all points explain (albedo_level.lobe_std). g is 1 where skin explains no more than all points.
    """
    both = float(lobe @ seen)
    size = float(lobe @ lobe)
    if both <= 0 or size <= 0:
        return 1.0, explained
    share = both**2 / (size * float(seen @ seen))
    doubt = lobe_std(share) / lobe_std(explained)
    return float((both / size) ** max(0.0, 1 - doubt**2)), max(share, explained)


def light_from_mirror(seen: Observations, order: int, gain: F64, attenuation: str) -> LightEstimate | None:
    """The light up to SH `order` from observations whose colours are the mirror reflection alone; None if they do not
    follow one light.

    gain: (V, 3) of each view's camera, 1 if all are equal.
    """
    if order < 1 or len(seen.point) < MIN_POINTS:
        return None
    y = (seen.colour / gain[seen.view]).mean(1)
    usual = torch.full((1,), TYPICAL_INV_KAPPA, dtype=torch.float64)
    falls = ATTENUATIONS[attenuation](usual, order).numpy()
    f = lobe_basis(seen.mirror, falls) * reflectance(seen.cosine)[:, None]
    gram = f.T @ f
    gram += RIDGE * max(float(np.trace(gram)) / len(gram), 1e-300) * np.eye(len(gram))
    b = np.linalg.solve(gram, f.T @ y)
    left = y - f @ b
    explained = 1 - float((left * left).sum() / max(((y - y.mean()) ** 2).sum(), 1e-300))
    if explained < MIN_EXPLAINED or b[0] <= 0:
        return None
    return LightEstimate(b, explained, 1.0, 1.0, explained)


def _evenest(
    seen: Observations, b: F64, total: F64, glow: F64, even: F64, often: npt.NDArray[np.bool_]
) -> float | None:
    """The scale with the most even albedo of those that light all sides, None if that is the largest. b:
    ((L + 1)^2,) coefficients. total, glow, even (P,): means over the views of the colour, of the lobe's bands from 1
    on, and of its band 0 per unit of L_00. often: (P,) used points."""
    light = np.zeros((len(b), 3))
    light[1:] = b[1:, None]
    sides = sh.irradiance(torch.from_numpy(light), seen.n.detach().cpu().double()).numpy()[:, 0]
    mean = float(np.pi * b[0] / np.sqrt(4 * np.pi))
    tried, skin = list[tuple[float, float]](), seen.on_skin
    for scale in SCALES:
        e, d = mean + scale * sides, total - scale * glow - even * b[0]
        good = often & (e > DARKEST * mean) & (d > 0)
        if good.sum() < LIT_SHARE * often.sum():
            continue
        spread = _unevenness(d[good] / e[good])
        if (good & skin).sum() >= MIN_SKIN:
            spread *= _unevenness(d[good & skin] / e[good & skin])
        tried.append((spread, float(scale)))
    if not tried or min(tried)[1] == SCALES[-1]:
        return None
    return min(tried)[1]


def _unevenness(albedo: F64) -> float:
    """Mean absolute deviation of ln albedo (N,) from its median."""
    log = np.log(albedo)
    return float(np.abs(log - np.median(log)).mean())
