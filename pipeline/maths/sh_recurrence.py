"""Factors of the associated Legendre recurrence, shared by pipeline.maths.sh and its compiled forms."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

F32 = npt.NDArray[np.float32]


@lru_cache(maxsize=32)
def recurrence(order: int) -> tuple[list[float], list[Tensor], list[Tensor]]:
    """Q_m^m, and a_lm, b_lm of the recurrence, from the normalisation K_lm = sqrt((2l+1)(l-m)! / (4 pi (l+m)!))."""
    start = [math.sqrt(1 / (4 * math.pi))]
    for m in range(1, order + 1):
        start.append(start[-1] * math.sqrt((2 * m + 1) / (2 * m)))
    a, b = [], []
    for l in range(order + 1):  # noqa: E741
        ms = range(l)
        a.append(torch.tensor([math.sqrt((4 * l * l - 1) / (l * l - m * m)) for m in ms], dtype=torch.float64))
        b.append(
            torch.tensor(
                [
                    math.sqrt((2 * l + 1) * (l + m - 1) * (l - m - 1) / ((2 * l - 3) * (l * l - m * m)))
                    if l > 1
                    else 0.0
                    for m in ms
                ],
                dtype=torch.float64,
            )
        )
    return start, a, b


@lru_cache(maxsize=16)
def tables(order: int) -> tuple[F32, F32, F32]:
    """Start values Q_m^m (with the sqrt(2) of m > 0) and recurrence factors a[l, m], b[l, m], rounded once."""
    start, a, b = recurrence(order)
    q = np.array(start) * np.where(np.arange(order + 1) > 0, np.sqrt(2), 1.0)
    aa, bb = np.zeros((order + 1, order + 1), np.float32), np.zeros((order + 1, order + 1), np.float32)
    for l in range(1, order + 1):  # noqa: E741
        aa[l, :l], bb[l, :l] = a[l].numpy(), b[l].numpy()
    return q.astype(np.float32), aa, bb
