"""The reflectance field: its maps on disk, and the radiance of its texels under a lamp.

    albedo.exr     R G B           a
    lobes.exr      c0 c1 c2        s_j, weights of the global lobes
    normal.exr     c0 c1 c2        unit normal, asset coordinates
    rest.exr       c00 c01 ...     r_k, three colours of each of K harmonics
    openpbr.exr    c0 ... c4       base colour, F0 and roughness of standard shaders (layer.py)
    shadow.exr     c00 c01 ...     V less what is traced, for each light of the stage
    trust.exr      c00 c01 ...     how far that is known, 0 to 1
    coverage.exr   Y               1 where a camera saw the texel, 0 where it was filled
    mesh.npz       the mesh with its charts (the maps' surface, and what throws shadows)
    basis.json     lights, widths of the lobes, order of the harmonics, kernel of the shadows, corneas

sidecar.py writes more files, for shaders elsewhere; docs/field_look.md says how to evaluate the field.
"""

from __future__ import annotations

import json
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.errors import StageError
from pipeline.eyes.mirror import BESIDE, Cornea, from_stored, stored
from pipeline.images import F32, read_exr, write_exr
from pipeline.nearest import nearest_known
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64
from stages.reflectance.split import harmonics
from stages.reflectance.texels import Points, arriving, known_surface, points_of

