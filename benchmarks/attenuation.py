"""Both attenuations of the light integral: error against quadrature, and cost.

    python benchmarks/attenuation.py

Error: the largest difference from the mean of Legendre polynomials under the lobe, by Gauss quadrature, over bands up
to order 10. Cost: forward and backward of 200,000 lobes, best of five, one thread.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from numpy.polynomial.legendre import leggauss, legvander

from pipeline.maths.vmf import ATTENUATIONS

ORDER, LOBES = 10, 200_000


def by_quadrature(kappa: float) -> np.ndarray:
    """E[P_l] for l = 0..ORDER."""
    z, w = leggauss(2000)
    density = w * np.exp(kappa * (z - 1))
    return np.asarray(legvander(z, ORDER).T @ (density / density.sum()))


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    print("kappa     " + "  ".join(f"{k:>12}" for k in ("exponential", "exact")))
    for kappa in (0.1, 0.5, 1.55, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0):
        s, true = torch.tensor([1 / kappa]), by_quadrature(kappa)
        errors = [np.abs(ATTENUATIONS[k](s, ORDER)[0].numpy() - true).max() for k in ("exponential", "exact")]
        print(f"{kappa:<9g} " + "  ".join(f"{e:12.2e}" for e in errors))
    for kind in ("exponential", "exact"):
        best = 1e9
        for _ in range(5):
            s = torch.rand(LOBES).mul_(0.3).requires_grad_()
            start = time.perf_counter()
            ATTENUATIONS[kind](s, ORDER).sum().backward()
            best = min(best, time.perf_counter() - start)
        print(f"{kind}: {1e9 * best / LOBES:.0f} ns a lobe, forward and backward")


if __name__ == "__main__":
    main()
