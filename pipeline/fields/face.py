"""The whole model as one module, its file, and the fitted face as plain arrays.

File: npz with `spec` (JSON, utf-8 bytes) and one array per parameter or buffer, by its name in the module.
"""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.errors import StageError
from pipeline.fields import build
from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.fields.calibration import Calibration
from pipeline.fields.light import ShLight
from pipeline.fields.parts import Geometry, Light, Shaded, Skin
from pipeline.fields.protocol import F32, Material
from pipeline.fields.second_light import SecondLight, chosen
from pipeline.fields.shadowing import Shadowing, Surface, near_surface, solve
from pipeline.fields.spec import FaceSpec
from pipeline.lighting.moving import MovingLight
from pipeline.maths import brdf
from pipeline.maths.light_frame import WORLD, Stations, Turn, turn_of
from pipeline.maths.sdf import unit

FORMAT = 1
AMBIENT_ORDER, AMBIENT_SHARE = 3, 0.05  # of the still light beside a moving one; of its strength, at the start
CHUNK = 131_072


class FaceModel(nn.Module):
    """Geometry, appearance, light and calibration of one capture. `beta` is the width of the Laplace density. `level`:
    asset units, where the surface is for the stages after the fit (stages.inverse_rendering.outline_level); pictures of
    the model do not depend on it.

    `shade` is the rendering equation [NeuFace eq. 1] in closed form; shadows and interreflections only if `shadowing`
    is on. The order in which the parts are constructed determines their random initialisation and the file.
    """

    beta: Tensor
    level: Tensor

    def __init__(self, spec: FaceSpec, geometry: Geometry) -> None:
        super().__init__()
        system = build.system_of(spec)
        self.spec = spec
        self.geometry = geometry
        self.spatial = system.spatial(spec)
        self.basis = system.integral(spec)
        self.light = system.light(spec)
        self.shading = system.shading(spec, self.basis, self.light)
        self.ambient: Light | None = None  # the still part of a light that moves with the camera
        if spec.light_frame != WORLD:
            self.ambient = ShLight(AMBIENT_ORDER, AMBIENT_SHARE * spec.light_start)
            self.ambient_shading = system.shading(spec, self.basis, self.ambient)
        self.rendering = system.rendering(spec)
        self.calibration = Calibration(spec.views, spec.second_views, (spec.calibrated, spec.second_calibrated))
        self.shadowing = Shadowing(spec.lo, spec.hi) if spec.shadows else None
        self.second: SecondLight | None = None  # of a second capture of the subject
        if spec.second_views:
            self.second = SecondLight(spec, system, self.basis)
        self.uniform_albedo = False  # one albedo for all points, while the light is estimated
        self.register_buffer("beta", torch.tensor(geometry.cell))
        self.register_buffer("level", torch.tensor(0.0))

    def shade(self, x: Tensor, n: Tensor, wo: Tensor, stations: Stations | None = None) -> Shaded:
        """Outgoing radiance at x (N, 3) with unit n, wo: [NeuFace eq. 16] + [NeuFace eq. 12]. stations: the cameras,
        for a light that moves with them, or differs between two captures."""
        turn, second = None, None
        if self.second is not None and stations is not None:
            second = stations.second
        if self.spec.light_frame != WORLD:
            assert stations is not None, "a light that moves with the camera needs the cameras"
            turn = turn_of(self.spec.light_frame, stations, x, wo, self.spec.light_distance)
        albedo, rho, c, inv_kappa = self.spatial(x)
        if self.uniform_albedo:
            albedo = albedo.detach().median(0).values.expand_as(albedo)
        if not self.spec.specular:
            diffuse = self._diffuse(albedo, x, n, turn, second)
            return Shaded(diffuse, diffuse, torch.zeros_like(diffuse), albedo, inv_kappa, torch.zeros_like(rho))
        skin = Skin(albedo, rho, c, inv_kappa)
        base = self.shading.diffuse_albedo(skin)
        diffuse = self._diffuse(base, x, n, turn, second)
        specular = self._specular(skin, x, n, wo, turn, second)
        straight = torch.zeros_like(rho)
        if self.has_bases:  # B depends on n . wo only, which is 1 for all points
            straight = rho * (c * self.shading.bases(n[:1], n[:1])).sum(-1)
        return Shaded(diffuse + specular, diffuse, specular, base, inv_kappa, straight)

    @property
    def has_bases(self) -> bool:
        """Whether the specular term has bases of the angles only, so that it has an F0."""
        return (self.spec.shading, self.spec.integral, self.spec.basis_inputs) == ("neural", "low_rank", "cosine")

    def _diffuse(self, albedo: Tensor, x: Tensor, n: Tensor, turn: Turn | None, second: Tensor | None) -> Tensor:
        """L_d (N, 3), including shadows if they are modelled."""
        if turn is not None and self.ambient is not None:
            arriving = turn.strength * self.light.irradiance(turn(n)) + self.ambient.irradiance(n)
            return brdf.lambertian(albedo, arriving)
        open_light = brdf.lambertian(albedo, self.light.irradiance(n))
        out = open_light if self.shadowing is None else open_light * self.shadowing(x)
        if second is None or self.second is None:
            return out
        return chosen(second, out, self.second.diffuse(albedo, x, n))

    def _specular(
        self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor, turn: Turn | None, second: Tensor | None
    ) -> Tensor:  # fmt: skip
        """L_s (N, 3)."""
        if turn is None:
            out = self.shading.specular(skin, x, n, wo)
            if second is None or self.second is None:
                return out
            return chosen(second, out, self.second.shading.specular(skin, x, n, wo))
        moving = turn.strength * self.shading.specular(skin, x, turn(n), turn(wo))
        return moving + self.ambient_shading.specular(skin, x, n, wo)

    def solve_shadows(self) -> None:
        """Update the shadows for the present surface, albedo and light."""
        if self.shadowing is not None:
            index, x, n = near_surface(self.shadowing, self.geometry)
            with torch.no_grad():
                albedo = torch.cat([self.spatial(part)[0] for part in x.split(CHUNK)])
            surface = Surface(index, x, n, albedo)
            solve(self.shadowing, self.geometry, surface, self.light())
            if self.second is not None and self.second.shadowing is not None:
                solve(self.second.shadowing, self.geometry, surface, self.second.light())

    def of_light(self, second: bool) -> FaceModel:
        """A copy with the light, the shadows and the colour matrices of the first or the second capture alone."""
        assert self.second is not None, "the model has one light"
        out = copy.deepcopy(self)
        other = out.second
        assert other is not None
        out.second, out.calibration = None, self.calibration.of(second)
        views, calibrated = self.spec.views, self.spec.calibrated
        if second:
            out.light, out.shading, out.shadowing = other.light, other.shading, other.shadowing
            views, calibrated = self.spec.second_views, self.spec.second_calibrated
        out.spec = replace(self.spec, views=views, calibrated=calibrated, second_views=0, second_calibrated=False)
        return out

    def save(self, path: Path) -> None:
        """Write the file that `load_model` reads."""
        spec = {"format": FORMAT, "cell": self.geometry.cell, **self.spec.stored()}
        arrays = {k: v.detach().cpu().numpy() for k, v in self.state_dict().items()}
        np.savez_compressed(path, spec=np.frombuffer(json.dumps(spec).encode(), np.uint8), **arrays)


