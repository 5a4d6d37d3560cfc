"""Handling of steps with values that are not finite: such a step is dropped, counted and explained. After a given
number of dropped steps the fit stops with an error.

A step is dropped before any update, so parameters, optimiser state and checkpoints come from finite steps only.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pipeline.errors import StageError
from stages.inverse_rendering.objective import Terms
from stages.inverse_rendering.ray_sampling import Batch

log = logging.getLogger(__name__)
SHOWN = 3  # rays in one message


@dataclass(slots=True)
class Guard:
    """The dropped steps with their causes. limit: number of dropped steps at which the fit stops."""

    limit: int
    causes: list[str] = field(default_factory=list)

    @property
    def dropped(self) -> int:
        """Steps dropped so far."""
        return len(self.causes)

    def drop(self, step: int, cause: str) -> None:
        """Count a dropped step. Raises StageError at the limit."""
        self.causes.append(f"step {step}: {cause}")
        log.warning("step %d dropped (%d of %d): %s", step, self.dropped, self.limit, cause)
        if self.dropped >= self.limit:
            raise StageError(
                "the fit diverged: too many steps were not finite",
                where=f"inverse_rendering, step {step}",
                value=f"{self.dropped} dropped steps; the last: {cause}",
                limit=f"fewer than {self.limit} dropped steps (--set inverse_rendering.max_dropped)",
                remedy="the checkpoint has the last good state. Check the listed views; set "
                "inverse_rendering.lr_sdf or inverse_rendering.lr_appearance to half",
            )


def gradients_are_finite(optimiser: torch.optim.Optimizer) -> bool:
    """Whether all gradients of the optimiser are finite. Their sum is tested, which is fast."""
    grads = [p.grad for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    return not grads or math.isfinite(float(torch.stack([g.sum() for g in grads]).sum()))


def cause_of(found: Terms, batch: Batch, names: list[int], parameters: list[tuple[str, Tensor]]) -> str:
    """Which term is not finite, and on which rays. `names`: photo indices by position in the fit. `parameters`: for
    gradients of the terms, if every value is finite.

    The terms must still have their graph.
    """
    for name, scalar in found.scalars.items():
        if not math.isfinite(float(scalar.detach())):
            return f"term {name} is {float(scalar.detach())}" + _rays_of(found, name, batch, names)
    guilty = []
    for name, scalar in found.scalars.items():
        if not scalar.requires_grad:
            continue
        grads = torch.autograd.grad(scalar, [p for _, p in parameters], retain_graph=True, allow_unused=True)
        bad = [n for (n, _), g in zip(parameters, grads, strict=True) if g is not None and not torch.isfinite(g).all()]
        if bad:
            guilty.append(f"term {name} has a gradient that is not finite in {', '.join(bad[:SHOWN])}")
    return "; ".join(guilty) or "a gradient of the geometry is not finite"


def _rays_of(found: Terms, name: str, batch: Batch, names: list[int]) -> str:
    """Views and rays with values that are not finite."""
    if name not in found.values:
        return " (it is not a sum over rays)"
    values, rays = found.values[name]
    bad = torch.unique(rays[~torch.isfinite(values)])
    if not len(bad):
        return " (each ray's value is finite; their sum is not)"
    views = sorted({names[int(v)] for v in batch.view[bad].tolist()})
    first = "; ".join(
        f"view {names[int(batch.view[i])]} towards ({', '.join(f'{v:.3f}' for v in batch.rays.d[i].tolist())})"
        for i in bad[:SHOWN].tolist()
    )
    shown = ", ".join(str(v) for v in views[:10]) + (", ..." if len(views) > 10 else "")
    return f" on {len(bad)} of {len(batch.alpha)} rays, views {shown}; first: {first}"
