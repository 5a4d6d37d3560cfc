"""docs/field_look.md: the reference on the page gives the numbers of the code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipeline.maths.sh_monomials import monomials
from stages.reflectance.field import KERNEL, UNKNOWN, Lamp
from stages.reflectance.texels import arriving
from tests.reflectance.test_field import field_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "field_look.md"


def test_the_pages_reference_is_the_code() -> None:
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)[0], names)  # noqa: S102
    rng = np.random.default_rng(0)
    field = field_of(np.array([0.5, 0.4, 0.3]), 0.02, order=3)
    count = len(field.points.texel)
    for name, low, high in (("rest", -0.01, 0.02), ("shadow", -0.5, 0.5), ("trust", 0, 1)):
        field.arrays[name][:] = rng.uniform(low, high, field.arrays[name].shape)
    eye, lamp = np.array([0.2, 0.1, 1.0]), np.array([0.5, 0.6, 0.9])
    axis, strength = -lamp / np.linalg.norm(lamp), np.array([4.0, 3.0, 2.0])
    made = Lamp(lamp, axis, strength)
    found = field.radiance(made, eye, field.arrives(made))
    traced = arriving(field.points, field.blocker, lamp, axis)
    basis = {
        "centre": [0, 0, 0],
        "towards": field.towards,
        "kernel_degrees": KERNEL,
        "unknown": UNKNOWN,
        "alphas": field.alphas,
        "lobe": {"fresnel_rise": 24, "least_n_dot_l": 0.02, "least_n_dot_v": 0.05},
        "harmonics": monomials(3),
    }
    for t in rng.permutation(count)[:60]:
        texel = {n: field.arrays[n][t].astype(float) for n in ("albedo", "lobes", "normal", "rest", "shadow", "trust")}
        said = names["radiance"](field.points.position[t], texel, basis, lamp, axis, strength, eye, traced[t])
        np.testing.assert_allclose(found[t], said, rtol=1e-5, atol=1e-6)