def load_model(path: Path, device: str = "cpu") -> FaceModel:
    """Load a model from its file. Raises StageError if the file has another format or a shape is wrong."""
    with np.load(path, allow_pickle=False) as file:
        spec: dict[str, Any] = json.loads(bytes(file["spec"]).decode())
        arrays = {k: torch.from_numpy(file[k]) for k in file.files if k != "spec"}
    if spec.pop("format", None) != FORMAT:
        raise StageError(
            "the fitted field has another format",
            where=path.name,
            value=spec.get("format"),
            limit=f"format {FORMAT}",
            remedy="run the fit again with this version",
        )
    cell = float(spec.pop("cell"))
    known = FaceSpec.from_stored(spec)
    arrays.setdefault("level", torch.tensor(0.0))  # files from before there was one
    model = FaceModel(known, build.system_of(known).geometry(known, arrays, cell))
    model.load_state_dict(arrays)
    return model.to(device)


class FittedField:
    """`pipeline.fields.protocol.Field` over a FaceModel."""

    def __init__(self, model: FaceModel) -> None:
        self.model = model.eval()
        self.device = model.beta.device

    @property
    def bounds(self) -> tuple[F32, F32]:
        """(3,) corners of the box in which the SDF is defined."""
        lo, hi = self.model.geometry.box()
        return lo.cpu().numpy(), hi.cpu().numpy()

    @property
    def cell(self) -> float:
        """Edge of the finest SDF cell."""
        return self.model.geometry.cell

    @property
    def rank(self) -> int:
        """Number of specular bases."""
        return self.model.shading.rank

    @property
    def light(self) -> F32:
        """((L + 1)^2, 3) coefficients; of a light that moves, those of its still stand-in."""
        moving = self.moving_light
        return self._light(self.model.light) if moving is None else moving.still()

    @property
    def moving_light(self) -> MovingLight | None:
        """The light that moves with the camera, if it does."""
        spec, ambient = self.model.spec, self.model.ambient
        if ambient is None:
            return None
        return MovingLight(spec.light_frame, spec.light_distance, self._light(self.model.light), self._light(ambient))

    def _light(self, part: Light) -> F32:
        return np.asarray(part().detach().cpu().numpy(), np.float32)

    @property
    def colour_responses(self) -> F32 | None:
        """(views, 3, 3) A_n of the fitted photos. [NeuFace eq. 19]"""
        return np.asarray(self.model.calibration().detach().cpu().numpy(), np.float32)

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
        """SDF (N,) and gradient (N, 3) at points (N, 3); the SDF is 0 on the surface that the model's `level` says."""
        s, g = self._map(self.model.geometry, points)
        return s - np.float32(float(self.model.level)), g

    def sdf(self, points: F32) -> F32:
        """(N,)."""
        return self.sdf_and_gradient(points)[0]

    def material(self, points: F32) -> Material:
        """Appearance at points (N, 3). Without a lobe its strength is 0 and its shape, which was not fitted, is the
        typical one: random values would become visible if somebody raised the strength later."""
        albedo, rho, c, inv_kappa = self._map(self.model.spatial, points)
        if not self.model.spec.specular:
            rho, c, inv_kappa = np.zeros_like(rho), np.ones_like(c), np.full_like(inv_kappa, TYPICAL_INV_KAPPA)
        return Material(albedo, rho, self.model.shading.coefficients(c), inv_kappa)

    def irradiance_ratio(self, points: F32) -> F32:
        """(N, 3) see pipeline.fields.protocol.Field."""
        shadowing = self.model.shadowing
        if shadowing is None:
            return np.ones((len(points), 3), np.float32)
        (s,) = self._map(lambda p: (shadowing(p),), points)
        return s

    def basis(self, wo: F32, normal: F32) -> F32:
        """(N, k). Raises StageError for a model without bases."""
        (b,) = self._map(lambda w, n: (self.model.shading.bases(w, n),), wo, normal)
        return b

    def normals(self, points: F32) -> F32:
        """(N, 3) unit, outward."""
        (n,) = self._map(lambda p: (unit(self.model.geometry(p)[1]),), points)
        return n


def load_face(path: Path, device: str = "cpu") -> FittedField:
    """The fitted face in a file, as plain arrays."""
    return FittedField(load_model(path, device))
