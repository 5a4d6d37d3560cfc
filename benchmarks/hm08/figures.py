"""What the template is worth in numbers, for its manifest and docs/template.md."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.hm08.cut import Cut
from benchmarks.hm08.flatten import stretch
from benchmarks.hm08.identity import SEED, Identity, sampled_weights
from benchmarks.hm08.layout import FACE, texture_areas
from benchmarks.hm08.regions import NAMES
from benchmarks.hm08.write import METRES, stored_identity
from pipeline.meshes import F64, Indices
from pipeline.template.checks import completed

PERSONS, OTHER_SEED = 500, SEED + 1  # persons that the basis was not made from


def stored_basis(identity: Identity, cut: Cut) -> F64:
    """(K, V, 3) the basis as it is read back."""
    s = stored_identity(identity, cut)
    basis = s["identity_basis"].astype(np.float64) * s["identity_scale"][:, None, None]
    return completed(basis, s["identity_vertices"].astype(np.int64), cut.mirror, identity.symmetric)


def identity_error(mean: F64, basis: F64, base: F64, offsets: F64, names: list[str], seed: int) -> F64:
    """(PERSONS, V) millimetres by which the basis misses persons that it was not made from. base, mean (V, 3),
    basis (K, V, 3) in decimetres; offsets (T, V, 3)."""
    weights = sampled_weights(names, PERSONS, seed)
    persons = base + np.tensordot(weights, offsets, 1) - mean
    flat = basis.reshape(len(basis), -1)
    rest = persons.reshape(PERSONS, -1)
    rest = rest - (rest @ flat.T) @ flat
    return np.asarray(np.linalg.norm(rest.reshape(persons.shape), axis=2) * METRES * 1e3, np.float64)


def summary(error: F64) -> dict[str, float]:
    """Of `identity_error`."""
    return {
        "rms": round(float(np.sqrt((error**2).mean())), 3),
        "p95": round(float(np.percentile(error, 95)), 3),
        "max": round(float(error.max()), 2),
    }


def layout_figures(mean: F64, cut: Cut, label: Indices, uv: F64) -> dict[str, Any]:
    """Area shares of the regions on their tile, and L2 stretch (1: none)."""
    region = np.array(NAMES)[label]
    area = texture_areas(uv)
    amount, _ = stretch(mean[cut.quads], cut.quads, uv)
    out: dict[str, Any] = {
        "face_share": round(float(area[np.isin(region, FACE)].sum()), 4),
        "smallest_area": float(area.min()),
    }
    for name in NAMES:
        own = region == name
        out[name] = {
            "share": round(float(area[own].sum()), 4),
            "stretch": round(float(np.average(amount[own], weights=area[own])), 3),
            "stretch_p95": round(float(np.percentile(amount[own], 95)), 3),
            "stretch_max": round(float(amount[own].max()), 3),
        }
    return out
