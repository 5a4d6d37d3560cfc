"""A field as standard shaders show it: the material of layer.py, with traced shadows and no more.

    y = V n.l ((1 - R) b / pi + D G / (4 n.l n.v) (F0 (1 - c) + c)),   c = (1 - v.h)^5

Symbols as in layer_kernels.py. Light by way of other skin, which a path tracer adds, is left out: it scores less
than such a renderer.
"""

from __future__ import annotations

import numpy as np

from pipeline.images import F32
from pipeline.meshes import unit
from pipeline.transforms import F64
from stages.reflectance.field import Field, Lamp
from stages.reflectance.texels import arriving

NAME = "openpbr"  # of the map: base colour, F0, roughness
FLATTEST = 0.05  # least n.v and n.l of the reflection, as in lobe_kernels.py


class OpenPbr(Field):
    """The field with another radiance, and shadows that the whole mesh throws."""

    @classmethod
    def of(cls, field: Field) -> OpenPbr:
        """The same texels; the field has the map NAME."""
        return cls(field.mesh, field.charts, field.points, field.arrays, field.alphas, field.towards, field.centre)

    def arrives(self, lamp: Lamp, rays: int = 3) -> F32:
        """(T,) share of a lamp's light that arrives, as traced."""
        target = lamp.position / np.linalg.norm(lamp.position) if lamp.distant else lamp.position
        return arriving(self.points, self.whole, target, None if lamp.distant else lamp.axis, rays)

    def radiance(self, lamp: Lamp, eye: F64, arrives: F32, *, rest: bool = True) -> F32:
        """(T, 3) radiance towards an eye (3,). rest: means nothing here."""
        from pipeline.lighting.standard import layer

        values = self.arrays[NAME].astype(np.float64)
        away = lamp.position - self.points.position
        squared = (away**2).sum(1)
        light, view = away / np.sqrt(squared)[:, None], unit(eye - self.points.position)
        falls = np.maximum(-(light @ lamp.axis), 0) / squared
        nl, nv = (self.normal * light).sum(1), (self.normal * view).sum(1)
        half = unit(light + view)
        nh, vh = (self.normal * half).sum(1), (view * half).sum(1)
        base, f0, alpha = values[:, :3], values[:, 3], np.maximum(values[:, 4], 0.1) ** 2
        shine = reflection(f0, alpha, np.maximum(nl, FLATTEST), np.maximum(nv, FLATTEST), nh, vh)
        matt = (1 - layer(np.maximum(nv, FLATTEST), f0, alpha))[:, None] * base / np.pi
        y = (arrives * np.maximum(nl, 0))[:, None] * (matt + shine[:, None])
        return np.asarray(y * falls[:, None] * lamp.strength, np.float32)


def reflection(f0: F64, alpha: F64, nl: F64, nv: F64, nh: F64, vh: F64) -> F64:
    """(T,) D G / (4 n.l n.v) F: GGX with Smith's height-correlated shadowing and Schlick's Fresnel factor."""
    a2 = alpha**2
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    g = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    c = (1 - vh) ** 5
    return np.asarray(d * g * np.where(f0 > 0, f0 * (1 - c) + c, 0.0), np.float64)
