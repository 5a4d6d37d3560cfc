"""The whole model as one module, its file, and the fitted face in plain arrays.

File: npz with `spec` (JSON, utf-8 bytes) and one array a parameter or buffer, by its name in the module.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.errors import StageError
from pipeline.fields import build
from pipeline.fields.appearance import TYPICAL_INV_KAPPA, IntegratedBasis, SpatialField
from pipeline.fields.calibration import Calibration
from pipeline.fields.displaced import DisplacedSdf
from pipeline.fields.geometry import GridSdf
from pipeline.fields.light import ShLight
from pipeline.fields.protocol import F32, Material
from pipeline.fields.shadowing import Shadowing, Surface, near_surface, solve
from pipeline.fields.spec import FaceSpec
from pipeline.maths import brdf, split_sum
from pipeline.maths.sdf import unit

FORMAT = 1
CHUNK = 131_072
DIELECTRIC = 0.04  # F0 of what is no metal


@dataclass(frozen=True, slots=True)
class Shaded:
    """Radiance at N surface points: total = diffuse + specular [NeuFace eq. 4], (N, 3) each, linear, before the
    calibration."""

    total: Tensor
    diffuse: Tensor
    specular: Tensor
    albedo: Tensor
    inv_kappa: Tensor


class FaceModel(nn.Module):
    """Geometry, appearance, light and calibration of one capture. `beta` is the Laplace density's width.

    `shade` is the rendering equation [NeuFace eq. 1] in closed form; shadows and bounces only where `shadowing` is on.
    """

    beta: Tensor

    def __init__(
        self, spec: FaceSpec, values: Tensor, lo: Tensor, cell: float, geometry: DisplacedSdf | None = None
    ) -> None:
        super().__init__()
        self.spec = spec
        # DisplacedSdf answers what is asked after the fit; what a grid alone can do is asked by the grid's own trainer
        self.geometry = GridSdf(values, lo, cell) if geometry is None else cast(GridSdf, geometry)
        self.spatial = cast(SpatialField, build.spatial(spec))
        self.basis = cast(IntegratedBasis, build.material_integral(spec))
        self.light = cast(ShLight, build.light(spec))
        self.calibration = Calibration(spec.views)
        self.shadowing = Shadowing(spec.lo, spec.hi) if spec.shadows else None
        self.even = False  # one albedo for all, while the light is found
        self.register_buffer("beta", torch.tensor(cell))

    def shade(self, x: Tensor, n: Tensor, wo: Tensor) -> Shaded:
        """Outgoing radiance at x (N, 3) with unit n, wo: [NeuFace eq. 16] + [NeuFace eq. 12]."""
        albedo, rho, c, inv_kappa = self.spatial(x)
        if self.even:
            albedo = albedo.detach().median(0).values.expand_as(albedo)
        if self.spec.shading == "disney" and self.spec.specular:
            return self._disney(x, n, wo, albedo, rho, inv_kappa)
        diffuse = self._diffuse(albedo, x, n)
        if not self.spec.specular:
            return Shaded(diffuse, diffuse, torch.zeros_like(diffuse), albedo, inv_kappa)
        incident = self.light.reflected(brdf.reflect(wo, n), inv_kappa, self.spec.attenuation)
        bound = torch.ones_like(rho) if self.spec.shading == "phong" else self.basis.integral(x, c, wo, n)
        specular = brdf.specular(rho, bound, incident)
        return Shaded(diffuse + specular, diffuse, specular, albedo, inv_kappa)

    def _diffuse(self, albedo: Tensor, x: Tensor, n: Tensor) -> Tensor:
        """L_d under what arrives of the light, (N, 3)."""
        open_light = brdf.lambertian(albedo, self.light.irradiance(n))
        return open_light if self.shadowing is None else open_light * self.shadowing(x)

    def _disney(self, x: Tensor, n: Tensor, wo: Tensor, albedo: Tensor, metallic: Tensor, inv_kappa: Tensor) -> Shaded:
        """Split-sum GGX with a metallic parameter, which rho's output stands for. [NeuFace section 5.2]"""
        m, alpha = metallic[:, None], split_sum.alpha_from_inv_kappa(inv_kappa)
        base = albedo * (1 - m)
        diffuse = self._diffuse(base, x, n)
        f0 = DIELECTRIC * (1 - m) + albedo * m
        width = alpha if self.spec.light == "cubemap" else inv_kappa
        incident = self.light.reflected(brdf.reflect(wo, n), width, self.spec.attenuation)
        specular = split_sum.environment_brdf(f0, (n * wo).sum(-1), alpha) * incident
        return Shaded(diffuse + specular, diffuse, specular, base, inv_kappa)

    def solve_shadows(self) -> None:
        """Bring the shadows up to date with the surface, the albedo and the light found so far."""
        if self.shadowing is not None:
            index, x, n = near_surface(self.shadowing, self.geometry)
            with torch.no_grad():
                albedo = torch.cat([self.spatial(part)[0] for part in x.split(CHUNK)])
            solve(self.shadowing, self.geometry, Surface(index, x, n, albedo), self.light())

    def save(self, path: Path) -> None:
        """Write the file that `load_model` reads."""
        spec = {"format": FORMAT, "cell": self.geometry.cell, **asdict(self.spec)}
        arrays = {k: v.detach().cpu().numpy() for k, v in self.state_dict().items()}
        np.savez(path, spec=np.frombuffer(json.dumps(spec).encode(), np.uint8), **arrays)


