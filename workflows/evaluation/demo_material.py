"""Did the fit separate diffuse from specular? The fitted material and light against the demo's ground truth.

At every pixel of the held-out views the true surface point is known, and with it the true albedo, F0 and roughness,
and by the demo's own renderer the diffuse and the specular part of its radiance. The model is evaluated at the nearest
point of its own surface, towards the same camera.

Gauge: albedo and light share one free gain. It is fixed by the gain that brings the albedo nearest to the truth, and
the light is divided by it; radiance needs none. Correlations are over pixels (Pearson); errors are medians.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.images import read_alpha, write_png_from_linear
from pipeline.threads import side_by_side
from pipeline.transforms import apply, pixel_centres, scale_of

F64 = npt.NDArray[np.float64]
SAMPLES = 256  # light samples of each lobe at a pixel
CHUNK = 200_000
SHADED = 5_000  # points that one thread shades at a time
SPHERE = 4000  # directions in which lights are compared


@dataclass(frozen=True, slots=True)
class Looks:
    """What is seen at N pixels: albedo (N, 3) reflectance, f0 (N,), roughness (N,), diffuse and specular (N, 3)."""

    albedo: F64
    f0: F64
    roughness: F64
    diffuse: F64
    specular: F64


@dataclass(frozen=True, slots=True)
class Agreement:
    """correlation (Pearson); error: median of |found - true|; and both means."""

    correlation: float
    error: float
    found_mean: float
    true_mean: float

    def line(self, name: str) -> str:
        """For people."""
        return (
            f"{name}: correlation {self.correlation:.3f}, median error {self.error:.4f}, mean {self.found_mean:.4f} "
            f"(true {self.true_mean:.4f})"
        )


@dataclass(frozen=True, slots=True)
class MaterialFigures:
    """The recovered material and light against the demo's. gain: what the albedo had to be multiplied by.
    specular_share: mean specular over mean total radiance."""

    pixels: int
    gain: float
    albedo: Agreement
    f0: Agreement
    roughness: Agreement
    diffuse: Agreement
    specular: Agreement
    light_correlation: float
    light_low_correlation: float
    light_error: float
    specular_share: float
    true_specular_share: float

    def lines(self) -> list[str]:
        """For people."""
        rows = [
            a.line(name)
            for name, a in (
                ("albedo", self.albedo),
                ("F0 of the fitted lobe", self.f0),
                ("roughness of the fitted lobe", self.roughness),
                ("diffuse radiance", self.diffuse),
                ("specular radiance", self.specular),
            )
        ]
        return [
            *rows,
            f"light, after the gain {self.gain:.3f}: correlation {self.light_correlation:.3f} "
            f"({self.light_low_correlation:.3f} up to order 4), error {100 * self.light_error:.0f} % of its mean",
            f"specular share of the radiance: {self.specular_share:.3f} (true {self.true_specular_share:.3f})",
        ]


def compare(field: Path, capture_folder: Path, capture: Capture, capture_from_asset: F64, out: Path) -> MaterialFigures:
    """Measure, and write OUT/material.json and a picture of one held-out view, OUT/material.png."""
    from pipeline.fields.face import load_model

    model = load_model(field)
    found, true = [], []
    held = [v for v in capture.views if v.holdout]
    for number, view in enumerate(held):
        seen = seen_points(view, capture_folder)
        mine = fitted_looks(model, seen.points, seen.to_eye, capture_from_asset)
        really = true_looks(capture_folder, seen.points, seen.normals, seen.to_eye)
        found.append(mine)
        true.append(really)
        if number == len(held) // 2:
            shown = (seen, mine, really)
    mine, really = _joined(found), _joined(true)
    gain = float((mine.albedo * really.albedo).sum() / (mine.albedo**2).sum())
    figures = _figures(mine, really, gain, *_lights(model, capture_folder, capture_from_asset, gain))
    out.mkdir(parents=True, exist_ok=True)
    (out / "material.json").write_text(json.dumps(asdict(figures), indent=1))
    write_png_from_linear(out / "material.png", _picture(*shown, gain))
    return figures


@dataclass(frozen=True, slots=True)
class _Seen:
    """True surface points of one view's pixels, in the capture's world; `at` their flat pixels of size (w, h)."""

    points: F64
    normals: F64
    to_eye: F64
    at: npt.NDArray[np.int64]
    size: tuple[int, int]


def seen_points(view: CaptureView, folder: Path) -> _Seen:
    """The true surface points that the pixels of a view show."""
    import trimesh

    from pipeline.demo import head
    from workflows.evaluation.geometry import camera_of

    camera = camera_of(view)
    inner = np.flatnonzero(read_alpha(folder / f"truth/alpha/{view.index}.png").ravel() > 0.999)
    origin, directions = camera.rays(pixel_centres(view.width, view.height)[inner])
    mesh: Any = trimesh.load(folder / "truth" / "mesh_gt.ply", process=False)
    points, ray, _ = mesh.ray.intersects_location(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False
    )
    value, gradient = head.distance_and_gradient(points)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    to_eye = -directions[ray]
    facing = (normals * to_eye).sum(1) > 0.1
    points = points - value[:, None] * normals
    size = (view.width, view.height)
    return _Seen(points[facing], normals[facing], to_eye[facing], inner[ray][facing], size)


def seed_of(folder: Path) -> int:
    """The seed of the demo's skin."""
    return int(json.loads((folder / "demo.json").read_text())["seed"])


