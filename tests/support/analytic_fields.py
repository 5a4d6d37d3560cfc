"""Fields with known surfaces and materials, for tests of what comes after the fit.

They answer the questions of pipeline.fields.protocol.Field in closed form, so that a test's oracle is a formula.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.fields.protocol import F32, Material

F64 = npt.NDArray[np.float64]
Distance = Callable[[F64], tuple[F64, F64]]  # (N, 3) -> (N,) value, (N, 3) gradient


def sphere(radius: float = 0.1, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Distance:
    """Exact distance to a sphere."""

    def evaluate(p: F64) -> tuple[F64, F64]:
        offset = p - np.array(centre)
        length = np.linalg.norm(offset, axis=1)
        return length - radius, offset / np.maximum(length, 1e-12)[:, None]

    return evaluate


def ellipsoid(radii: tuple[float, float, float] = (0.075, 0.11, 0.09)) -> Distance:
    """First-order distance (q - 1) * q / |grad| of an ellipsoid: exact zero set, right gradient there."""
    r = np.array(radii)

    def evaluate(p: F64) -> tuple[F64, F64]:
        q = np.linalg.norm(p / r, axis=1)
        scale = float(r.min())  # keeps the slope <= 1 everywhere
        return (q - 1) * scale, p / r**2 / np.maximum(q, 1e-9)[:, None] * scale

    return evaluate


def bumpy_head(bumps: float = 0.003, frequency: float = 90.0) -> Distance:
    """A head-sized ellipsoid with bumps, a nose and a neck that leaves the box through its floor."""
    skull, nose = ellipsoid((0.075, 0.1, 0.09)), sphere(0.022, (0.0, -0.005, 0.088))

    def neck(p: F64) -> tuple[F64, F64]:
        rim = np.hypot(p[:, 0], p[:, 2])
        gradient = np.stack([p[:, 0], np.zeros(len(p)), p[:, 2]], 1) / np.maximum(rim, 1e-9)[:, None]
        below = p[:, 1] + 0.02  # the tube starts inside the skull
        inside_tube = rim - 0.05
        upper = below > inside_tube
        up = np.tile([0.0, 1.0, 0.0], (len(p), 1))
        return np.where(upper, below, inside_tube), np.where(upper[:, None], up, gradient)

    def evaluate(p: F64) -> tuple[F64, F64]:
        value, gradient = skull(p)
        for part in (nose, neck):
            value, gradient = _smooth_union(value, gradient, *part(p), width=0.012)
        wave = np.sin(frequency * p)
        value = value + bumps * wave.prod(1)
        slope = np.cos(frequency * p) * frequency * bumps
        others = np.stack([wave[:, 1] * wave[:, 2], wave[:, 0] * wave[:, 2], wave[:, 0] * wave[:, 1]], 1)
        return value, gradient + slope * others

    return evaluate


def union(*parts: Distance) -> Distance:
    """The nearest of several shapes."""

    def evaluate(p: F64) -> tuple[F64, F64]:
        value, gradient = parts[0](p)
        for part in parts[1:]:
            v, g = part(p)
            gradient = np.where((v < value)[:, None], g, gradient)
            value = np.minimum(v, value)
        return value, gradient

    return evaluate


def _smooth_union(a: F64, ga: F64, b: F64, gb: F64, width: float) -> tuple[F64, F64]:
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + (a - b) * h - width * h * (1 - h), gb + (ga - gb) * h[:, None]


def linear_albedo(p: F64) -> F64:
    """(N, 3) in about [0.2, 0.8] within 0.12 of the origin: a linear function of position."""
    matrix = np.array([[1.5, 0.6, -0.4], [-0.5, 1.7, 0.3], [0.8, -0.6, 1.2]])
    return 0.5 + p @ matrix.T


def linear_rho(p: F64) -> F64:
    """(N,) specular intensity."""
    return 0.4 + 1.1 * p[:, 0] - 0.8 * p[:, 1]


def linear_coefficients(p: F64) -> F64:
    """(N, 3) positive coefficients."""
    return np.stack([0.6 + 2 * p[:, 2], 0.3 + p[:, 0], 0.2 - p[:, 1]], 1)


def linear_inv_kappa(p: F64) -> F64:
    """(N,) 1/kappa, kappa about 10 to 60."""
    return 0.05 + 0.3 * p[:, 1]


@dataclass
class AnalyticField:
    """A Field whose surface and material are formulas. `evaluations` counts SDF points, to hold costs down."""

    distance: Distance
    half: tuple[float, float, float] = (0.12, 0.13, 0.12)
    cell: float = 0.002
    rank: int = 3
    evaluations: int = field(default=0)

    @property
    def bounds(self) -> tuple[F32, F32]:
        corner = np.array(self.half, np.float32)
        return -corner, corner

    @property
    def light(self) -> F32:
        out = np.zeros((121, 3), np.float32)
        out[0] = 1.0
        return out

    @property
    def moving_light(self) -> None:
        """None: the light stands still."""

    @property
    def colour_responses(self) -> None:
        """None: every photo shows the true colours."""

    def sdf(self, points: F32) -> F32:
        self.evaluations += len(points)
        return self.distance(points.astype(np.float64))[0].astype(np.float32)

    def sdf_and_gradient(self, points: F32) -> tuple[F32, F32]:
        self.evaluations += len(points)
        value, gradient = self.distance(points.astype(np.float64))
        return value.astype(np.float32), gradient.astype(np.float32)

    def material(self, points: F32) -> Material:
        p = points.astype(np.float64)
        return Material(
            linear_albedo(p).astype(np.float32),
            linear_rho(p).astype(np.float32),
            linear_coefficients(p)[:, : self.rank].astype(np.float32),
            linear_inv_kappa(p).astype(np.float32),
        )

    def irradiance_ratio(self, points: F32) -> F32:
        """No shadows."""
        return np.ones((len(points), 3), np.float32)

    def basis(self, wo: F32, normal: F32) -> F32:
        """B_j = (j + 1) / 20 * (1 + (1 - n.v)^2): a function of n.v alone, so that its marginal is exact."""
        cosine = np.clip((wo * normal).sum(1), 0, 1)
        lobe = 1 + (1 - cosine) ** 2
        return (lobe[:, None] * np.arange(1, self.rank + 1) / 20).astype(np.float32)
