"""The checks of the maps: share of the surface that photos show, and physically plausible material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.colour import LUMA
from pipeline.meshes import F32, Indices
from pipeline.verdict import Finding, Limits, judged
from stages.bake.regions import Votes
from stages.bake.texels import Samples

MAX_TEXELS = 100_000  # evenly spaced texels of a tile that are checked: shares are then accurate to 0.1 %
MIN_SKIN = 200  # texels of skin from which they are checked on their own
# Share of the texels that no photo shows. A head photographed all round in a rig: .25 (under the neck, inside the
# ears); people photographed from three sides: .45; an arc of cameras in front of the face: .62 to .67.
UNSEEN = Limits(0.35, 0.8, lower=False)
# F0 = ((n - 1) / (n + 1))^2: skin .028, plastics and glass .04 to .05, gems .08 to .17. Only metals have more; the
# model has no metals.
F0_MEAN = Limits(0.08, 0.2, lower=False)
F0_SKIN = Limits(0.06, 0.2, lower=False)
F0_TOP = Limits(0.2, 1.0, lower=False)  # 99.9th percentile; above 1 more light is reflected than arrives
F0_NONE = Limits(1e-3, 0.0)  # mean on a person; drafts of a scanned head have .006 to .008
# GGX roughness of skin is .25 to .6; .1 is wet or polished, 1 has no visible highlight.
ROUGHNESS_RANGE, ROUGHNESS = (0.1, 0.9), Limits(0.05, 0.5, lower=False)
# Linear albedo of skin, from the darkest to the lightest people, with a margin for folds and scars.
SKIN_RANGE, SKIN_ALBEDO = (0.03, 0.75), Limits(0.05, 0.5, lower=False)
CLAMPED = Limits(0.02, 0.2, lower=False)  # share of the texels; 0 on a scanned head, .02 to .04 if the shape is wrong


@dataclass(frozen=True, slots=True)
class Texels:
    """Figures of N texels that photos show. f0, roughness, luma (N,); skin (N,): labelled as face."""

    f0: F32
    roughness: F32
    luma: F32
    skin: np.typing.NDArray[np.bool_]


def chosen(s: Samples, texel: Indices, size: int, votes: Votes | None, names: Sequence[str]) -> Texels:
    """Evenly spaced texels of a tile that photos show; texel (N,): their flat indices in a picture of `size`."""
    seen = np.flatnonzero(s.unseen < 0.5)
    rows = seen[:: max(1, -(-len(seen) // MAX_TEXELS))]
    face = names.index("face") if "face" in names else -1
    skin = np.zeros(len(rows), np.bool_) if votes is None else votes.winners(texel[rows], size) == face
    return Texels(
        s.f0[rows],
        s.roughness[rows],
        np.asarray(s.base_color[rows] @ np.array(LUMA), np.float32),
        skin,
    )


def together(parts: Sequence[Texels]) -> Texels:
    """The texels of all tiles."""
    columns = zip(*((p.f0, p.roughness, p.luma, p.skin) for p in parts), strict=True)
    return Texels(*(np.concatenate(c) for c in columns))


def judge(t: Texels, figures: Mapping[str, float], *, person: bool) -> tuple[Finding, ...]:
    """All findings. figures: of the TextureSet (pipeline.artifacts). person: whether photos show a face."""
    return (*_seen(figures), *_clamped(figures), *_f0(t, person), *_roughness(t), *_skin(t))


def _seen(figures: Mapping[str, float]) -> list[Finding]:
    value = figures["unseen"]
    message = f"{value:.0%} of the surface is visible in no photo; its shape and colour are extrapolated"
    remedy = "also take photos from the sides, from behind, from above and from below"
    return [judged("unseen", value, UNSEEN, message, remedy)]


def _clamped(figures: Mapping[str, float]) -> list[Finding]:
    value = figures["albedo_clamped"]
    message = f"the albedo of {value:.1%} of the surface was outside the physical range and was clamped"
    remedy = "look at clamped.png: the shape, the shadows or the exposure are wrong there"
    return [judged("albedo_clamped", value, CLAMPED, message, remedy)]


def _f0(t: Texels, person: bool) -> list[Finding]:
    if not len(t.f0):
        return []
    skin = t.skin.sum() >= MIN_SKIN
    of = t.f0[t.skin] if skin else t.f0
    where = "the skin's" if skin else "the surface's"
    mean, top = float(of.mean()), float(np.quantile(of, 0.999))
    remedy = (
        "the fitted material is too reflective: the photos are clipped, or the light or the subject moved; use a fixed "
        "exposure without clipping and keep the light still, or set inverse_rendering.specular=off"
    )
    message = f"{where} F0 is {mean:.3f} on average (skin has .028, no stone or plastic more than .17)"
    out = [
        judged("f0_mean", mean, F0_SKIN if skin else F0_MEAN, message, remedy),
        judged("f0_top", top, F0_TOP, f"99.9 % of {where} F0 values are below {top:.3f}", remedy),
    ]
    if person:
        matt = (
            "the asset will look matt under other light; take photos under light with sharp edges (window, soft box) "
            "with a fixed exposure"
        )
        message = f"{where} F0 is {mean:.3f}" + (": it has no highlights" if mean < F0_NONE.good else "")
        out.append(judged("f0_none", mean, F0_NONE, message, matt))
    return out


def _roughness(t: Texels) -> list[Finding]:
    """The finding on roughness, over texels with a specular lobe."""
    of = t.roughness[t.f0 > 0]
    if not len(of):
        return []
    low, high = ROUGHNESS_RANGE
    value = float(((of < low) | (of > high)).mean())
    message = (
        f"roughness is outside {low:g} to {high:g} on {value:.1%} of the visible surface (90 % of it: {_range(of)})"
    )
    remedy = (
        "the highlights do not determine the roughness: take photos under light with sharp edges, from more directions"
    )
    return [judged("roughness", value, ROUGHNESS, message, remedy)]


def _skin(t: Texels) -> list[Finding]:
    if t.skin.sum() < MIN_SKIN:
        return []
    of, (low, high) = t.luma[t.skin], SKIN_RANGE
    value = float(((of < low) | (of > high)).mean())
    message = (
        f"the albedo of the face is outside skin's {low:g} to {high:g} on {value:.1%} of it (90 % of it: {_range(of)})"
    )
    remedy = "the fitted exposure or light is wrong: take photos with a colour checker and a fixed exposure"
    return [judged("albedo_skin", value, SKIN_ALBEDO, message, remedy)]


def _range(values: F32) -> str:
    low, high = np.quantile(values, (0.05, 0.95))
    return f"{low:.2f} to {high:.2f}"