def load_model(path: Path, device: str = "cpu") -> FaceModel:
    """Rebuild a model from its file. Raises StageError if the file is of another format or a shape is wrong."""
    with np.load(path, allow_pickle=False) as file:
        spec: dict[str, Any] = json.loads(bytes(file["spec"]).decode())
        arrays = {k: torch.from_numpy(file[k]) for k in file.files if k != "spec"}
    if spec.pop("format", None) != FORMAT:
        raise StageError(
            "the fitted field is of another format",
            where=path.name,
            value=spec.get("format"),
            limit=f"format {FORMAT}",
            remedy="run the fit again with this version",
        )
    cell = float(spec.pop("cell"))
    for k in ("lo", "hi", "albedo_start", "prior_centre"):
        if k in spec:
            spec[k] = tuple(spec[k])
    model = _unfilled(FaceSpec(**spec), arrays, cell)
    model.load_state_dict(arrays)
    return model.to(device)


def _unfilled(spec: FaceSpec, arrays: dict[str, Tensor], cell: float) -> FaceModel:
    """The modules whose parameters are in `arrays`."""
    if spec.geometry == "grid":
        return FaceModel(spec, arrays["geometry.values"], arrays["geometry.lo"], cell)
    none = torch.zeros(0)
    return FaceModel(spec, none, none, cell, build.stored_displaced(spec, arrays))


class FittedField:
    """`pipeline.fields.protocol.Field` over a FaceModel."""

    def __init__(self, model: FaceModel) -> None:
        self.model = model.eval()
        self.device = model.beta.device

    @property
    def bounds(self) -> tuple[F32, F32]:
        """Box in which the SDF is defined."""
        lo, hi = self.model.geometry.box()
        return lo.cpu().numpy(), hi.cpu().numpy()

    @property
    def cell(self) -> float:
        """Edge of the finest SDF cell."""
        return self.model.geometry.cell

    @property
    def rank(self) -> int:
        """Number of specular bases."""
        return 1 if self.model.spec.shading == "phong" else self.model.spec.rank

    @property
    def light(self) -> F32:
        """((L + 1)^2, 3) coefficients."""
        return np.asarray(self.model.light().detach().cpu().numpy(), np.float32)

    def _map(self, function: Any, *arrays: F32) -> tuple[F32, ...]:
        out = []
        with torch.no_grad():
            for i in range(0, max(len(arrays[0]), 1), CHUNK):
                part = function(
                    *(
                        torch.from_numpy(np.ascontiguousarray(a[i : i + CHUNK], np.float32)).to(self.device)
                        for a in arrays
                    )
                )
                out.append([p.cpu().numpy() for p in part])
        return tuple(np.concatenate(p) for p in zip(*out, strict=True))

    def sdf_and_gradient(self, points: F32) -> tuple[F32, F32]:
        """(N,) and (N, 3)."""
        s, g = self._map(self.model.geometry, points)
        return s, g

    def sdf(self, points: F32) -> F32:
        """(N,)."""
        return self.sdf_and_gradient(points)[0]

    def material(self, points: F32) -> Material:
        """Appearance at points. Without a lobe its strength is 0 and its shape, which nothing was fitted to, the usual
        one: a map of chance values would come to light as soon as somebody adds a gloss."""
        albedo, rho, c, inv_kappa = self._map(self.model.spatial, points)
        if not self.model.spec.specular:
            rho, c, inv_kappa = np.zeros_like(rho), np.ones_like(c), np.full_like(inv_kappa, TYPICAL_INV_KAPPA)
        if self.model.spec.shading == "phong":
            c = np.ones((len(rho), 1), np.float32)
        return Material(albedo, rho, c, inv_kappa)

    def irradiance_ratio(self, points: F32) -> F32:
        """(N, 3)."""
        shadowing = self.model.shadowing
        if shadowing is None:
            return np.ones((len(points), 3), np.float32)
        (s,) = self._map(lambda p: (shadowing(p),), points)
        return s

    def basis(self, wo: F32, normal: F32) -> F32:
        """(N, k). Raises StageError for a model without bases."""
        if self.model.spec.integral != "low_rank" or self.model.spec.shading == "disney":
            raise StageError(
                "this model has no specular bases to bake",
                where="inverse_rendering.shading, inverse_rendering.integral",
                value=f"{self.model.spec.shading}, {self.model.spec.integral}",
                limit="shading neural or phong, and integral low_rank",
                remedy="such models are for comparisons (neuface bench ablations); fit one with bases for an asset",
            )
        if self.model.spec.shading == "phong":
            return np.ones((len(wo), 1), np.float32)
        (b,) = self._map(lambda w, n: (self.model.basis(w, n),), wo, normal)
        return b

    def normals(self, points: F32) -> F32:
        """(N, 3) unit, outward."""
        (n,) = self._map(lambda p: (unit(self.model.geometry(p)[1]),), points)
        return n


def load_face(path: Path, device: str = "cpu") -> FittedField:
    """The fitted face in a file, as plain arrays."""
    return FittedField(load_model(path, device))