BASIS, MESH = "basis.json", "mesh.npz"
KERNEL = 18.0  # degrees: width of the kernel that carries shadows from the stage's lights to others
UNKNOWN = 0.02  # weight of "as traced" in it
FAR = 1e4  # asset units: distance of a distant lamp


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp in asset coordinates. position (3,); axis (3,) unit, along which it shines; strength (3,) radiant
    intensity. distant: position is only a direction, and shadows are traced along it. spread: standard deviation of
    directions towards it, radians, if it stands for a part of an environment; only its glints are as wide."""

    position: F64
    axis: F64
    strength: F64
    distant: bool = False
    spread: float = 0.0


def distant_lamp(towards: F64, irradiance: F64, spread: float = 0.0) -> Lamp:
    """A lamp at infinity: unit direction (3,) towards it, irradiance (3,) on a surface that faces it."""
    return Lamp(FAR * towards, -towards, irradiance * FAR**2, distant=True, spread=spread)


class Field:
    """A reflectance field in memory. Arrays over the T covered texels as in `split.Fitted`; known (T,): seen by a
    camera; towards (L, 3): directions of the stage's lights; centre (3,): of the stage. turn (T, 3, 3): rotation of the
    surface at each texel since the pictures were taken, None at rest (deform.py). corneas: of its eyes."""

    def __init__(
        self,
        mesh: meshes.Mesh,
        charts: meshes.Charts,
        points: Points,
        arrays: dict[str, npt.NDArray[Any]],
        alphas: tuple[float, ...],
        towards: F64,
        centre: F64,
    ) -> None:
        self.mesh, self.charts, self.points = mesh, charts, points
        self.arrays, self.alphas, self.towards, self.centre = arrays, alphas, towards, centre
        self.albedo = arrays["albedo"].astype(np.float64)
        self.lobes = arrays["lobes"].astype(np.float64)
        normal = arrays["normal"].astype(np.float64)
        self.normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        self.known = arrays["coverage"][:, 0] > 0.5
        self.turn: F64 | None = None
        self.corneas: tuple[Cornea, ...] = ()
        self.order = int(np.sqrt(arrays["rest"].shape[1] // 3)) - 1
        self.whole = RayCaster(mesh.vertices, mesh.faces)
        self.blocker = RayCaster(mesh.vertices, known_surface(mesh, points, self.known))

    @cached_property
    def nearest(self) -> npt.NDArray[np.int64]:
        """(size^2,) the covered texel nearest to each texel: maps are padded with it."""
        size, texel = self.points.size, self.points.texel
        number = np.full(size * size, -1)
        number[texel] = np.arange(len(texel))
        return np.asarray(number[nearest_known((number >= 0).reshape(size, size)).ravel()], np.int64)

    def with_corneas(self, corneas: tuple[Cornea, ...]) -> Field:
        """The same field with these corneas."""
        out = copy(self)
        out.__dict__.pop("mirrors", None)
        out.corneas = corneas
        return out

    @cached_property
    def mirrors(self) -> list[tuple[Cornea, Field]]:
        """Each cornea, and the field of the texels beside it."""
        return [(c, self.beside(c.centre, c.radius)) for c in self.corneas]

    def beside(self, centre: F64, radius: float) -> Field:
        """The field of the texels in or just outside of a sphere around a centre (3,)."""
        away = np.linalg.norm(self.points.position - centre, axis=1)
        return self.part(np.flatnonzero(away < radius + BESIDE))

    def part(self, texels: npt.NDArray[np.int64]) -> Field:
        """The field of some of its texels, given by their place, lit as they are in the whole: shadows are those of the
        whole surface. Its texels alone can't be looked up in a picture."""
        out = copy(self)
        for name in ("nearest", "mirrors"):  # of the whole
            out.__dict__.pop(name, None)
        p = self.points
        out.points = replace(p, texel=p.texel[texels], face=p.face[texels], weights=p.weights[texels],
                             position=p.position[texels], normal=p.normal[texels])  # fmt: skip
        out.arrays = {name: values[texels] for name, values in self.arrays.items()}
        out.albedo, out.lobes = self.albedo[texels], self.lobes[texels]
        out.normal, out.known = self.normal[texels], self.known[texels]
        out.turn = None if self.turn is None else self.turn[texels]
        return out

    def arrives(self, lamp: Lamp, rays: int = 3) -> F32:
        """(T,) share of a lamp's light that arrives: traced, with the corrections of the lights around it."""
        target = lamp.position / np.linalg.norm(lamp.position) if lamp.distant else lamp.position
        traced = arriving(self.points, self.blocker, target, None if lamp.distant else lamp.axis, rays)
        near = np.exp((self._turned_back(lamp) @ self.towards.T - 1) / (1 - np.cos(np.radians(KERNEL))))
        trust = self.arrays["trust"].astype(np.float32) * near.astype(np.float32)
        change = (trust * self.arrays["shadow"].astype(np.float32)).sum(1) / (trust.sum(1) + UNKNOWN)
        share = np.clip(traced + change, 0, 1)
        return np.asarray(share * share * (3 - 2 * share), np.float32)  # a shadow has an edge: half light is rare

    def _direction(self, lamp: Lamp) -> F64:
        towards = lamp.position if lamp.distant else lamp.position - self.centre
        return np.asarray(towards / max(float(np.linalg.norm(towards)), 1e-12), np.float64)

    def _turned_back(self, lamp: Lamp) -> F64:
        """(T, 3) or (1, 3) direction towards a lamp as each texel would have seen it at rest."""
        towards = self._direction(lamp)
        return (
            towards[None] if self.turn is None else np.asarray(np.einsum("tji,j->ti", self.turn, towards), np.float64)
        )

    def radiance(self, lamp: Lamp, eye: F64, arrives: F32, *, rest: bool = True) -> F32:
        """(T, 3) radiance towards an eye (3,) under one lamp. arrives (T,): see `arrives`. rest: with the light that
        came by way of other skin."""
        from stages.reflectance.shade_kernels import shade

        terms = self.arrays["rest"].reshape(len(self.known), -1, 3)
        basis = np.broadcast_to(harmonics(self._turned_back(lamp), self.order), terms.shape[:2])
        extra = np.einsum("tkc,tk->tc", terms.astype(np.float64), basis) if rest else np.zeros_like(self.albedo)
        out = np.empty((len(self.known), 3))
        shade(self.points.position, self.normal, lamp.position, lamp.axis, lamp.strength, eye, np.array(self.alphas),
              self.albedo, self.lobes, arrives.astype(np.float64), extra, out)  # fmt: skip
        return out.astype(np.float32)

    @property
    def f0(self) -> F64:
        """(T,) sum of the two wider lobes: what a shader of one lobe has."""
        return np.asarray(self.lobes[:, :2].sum(1), np.float64)

    @property
    def roughness(self) -> F64:
        """(T,) roughness (square root of alpha) of those two, the mean by their weights; where there is no reflection,
        that of the widest."""
        rough = np.sqrt(np.array(self.alphas[:2]))
        total = self.lobes[:, :2].sum(1)
        mean = (self.lobes[:, :2] * rough).sum(1) / np.maximum(total, 1e-9)
        return np.asarray(np.where(total > 1e-6, mean, rough[0]), np.float64)


