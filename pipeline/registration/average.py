"""The average of registered heads, and of their albedo: a test of their correspondence.

Heads of one topology are brought onto each other by generalised Procrustes (similarities, robust, on the outer skin
without the neck; what no photo shows counts little); their mean and its scatter are taken place by place. Where every
vertex means the same place on everybody, the mean of the textures is as sharp as each of them: eyes, lips and brows are
not doubled.

    sharpness = sum |grad of the mean|^2 / mean over the maps of sum |grad of the map|^2      1: all maps agree

over texels near landmarks, on lightness (sRGB-encoded luminance), after a Gaussian that removes single texels. It is at
most 1 for maps of equal weights (Jensen's inequality), and 1/N for N maps whose edges do not meet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from pipeline.colour import LUMA, srgb_from_linear
from pipeline.meshes import F32, F64, Indices, Mask, triangles_of
from pipeline.raster import in_texels, rasterise
from pipeline.registration.head import Head
from pipeline.registration.procrustes import generalised
from pipeline.registration.still import counted, evidence, outside
from pipeline.registration.subdivision import limit
from pipeline.template.model import SKIN, Template
from pipeline.transforms import apply, scale_of, similarity

NOISE = 1e-4  # metres: residuals below this are noise
GROUPS = {"eyes": "lids", "lips": "lips", "brows": "brows"}  # group of landmarks -> region that holds their corners
DISC = 0.015  # of a tile: radius around a landmark in which edges count
BLUR = 1 / 512  # of a tile: standard deviation of the Gaussian
LEAST_WEIGHT = 1e-3  # weight of a texel that a map has but its photos do not show


@dataclass(frozen=True, slots=True)
class Shape:
    """points (n, 3): mean of the displaced surfaces, upright as the template, of the heads' geometric mean size.
    deviation (n,): root of the summed variances of x, y and z over the heads. scales (N,): of each head onto it."""

    points: F64
    deviation: F64
    scales: F64


def average_shape(heads: Sequence[Callable[[], Head]], regions: tuple[str, ...], world_from_template: F64) -> Shape:
    """The mean of heads of one topology, each read by a call (twice, so that few are in memory). regions: names that
    their faces refer to; world_from_template (4, 4): of the first head.

    Raises:
        ValueError: the heads have other topologies, or their points no extent.
    """
    cages, weights, first = [], [], None
    for read in heads:
        head = read()
        first = first or head
        if not np.array_equal(head.quads, first.quads) or head.levels != first.levels:
            raise ValueError("heads of other topologies")
        cages.append(np.asarray(limit(head.quads, len(head.vertices)).point @ head.vertices))
        weights.append(counted(outside(head, regions).astype(np.float64), evidence(head, regions)))
    turn = world_from_template[:3, :3] / scale_of(world_from_template)
    upright = similarity(1.0, turn.T, -turn.T @ world_from_template[:3, 3])
    cages[0] = apply(upright, cages[0])
    matrices = generalised(np.stack(cages), np.stack(weights), scaled=True, least=NOISE).matrices
    matrices = np.concatenate([(matrices[0] @ upright)[None], matrices[1:]])
    mean, moment = np.zeros(1), np.zeros(1)
    for number, (read, matrix) in enumerate(zip(heads, matrices, strict=True), 1):
        x = apply(matrix, read().displaced())
        off = x - mean
        mean = mean + off / number
        moment = moment + off * (x - mean)
    spread = np.sqrt(moment.sum(1) / max(len(heads) - 1, 1))
    return Shape(np.asarray(mean), spread, np.array([scale_of(m) for m in matrices]))


def region_scatter(shape: Shape, head: Head, regions: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Median and 95 % of the deviation in mm, by region. head: one of those averaged."""
    quads, region = head.surface()[2], np.repeat(head.region, 4**head.levels)
    out = {}
    for i, name in enumerate(regions):
        own = shape.deviation[np.unique(quads[region == i])]
        if len(own):
            median, most = 1000 * np.quantile(own, [0.5, 0.95])
            out[name] = {"median_mm": round(float(median), 3), "p95_mm": round(float(most), 3)}
    return out


