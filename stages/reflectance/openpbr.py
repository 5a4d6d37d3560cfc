"""A field as a path tracer shows its standard material: that of layer.py, traced shadows, diffuse bounces.

    y = V n.l ((1 - R) b / pi + D G / (4 n.l n.v) (F0 (1 - c) + c)) + (1 - R) b / pi E / e,   c = (1 - v.h)^5

Symbols as in layer_kernels.py; E what arrives by way of other skin (bounces.py), e what falls on a facing surface.
Shadows are those of the whole mesh, as a renderer has them.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from pipeline.images import F32
from pipeline.meshes import unit
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64
from stages.reflectance.bounces import Bounces
from stages.reflectance.field import Field, Lamp
from stages.reflectance.texels import Points, arriving

NAME = "openpbr"  # of the map: base colour, F0, roughness
FLATTEST = 0.05  # least n.v and n.l of the reflection, as in lobe_kernels.py


class OpenPbr(Field):
    """The field with another radiance, and shadows that the whole mesh throws."""

    shadows: RayCaster

    @classmethod
    def of(cls, field: Field, *, trimmed: bool = False) -> OpenPbr:
        """The same texels; the field has the map NAME. trimmed: only surface that a camera saw throws shadows, as of an
        asset with `surface.unseen=trimmed`."""
        out = cls(field.mesh, field.charts, field.points, field.arrays, field.alphas, field.towards, field.centre)
        out.shadows = out.blocker if trimmed else out.whole
        return out

    @cached_property
    def bounces(self) -> Bounces:
        """Between the mesh's vertices; albedo: the mean of the texels' base colour around each."""
        p, count = self.points, len(self.mesh.vertices)
        corner, weight = self.mesh.faces[p.face], np.maximum(p.weights, 0)
        base = self.arrays[NAME][:, :3].astype(np.float64)
        below = np.bincount(corner.ravel(), weight.ravel(), count)
        total = [np.bincount(corner.ravel(), (weight * base[:, i : i + 1]).ravel(), count) for i in range(3)]
        albedo = np.where(below[:, None] > 0, np.stack(total, 1) / np.maximum(below, 1e-12)[:, None], base.mean(0))
        return Bounces(self.mesh, self.whole, albedo)

    def indirect(self, lamp: Lamp) -> F64:
        """(T, 3) irradiance by way of other skin."""
        key = (lamp.position.tobytes(), lamp.strength.tobytes())
        if key not in self._indirect:
            v = self.bounces.points
            light, falls = _falling(lamp, v.position)
            direct = _traced(v, self.shadows, lamp, 1) * np.maximum((v.normal * light).sum(1), 0) * falls
            found = self.bounces.of(direct[:, None] * lamp.strength)
            between = (found[self.mesh.faces[self.points.face]] * self.points.weights[..., None]).sum(1)
            self._indirect = {key: between}
        return self._indirect[key]

    @cached_property
    def _indirect(self) -> dict[tuple[bytes, bytes], F64]:
        return {}

    def arrives(self, lamp: Lamp, rays: int = 3) -> F32:
        """(T,) share of a lamp's light that arrives, as traced."""
        return _traced(self.points, self.shadows, lamp, rays)

    def radiance(self, lamp: Lamp, eye: F64, arrives: F32, *, rest: bool = True) -> F32:
        """(T, 3) radiance towards an eye (3,). rest: with the light that came by way of other skin."""
        from pipeline.lighting.standard import layer

        values = self.arrays[NAME].astype(np.float64)
        light, falls = _falling(lamp, self.points.position)
        view = unit(eye - self.points.position)
        nl, nv = (self.normal * light).sum(1), (self.normal * view).sum(1)
        half = unit(light + view)
        nh, vh = (self.normal * half).sum(1), (view * half).sum(1)
        base, f0, alpha = values[:, :3], values[:, 3], np.maximum(values[:, 4], 0.1) ** 2
        shine = reflection(f0, alpha, np.maximum(nl, FLATTEST), np.maximum(nv, FLATTEST), nh, vh)
        matt = (1 - layer(np.maximum(nv, FLATTEST), f0, alpha))[:, None] * base / np.pi
        y = (arrives * np.maximum(nl, 0))[:, None] * (matt + shine[:, None])
        more = matt * self.indirect(lamp) if rest else 0.0
        return np.asarray(y * falls[:, None] * lamp.strength + more, np.float32)


def _falling(lamp: Lamp, position: F64) -> tuple[F64, F64]:
    """(N, 3) unit directions from points to a lamp, and (N,) what falls on a facing surface, over its strength."""
    away = lamp.position - position
    squared = (away**2).sum(1)
    light = away / np.sqrt(squared)[:, None]
    return light, np.maximum(-(light @ lamp.axis), 0) / squared


def _traced(points: Points, caster: RayCaster, lamp: Lamp, rays: int) -> F32:
    target = lamp.position / np.linalg.norm(lamp.position) if lamp.distant else lamp.position
    return arriving(points, caster, target, None if lamp.distant else lamp.axis, rays)


def reflection(f0: F64, alpha: F64, nl: F64, nv: F64, nh: F64, vh: F64) -> F64:
    """(T,) D G / (4 n.l n.v) F: GGX with Smith's height-correlated shadowing and Schlick's Fresnel factor."""
    a2 = alpha**2
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    g = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    c = (1 - vh) ** 5
    return np.asarray(d * g * np.where(f0 > 0, f0 * (1 - c) + c, 0.0), np.float64)
