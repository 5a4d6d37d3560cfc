"""Stand-ins for every stage's result, on top of the synthetic asset: what the report stage reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from support.synthetic_asset import SyntheticInputs, write_inputs

from pipeline.artifacts import (
    CameraSet,
    FileRef,
    FittedFace,
    HeldOutView,
    Located,
    MaskSet,
    Surface,
    TextureSet,
    UvMesh,
    ViewMask,
)
from pipeline.asset_artifacts import UsdAsset
from pipeline.capture_artifacts import Capture
from pipeline.film import animated_webp
from pipeline.images import write_exr, write_png
from pipeline.reflectance_artifacts import ReflectanceField


@dataclass(frozen=True, slots=True)
class SyntheticResults:
    """The report stage's inputs by name."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    inverse_rendering: Located[FittedFace]
    surface: Located[Surface]
    uv: Located[UvMesh]
    reflectance: Located[ReflectanceField]
    bake: Located[TextureSet]
    usd: Located[UsdAsset]


def write_results(
    folder: Path,
    *,
    held_out: tuple[int, ...] = (3, 9),
    asset_views: tuple[int, ...] | None = None,
    scale: int = 1,
    tiled: bool = False,
) -> SyntheticResults:
    """The asset's renders are grey discs; masks are the photos' discs."""
    made = write_inputs(folder, held_out=held_out, scale=scale, tiled=tiled)
    return SyntheticResults(
        made.capture,
        made.poses,
        write_masks(folder / "masks", made),
        made.inverse_rendering,
        _surface(folder / "surface", made.uv),
        made.uv,
        Located(ReflectanceField(present=False), folder),
        made.bake,
        _usd(folder / "usd", made, held_out if asset_views is None else asset_views, scale),
    )


def disc(camera, scale: int = 1) -> np.ndarray:
    """(H, W) silhouette that the synthetic photos show."""
    y, x = np.mgrid[: camera.height, : camera.width]
    inside = (np.hypot(x - camera.K[0][2], y - camera.K[1][2]) < 30).astype(np.float32)
    return inside.reshape(camera.height // scale, scale, camera.width // scale, scale).mean((1, 3))


def write_masks(folder: Path, made: SyntheticInputs) -> Located[MaskSet]:
    masks = []
    for camera in made.poses.artifact.cameras:
        write_png(folder / f"{camera.index}.png", disc(camera))
        masks.append(
            ViewMask(
                index=camera.index,
                mask=FileRef.of(folder, f"{camera.index}.png"),
                source="given",
                coverage=float(disc(camera).mean()),
            )
        )
    return Located(MaskSet(masks=tuple(masks)), folder)


def _surface(folder: Path, uv: Located[UvMesh]) -> Located[Surface]:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mesh.npz").write_bytes(uv.path(uv.artifact.mesh).read_bytes())
    return Located(
        Surface(
            mesh=FileRef.of(folder, "mesh.npz"),
            vertices=1986,
            faces=3968,
            watertight=True,
            components=1,
            removed_components=2,
            cell=0.002,
            warnings=("two floating pieces were removed",),
        ),
        folder,
    )


def _usd(folder: Path, made: SyntheticInputs, indices: tuple[int, ...], scale: int) -> Located[UsdAsset]:
    views = []
    for camera in (c for c in made.poses.artifact.cameras if c.index in indices):
        alpha = disc(camera, scale)[..., None]
        rgba = np.concatenate([alpha * [0.3, 0.2, 0.15], alpha], -1).astype(np.float32)
        write_exr(folder / f"asset_views/{camera.index}.exr", rgba)
        write_png(folder / f"asset_views/{camera.index}.png", rgba)
        exr, png = (FileRef.of(folder, f"asset_views/{camera.index}.{e}") for e in ("exr", "png"))
        views.append(HeldOutView(index=camera.index, exr=exr, png=png, scale=scale))
    for side in ("left", "front", "right", "shape_front"):
        write_png(folder / f"previews/{side}.png", np.full((32, 32, 4), 0.5))
    for number, name in enumerate(("captured", "sunset")):
        frames = [np.full((32, 32, 3), 80 * number + 20 * i, np.uint8) for i in range(3)]
        (folder / f"previews/turn_{name}.webp").write_bytes(animated_webp(frames, 4.0, 80))
    write_exr(folder / "asset/environment.exr", np.linspace(0, 2, 64 * 128 * 3, dtype=np.float32).reshape(64, 128, 3))
    files = tuple(
        FileRef.of(folder, p)
        for p in [*sorted(folder.rglob("*.png")), *sorted(folder.rglob("*.webp")), folder / "asset/environment.exr"]
        if "asset_views" not in p.parts
    )
    return Located(UsdAsset(name="head", root="asset/head.usd", files=files, views=tuple(views), checks=36), folder)