# ------------------------------------------------------------------ the texture
def landmark_discs(template: Template, size: int) -> dict[str, Mask]:
    """Texels (size, size) of tile 1001 near the landmarks of each group, of the skin and not of the holes of mouth and
    eyes; groups that the template lacks are left out. Row 0 is v = 1."""
    place, skin = _uv_of(template), _skin_texels(template, size)
    y, x = np.mgrid[:size, :size] + 0.5
    out = {}
    for group, region in GROUPS.items():
        if region not in template.regions:
            continue
        inside = np.isin(template.landmarks.corners, template.quads[template.regions[region]]).any(1)
        points = (place[template.landmarks.corners[inside]] * template.landmarks.weights[inside][..., None]).sum(1)
        mask = np.zeros((size, size), np.bool_)
        for u, v in points[np.isfinite(points).all(1) & (points[:, 0] < 1)]:
            mask |= (x - u * size) ** 2 + (y - (1 - v) * size) ** 2 <= (DISC * size) ** 2
        mask &= skin
        if mask.any():
            out[group] = mask
    return out


def _skin_texels(template: Template, size: int) -> Mask:
    """(size, size) texels of tile 1001 whose centre lies on the skin."""
    corners = template.uvs[template.uv_quads[template.parts[SKIN]]]
    own = triangles_of(np.arange(4 * len(corners)).reshape(-1, 4)[(corners[..., 0] <= 1).all(1)])
    hits = rasterise(in_texels(corners.reshape(-1, 2)[own], size), size, 0, size, reach=1e-6)
    out = np.zeros(size * size, np.bool_)
    out[hits.texel] = True
    return out.reshape(size, size)


def _uv_of(template: Template) -> F64:
    """(V, 2) texture coordinates of the skin's vertices; of several (at a seam) one of them, NaN beside the skin."""
    out, skin = np.full((len(template.vertices), 2), np.nan), template.parts[SKIN]
    corner: Indices = template.uv_quads[skin].ravel()
    out[template.quads[skin].ravel()] = template.uvs[corner]
    return out


def edge_energy(albedo: F32) -> F64:
    """(size, size) squared gradient of an albedo's (size, size, 3) lightness, per texel. Linear Rec.709."""
    light = srgb_from_linear((albedo.astype(np.float64) @ np.array(LUMA)).clip(0, 1))
    light = cv2.GaussianBlur(light, (0, 0), max(BLUR * len(light), 0.5))
    return np.asarray(sum(g * g for g in np.gradient(light)), np.float64)


@dataclass(slots=True)
class MeanTexture:
    """A mean of albedo maps (size, size, 3) that are added one by one, weighted by texel. discs: of landmark_discs, for
    the tile that has landmarks; else empty."""

    size: int
    discs: Mapping[str, Mask] = field(default_factory=dict)
    count: int = 0
    _total: F64 = field(default_factory=lambda: np.zeros(0))
    _weight: F64 = field(default_factory=lambda: np.zeros(0))
    _energy: dict[str, float] = field(default_factory=dict)

    def add(self, albedo: F32, weight: F32) -> None:
        """One map (s, s, 3) of linear albedo with weights (s, s) from 0 to 1; it is resampled to `size`."""
        a, w = (self._fitting(np.asarray(x, np.float64)) for x in (albedo, np.maximum(weight, LEAST_WEIGHT)))
        if self.count == 0:
            self._total, self._weight = np.zeros_like(a), np.zeros_like(w)
        self._total += a * w[..., None]
        self._weight += w
        self.count += 1
        if self.discs:
            energy = edge_energy(a.astype(np.float32))
            for name, mask in self.discs.items():
                self._energy[name] = self._energy.get(name, 0.0) + float(energy[mask].sum())

    def _fitting(self, picture: F64) -> F64:
        if len(picture) == self.size:
            return picture
        kind = cv2.INTER_AREA if len(picture) > self.size else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(picture, (self.size, self.size), interpolation=kind), np.float64)

    @property
    def mean(self) -> F32:
        """(size, size, 3) linear albedo."""
        return np.asarray(self._total / self._weight[..., None], np.float32)

    def sharpness(self) -> dict[str, float]:
        """By group of landmarks, and of all of them together as "all"; empty without landmarks or without edges."""
        energy = edge_energy(self.mean) if self.discs else np.zeros(0)
        of_mean = {n: float(energy[mask].sum()) for n, mask in self.discs.items()}
        ratios = {n: self.count * of_mean[n] / e for n, e in self._energy.items() if e > 0}
        total = sum(self._energy.values())
        return ratios | ({"all": self.count * sum(of_mean.values()) / total} if total > 0 else {})


def of_tiles(textures: Mapping[int, MeanTexture]) -> Iterator[tuple[int, F32]]:
    """Tile numbers (0: 1001) and their mean albedo."""
    for tile in sorted(textures):
        yield tile, textures[tile].mean
