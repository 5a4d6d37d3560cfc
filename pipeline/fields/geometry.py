"""The SDF as a spline grid, refined coarse to fine and optimised in a narrow band.

Symbols: values (X, Y, Z) spline coefficients at lo + i cell, asset units (pipeline.maths.sdf). The band is the set of
coefficients within BAND cells of the zero set; only these are optimised. The other values are distances by an exact
distance transform, computed at each refinement, so that rays can skip empty space.

Differs from plain Adam: its steps are as long for a coefficient that few rays touch as for one that many photos show,
so that noise moves it and skin in few views becomes rough. Here the root of the band's mean second moment is added to
that of each coefficient, so that steps are shorter where the photos give less information (docs/model.md).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn

from pipeline.fields import kernels
from pipeline.fields.parts import Geometry
from pipeline.maths import sdf as spline
from pipeline.pieces import filled, subject_pieces

BAND = 4.0
BETAS = (0.9, 0.99)
DAMPING = 1.0  # of the band's typical gradient, added to the root of each coefficient's second moment
TYPICAL_EVERY = 20  # steps


class GridSdf(nn.Module):
    """SDF(x) and its gradient; contains the state of its own optimiser."""

    values: Tensor
    lo: Tensor

    def __init__(self, values: Tensor, lo: Tensor, cell: float) -> None:
        super().__init__()
        self.cell = cell
        self.register_buffer("lo", lo.float().clone())
        self._set(values.float())

    def _set(self, values: Tensor) -> None:
        self.values = nn.Parameter(values.contiguous())
        self._clear()

    def _clear(self) -> None:
        values = self.values.detach()
        self.sink = torch.zeros_like(values)
        self.m = torch.zeros_like(values)
        self.v = torch.zeros_like(values)
        self.steps = 0
        self.typical = 0.0  # gradient of the coefficients that rays touch, when last measured
        self.find_band()

    @property
    def shape(self) -> tuple[int, int, int]:
        """Coefficients along each axis."""
        x, y, z = self.values.shape
        return x, y, z

    def box(self) -> tuple[Tensor, Tensor]:
        """(3,) corners of the volume where the spline is complete (half a cell inside the second outermost nodes)."""
        n = torch.tensor(self.shape, device=self.lo.device)
        return self.lo + 0.5 * self.cell, self.lo + (n - 1.5) * self.cell

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """SDF (N,) and gradient (N, 3) at x (N, 3); gradients reach the coefficients, not x."""
        out: tuple[Tensor, Tensor] = kernels.SplineSdf.apply(x, self.values, self.sink, self.lo, self.cell)  # type: ignore[no-untyped-call]
        return out

    def trace(
        self, o: Tensor, d: Tensor, near: Tensor, far: Tensor, depth: float = 0.0
    ) -> tuple[Tensor, Tensor, Tensor]:
        """t, hit and SDF of the first hit or the closest approach. [NeuFace section 4.4] depth: of the surface that is
        met, below the zero set; the SDF is then that of this surface.

        Differs: factor 0.95 instead of 1.2. A spline of a hull's distance may have a slope above 1, and crossings are
        found by the sign, so that shorter steps cost little (measured in docs/benchmarks.md).
        """
        values = self.values + depth if depth else self.values  # a spline of shifted coefficients is the shifted spline
        return kernels.trace(values, self.lo, self.cell, o, d, near, far, min_step=0.3 * self.cell, factor=0.95)

    # ---------------------------------------------------------------- optimisation
    def find_band(self) -> None:
        """Select the coefficients that are optimised from now on."""
        with torch.no_grad():
            inner = torch.zeros_like(self.values, dtype=torch.bool)
            inner[1:-1, 1:-1, 1:-1] = True
            near = (self.values.abs() < BAND * self.cell) & inner
            idle = ~near  # coefficients that leave the band lose their momentum: a checkpoint contains only the band
            self.m[idle], self.v[idle] = 0, 0
            self.sink.zero_()  # and coefficients that enter it start without old gradients
            self.active = torch.nonzero(near.view(-1)).squeeze(-1)

    def step(self, lr: float) -> None:
        """One damped Adam step on the band; lr in asset units, the length of the longest step."""
        self.steps += 1
        if self.steps <= 2 or self.steps % TYPICAL_EVERY == 0:
            self.typical = self._typical_gradient()
        eps = max(DAMPING * self.typical, kernels.MIN_EPS)
        kernels.adam_on_band(self.values, self.sink, self.m, self.v, self.active, self.steps, lr, BETAS, eps)

    def _typical_gradient(self) -> float:
        """Mean root of the second moments of the coefficients that rays touched; at first, of the gradients."""
        known = self.steps > 1
        moments = self.v.view(-1)[self.active] if known else self.sink.view(-1)[self.active].square()
        moments = moments[moments > 0]
        unbiased = 1 - BETAS[1] ** (self.steps - 1) if known else 1.0
        return float((moments / unbiased).sqrt().mean()) if len(moments) else 0.0

    def gradient_is_finite(self) -> bool:
        """Whether the gradients since the last step are finite. kernels.SplineSdf marks gradients that are not."""
        return bool(torch.isfinite(self.sink[0, 0, 0]))

    def drop_gradient(self) -> None:
        """Discard the gradients since the last step."""
        self.sink.zero_()

    def redistance(self) -> None:
        """Keep the subject's components, fill their cavities, and recompute the distances outside the band."""
        values = self.values.detach().cpu().numpy()
        solid = filled(subject_pieces(values < 0, self.lo.cpu().numpy(), self.cell))
        far = coarse_distance(~solid)  # in place, because copies of a fine grid are most of the memory of a fit
        np.negative(coarse_distance(solid), out=far, where=solid)
        far *= np.float32(self.cell)
        keep = (far < (BAND - 1) * self.cell) & (far > -(BAND - 1) * self.cell) & (solid == (values < 0))
        np.copyto(far, values, where=keep)
        with torch.no_grad():
            self.values.copy_(torch.from_numpy(far))
        self.find_band()

    def replace(self, values: Tensor) -> None:
        """Continue with other values (X, Y, Z). Coefficients that changed start without momentum."""
        with torch.no_grad():
            new = values.to(self.values)
            changed = new != self.values
            self.m[changed] = 0
            self.values.copy_(new)
        self.redistance()

    def refine(self) -> None:
        """Halve the cell: the same function on a grid with eight times as many coefficients."""
        self.redistance()
        with torch.no_grad():
            finer = spline.refine(self.values.detach())
        self.lo -= 0.25 * self.cell
        self.cell *= 0.5
        self._set(finer)

    def on_cpu(self) -> GridSdf:
        """This surface on the CPU, for code that traces rays from numpy: itself if it is there already."""
        if self.values.device.type == "cpu":
            return self
        return GridSdf(self.values.detach().cpu(), self.lo.cpu(), self.cell)

    # ---------------------------------------------------------------- checkpoints
    def to_device(self, device: str) -> None:
        """Move the optimiser's state to the device of the module."""
        self.sink, self.m, self.v = (x.to(device) for x in (self.sink, self.m, self.v))
        self.active = self.active.to(device)

    def restore(self, values: Tensor) -> None:
        """Set a grid of another size (from a checkpoint); the optimiser's state is reset."""
        self._set(values)

    def optimiser_state(self) -> dict[str, Tensor | float]:
        """State of the optimiser in the band."""
        return {
            "active": self.active,
            "m": self.m.view(-1)[self.active],
            "v": self.v.view(-1)[self.active],
            "steps": self.steps,
            "typical": self.typical,
        }

    def load_optimiser_state(self, state: dict[str, Tensor | float]) -> None:
        """Inverse of `optimiser_state`, on the same grid."""
        active = torch.as_tensor(state["active"]).to(self.values.device)
        self.active = active
        self.m.view(-1)[active] = torch.as_tensor(state["m"]).to(self.m)
        self.v.view(-1)[active] = torch.as_tensor(state["v"]).to(self.v)
        self.steps = int(state["steps"])
        self.typical = float(state["typical"])


def grid_of(geometry: Geometry) -> GridSdf:
    """The geometry, if it is a GridSdf, which the fast fit refines."""
    assert isinstance(geometry, GridSdf)
    return geometry


def coarse_distance(free: np.ndarray) -> np.ndarray:
    """(X, Y, Z) distance in cells from nodes where `free` (X, Y, Z) to the next other node, at least 0.5; never more
    than the true distance.

    It is computed on every second node, which is eight times faster and at most 4 cells too short. It is used to skip
    empty space: a short step costs little, a long one would miss the surface.
    """
    padded = np.pad(free, [(0, n % 2) for n in free.shape], mode="edge")
    x, y, z = (n // 2 for n in padded.shape)
    blocks = padded.reshape(x, 2, y, 2, z, 2).all((1, 3, 5))
    distance = 2 * ndimage.distance_transform_edt(blocks).astype(np.float32) - 2
    np.maximum(distance, np.float32(0.5), out=distance)
    full = distance.repeat(2, 0).repeat(2, 1).repeat(2, 2)[: free.shape[0], : free.shape[1], : free.shape[2]]
    return np.ascontiguousarray(full)
