"""Real spherical harmonics as sums of powers, for programs that are told them as numbers.

    Y_lm = sum_t c_t x^i_t y^j_t z^k_t
         = K_lm (d/dz)^m P_l(z)  (Im or Re) (x + i y)^m,   m = |m|,   times sqrt(2) for m > 0

Symbols as in sh.py: orthonormal, without the Condon-Shortley phase, at l (l + 1) + m. On the unit sphere only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import Legendre

Term = tuple[float, int, int, int]  # c, and the powers of x, y, z


def monomials(order: int) -> list[list[Term]]:
    """The terms of each of the (order + 1)^2 harmonics. Source: the definition above, expanded; exact but for rounding.

    Domain: orders up to about 10; terms of high orders cancel each other.
    """
    return [_terms(l, m) for l in range(order + 1) for m in range(-l, l + 1)]  # noqa: E741


def _terms(l: int, m: int) -> list[Term]:  # noqa: E741
    a = abs(m)
    scale = (2 * l + 1) / (4 * math.pi) * math.factorial(l - a) / math.factorial(l + a) * (2 if a else 1)
    legendre = Legendre.basis(l).convert(kind=Polynomial)
    along = math.sqrt(scale) * np.asarray((legendre.deriv(a) if a else legendre).coef, np.float64)
    across = [(_turn(k, sine=m < 0) * math.comb(a, k), a - k, k) for k in range(a + 1)]
    return [(float(c * p), i, j, k) for c, i, j in across for k, p in enumerate(along.tolist()) if c and abs(p) > 1e-12]


def _turn(power: int, *, sine: bool) -> int:
    """Imaginary (sine) or real part of i to a power."""
    return ((0, 1, 0, -1) if sine else (1, 0, -1, 0))[power % 4]