def true_looks(folder: Path, points: F64, normals: F64, to_eye: F64) -> Looks:
    """The demo's own material, and both parts of its radiance by its own renderer, without shadows."""
    from scipy.stats import qmc

    from pipeline.demo import brdf, light, skin

    about = json.loads((folder / "truth" / "light.json").read_text())
    table = brdf.cube_table(lambda w: light.radiance(np.array(about["coefficients"]), w), 96)
    look = skin.material(points, seed_of(folder))
    net = np.asarray(qmc.Sobol(2, scramble=False).random(SAMPLES), np.float64)
    shift = np.random.default_rng(0).random((len(points), 2))
    width = look.roughness**2

    def shaded(i: int) -> tuple[F64, F64]:
        some = slice(i, i + SHADED)
        return brdf.shade(
            normals[some], to_eye[some], look.albedo[some], look.f0[some], width[some], shift[some], net, table
        )

    parts = list(side_by_side(shaded, range(0, max(len(points), 1), SHADED)))
    both, specular = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Looks(look.albedo, look.f0, look.roughness, both - specular, specular)


def fitted_looks(model: Any, points: F64, to_eye: F64, capture_from_asset: F64) -> Looks:
    """The model at the nearest points of its own surface, towards the same camera."""
    import torch

    from pipeline.maths import microfacet
    from pipeline.maths.sdf import unit

    asset_from_capture: F64 = np.asarray(np.linalg.inv(capture_from_asset), np.float64)
    turn = asset_from_capture[:3, :3] / scale_of(asset_from_capture)
    parts = []
    for i in range(0, len(points), CHUNK):
        x = torch.from_numpy(apply(asset_from_capture, points[i : i + CHUNK]).astype(np.float32))
        wo = torch.from_numpy((to_eye[i : i + CHUNK] @ turn.T).astype(np.float32))
        with torch.no_grad():
            s, g = model.geometry(x)
            x = x - s[:, None] * unit(g)
            n = unit(model.geometry(x)[1])
            shaded = model.shade(x, n, wo)
            _, rho, c, inv_kappa = model.spatial(x)
            strength = (rho * model.basis.integral(x, c, n, n)).numpy()
        rough = microfacet.roughness_from_inv_kappa(inv_kappa.numpy())
        f0 = microfacet.f0_from_lobe(strength, inv_kappa.numpy())
        own = (shaded.albedo, f0, rough, shaded.diffuse, shaded.specular)
        parts.append(Looks(*(np.asarray(v, np.float64) for v in own)))
    return _joined(parts)


def _joined(parts: list[Looks]) -> Looks:
    names = Looks.__dataclass_fields__
    return Looks(**{k: np.concatenate([getattr(p, k) for p in parts]) for k in names})


def agreement(found: F64, true: F64) -> Agreement:
    """Of two arrays of one shape; NaN correlation where one is constant."""
    a, b = found.ravel(), true.ravel()
    both = a.std() > 0 and b.std() > 0
    correlation = float(np.corrcoef(a, b)[0, 1]) if both else float("nan")
    return Agreement(correlation, float(np.median(np.abs(a - b))), float(a.mean()), float(b.mean()))


def _lights(model: Any, folder: Path, capture_from_asset: F64, gain: float) -> tuple[float, float, float]:
    """Correlation of radiance over the sphere, the same up to order 4, and the median error over the mean."""
    import torch

    from pipeline.maths import sh

    about = json.loads((folder / "truth" / "light.json").read_text())
    true = torch.tensor(about["coefficients"], dtype=torch.float64)
    own = model.light().detach().double() / gain
    d = torch.nn.functional.normalize(
        torch.randn(SPHERE, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1
    )
    turn = capture_from_asset[:3, :3] / scale_of(capture_from_asset)
    own_d = d @ torch.from_numpy(turn)  # capture -> asset
    b, a = sh.radiance(true, d).numpy(), sh.radiance(own, own_d).numpy()
    b4, a4 = sh.radiance(true[:25], d).numpy(), sh.radiance(own[:25], own_d).numpy()
    whole, low = agreement(a, b), agreement(a4, b4)
    return whole.correlation, low.correlation, whole.error / whole.true_mean


def _figures(
    found: Looks, true: Looks, gain: float, light: float, light_low: float, light_error: float
) -> MaterialFigures:
    return MaterialFigures(
        pixels=len(found.f0),
        gain=gain,
        albedo=agreement(gain * found.albedo, true.albedo),
        f0=agreement(found.f0, true.f0),
        roughness=agreement(found.roughness, true.roughness),
        diffuse=agreement(found.diffuse, true.diffuse),
        specular=agreement(found.specular, true.specular),
        light_correlation=light,
        light_low_correlation=light_low,
        light_error=light_error,
        specular_share=float(found.specular.mean() / (found.diffuse + found.specular).mean()),
        true_specular_share=float(true.specular.mean() / (true.diffuse + true.specular).mean()),
    )


def _picture(seen: _Seen, found: Looks, true: Looks, gain: float) -> npt.NDArray[np.float32]:
    """Upper row found, lower row true: albedo, diffuse, specular x 4, F0 x 8, roughness (as grey)."""
    w, h = seen.size

    def image(values: F64) -> F64:
        flat = np.zeros((w * h, 3))
        flat[seen.at] = values if values.ndim == 2 else np.repeat(values[:, None], 3, 1)
        return flat.reshape(h, w, 3)

    def row(look: Looks, k: float) -> F64:
        return np.concatenate(
            [
                image(k * look.albedo),
                image(look.diffuse),
                image(4 * look.specular),
                image(8 * look.f0),
                image(look.roughness**2),
            ],
            1,
        )

    return np.concatenate([row(found, gain), row(true, 1.0)]).astype(np.float32)