def save(field: Field, folder: Path, basis: dict[str, Any]) -> list[str]:
    """Write a field. basis: more entries of basis.json. Returns the files' names."""
    folder.mkdir(parents=True, exist_ok=True)
    near = field.nearest
    channels_of = dict(basis.get("channels", {}))
    for name, values in field.arrays.items():
        channels = values.shape[1]
        names = None if channels in (1, 3) and name in ("albedo", "coverage") else _names(channels)
        channels_of[name] = list(names or ("RGB" if channels == 3 else "Y"))
        picture = values.astype(np.float32)[near].reshape(field.points.size, field.points.size, channels)
        write_exr(folder / f"{name}.exr", picture, names, half=True)
    meshes.save(folder / MESH, field.mesh, field.charts)
    content = {
        "size": field.points.size, "alphas": list(field.alphas), "harmonics_order": field.order,
        "kernel_degrees": KERNEL, "unknown": UNKNOWN,
        "centre": field.centre.tolist(), "towards": field.towards.tolist(),
        "corneas": stored(field.corneas), **basis,
        "channels": channels_of,
    }  # fmt: skip
    (folder / BASIS).write_text(json.dumps(content, indent=1) + "\n")
    return [f"{n}.exr" for n in field.arrays] + [MESH, BASIS]


def _names(channels: int) -> tuple[str, ...]:
    digits = len(str(channels - 1))
    return tuple(f"c{i:0{digits}d}" for i in range(channels))


def load(folder: Path) -> Field:
    """A field written by `save`. Raises StageError if a file is missing or damaged."""
    try:
        basis = json.loads((folder / BASIS).read_text())
        mesh, charts = meshes.load(folder / MESH), meshes.load_charts(folder / MESH)
        size = int(basis["size"])
        points = points_of(mesh, charts, size)
        arrays = {}
        optional = ["openpbr"] if (folder / "openpbr.exr").is_file() else []  # not in fields of older versions
        for name in ("albedo", "lobes", "normal", "rest", "shadow", "trust", "coverage", *optional):
            picture, _ = read_exr(folder / f"{name}.exr")
            arrays[name] = picture.reshape(size * size, -1)[points.texel]
        towards, centre = np.array(basis["towards"], np.float64), np.array(basis["centre"], np.float64)
        field = Field(mesh, charts, points, arrays, tuple(basis["alphas"]), towards, centre)
        return field.with_corneas(from_stored(basis.get("corneas", ())))  # not in fields of older versions
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as e:
        raise StageError(
            "the reflectance field can't be read",
            where=folder,
            value=f"{type(e).__name__}: {e}",
            limit="the files that the stage reflectance wrote",
            remedy="run neuface run again; the field is made from captures of a light stage only",
        ) from e


def centre_of(position: F64, axis: F64) -> F64:
    """(3,) the point nearest to the lines along which lamps (L, 3) shine; the lamps' mean where these are parallel."""
    across = np.eye(3)[None] - axis[:, :, None] * axis[:, None, :]
    system = across.sum(0)
    if np.linalg.cond(system) > 1e9:
        return np.asarray(position.mean(0), np.float64)
    return np.asarray(np.linalg.solve(system, np.einsum("lij,lj->i", across, position)), np.float64)
