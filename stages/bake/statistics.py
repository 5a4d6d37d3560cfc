"""Statistics of the texels of one tile or of all: figures and warnings for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pipeline.maths import ggx_width
from stages.bake import detail
from stages.bake.texels import Samples

MANY_LOST = 0.02  # share of texels off the zero set that causes a warning; the cap of a neck has less
MANY_CLAMPED = 0.001
RESIDUAL = 0.1  # of the basis table: a larger one causes a warning
SHARP_KAPPA = 50.0  # light of order 10 does not resolve sharper lobes
SOME = 0.01  # share of texels with lobes that the maps can't represent that causes a warning


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts of texels. room: all; texels: those under charts; of these: landed (on the zero set), unseen, clamped,
    detailed (with photo detail), and those with sharp or rough lobes. squares: sum of the squared distances (m^2) of
    the landed ones."""

    room: int
    texels: int
    landed: int
    squares: float
    unseen: int
    clamped: int
    detailed: int
    sharp: int
    rough: int

    @property
    def coverage(self) -> float:
        """Share of all texels under charts."""
        return self.texels / self.room

    @property
    def deviation(self) -> float:
        """Root mean square distance (m) of the mesh from the zero set, over the texels that landed."""
        return float(np.sqrt(self.squares / self.landed)) if self.landed else 0.0

    def figures(self, *, detail: bool) -> dict[str, float]:
        """Figures for the report; `detail`: whether photo detail was used."""
        out = {"unseen": self.unseen / self.texels, "albedo_clamped": self.clamped / self.texels}
        if detail:
            out["detail_support"] = self.detailed / self.texels
        return {k: round(v, 6) for k, v in out.items()}

    def warnings(self, residual: float, views: int) -> tuple[str, ...]:
        """Warnings. residual: of the basis table; views: number of photos that were used."""
        out = []
        lost, sharp, rough, clamped = (
            n / self.texels for n in (self.texels - self.landed, self.sharp, self.rough, self.clamped)
        )
        if lost > MANY_LOST:
            out.append(
                f"the fitted surface does not reach {lost:.1%} of the texels (flat cut of the neck, or a mesh that "
                "does not belong to this field)"
            )
        if residual > RESIDUAL:
            out.append(f"basis_lut.exr is a mean over directions; the learned basis varies by {residual:.0%} around it")
        if sharp > SOME:
            out.append(
                f"{sharp:.0%} of the texels have kappa above {SHARP_KAPPA:.0f}; light of order 10 does not resolve "
                "such lobes"
            )
        if rough > SOME:
            out.append(f"{rough:.0%} of the texels are rougher than the maximum of the roughness map")
        if clamped > MANY_CLAMPED:
            out.append(
                f"the albedo of {clamped:.1%} of the texels was outside the physical range and was clamped "
                "(clamped.png shows where)"
            )
        if views == 0:
            out.append("no fitted view has a camera: confidence is 0 everywhere")
        return tuple(out)


def statistics_of(s: Samples, size: int) -> Statistics:
    """Statistics of one tile with `size` texels along its side."""
    d = s.displacement[s.landed].astype(np.float64)
    return Statistics(
        room=size * size,
        texels=len(s.landed),
        landed=len(d),
        squares=float((d * d).sum()),
        unseen=int((s.unseen > 0.5).sum()),
        clamped=int((s.clamped > 0).sum()),
        detailed=int((s.support > detail.HALF_WEIGHT).sum()),
        sharp=int((s.inv_kappa < 1 / SHARP_KAPPA).sum()),
        rough=int(((1 / np.maximum(s.inv_kappa, 1e-6)) < ggx_width.KAPPA_RANGE[0]).sum()),
    )


def together(parts: Sequence[Statistics]) -> Statistics:
    """Statistics of all tiles."""
    return Statistics(**{f.name: sum(getattr(p, f.name) for p in parts) for f in fields(Statistics)})
