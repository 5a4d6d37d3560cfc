"""Small stand-ins for the artifacts of earlier stages: a textured ball of 0.12 m radius under a smooth light.

Geometry, maps and light are simple enough that their renders are known in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artifacts import (
    Camera,
    CameraSet,
    FileRef,
    FittedFace,
    HeldOutView,
    Located,
    MaskSet,
    Surface,
    TextureMap,
    TextureSet,
    UvMesh,
)
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.head_artifacts import RegisteredHead
from pipeline.images import write_exr, write_png, write_png_from_linear
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.transforms import rows

RADIUS = 0.12
RANK = 3


@dataclass(frozen=True, slots=True)
class SyntheticInputs:
    """The usd stage's inputs by name."""

    surface: Located[Surface]
    template: Located[RegisteredHead]
    uv: Located[UvMesh]
    bake: Located[TextureSet]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    capture: Located[Capture]
    masks: Located[MaskSet]
    reflectance: Located[ReflectanceField] = Located(ReflectanceField(present=False), Path())


def ball(columns: int = 64, rings: int = 32, height: float = 1.25) -> dict[str, np.ndarray]:
    """A ball, `height` times as tall as wide, with a lat-long chart: seam at -Z, u grows towards +X seen from +Z.

    Pole triangles have their own texture vertex in the middle of their column, so that no triangle is empty.
    """
    lon = -np.pi + 2 * np.pi * np.arange(columns) / columns
    lat = np.pi * (np.arange(1, rings) / rings - 0.5)
    ring = np.cos(lat)[:, None]
    directions = np.concatenate(
        [
            [[0, -1, 0]],
            np.stack([ring * np.sin(lon), np.repeat(np.sin(lat)[:, None], columns, 1), ring * np.cos(lon)], -1).reshape(
                -1, 3
            ),
            [[0, 1, 0]],
        ]
    )
    u = np.arange(columns + 1) / columns
    grid = np.stack(np.meshgrid(u, np.arange(1, rings) / rings), -1).reshape(-1, 2)
    poles = np.stack([np.concatenate([(np.arange(columns) + 0.5) / columns] * 2), np.repeat([0.0, 1.0], columns)], -1)
    uvs = 0.02 + 0.96 * np.concatenate([grid, poles])
    faces, uv_faces = [], []
    at = lambda r, c: 1 + r * columns + c % columns  # noqa: E731
    uv_at = lambda r, c: r * (columns + 1) + c  # noqa: E731
    top, south, north = len(directions) - 1, len(grid), len(grid) + columns
    for c in range(columns):
        faces.append([0, at(0, c + 1), at(0, c)])
        uv_faces.append([south + c, uv_at(0, c + 1), uv_at(0, c)])
        for r in range(rings - 2):
            faces += [[at(r, c), at(r, c + 1), at(r + 1, c + 1)], [at(r, c), at(r + 1, c + 1), at(r + 1, c)]]
            uv_faces += [
                [uv_at(r, c), uv_at(r, c + 1), uv_at(r + 1, c + 1)],
                [uv_at(r, c), uv_at(r + 1, c + 1), uv_at(r + 1, c)],
            ]
        faces.append([at(rings - 2, c), at(rings - 2, c + 1), top])
        uv_faces.append([uv_at(rings - 2, c), uv_at(rings - 2, c + 1), north + c])
    stretch = np.array([1, height, 1])
    normals = directions / stretch
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return {
        "vertices": (RADIUS * directions * stretch).astype(np.float32),
        "normals": normals.astype(np.float32),
        "faces": np.array(faces, np.int32),
        "uvs": uvs.astype(np.float32),
        "uv_faces": np.array(uv_faces, np.int32),
    }


def cut_in_two(mesh: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The ball with its chart cut at u = 0.5, each half stretched over a UDIM tile of its own."""
    u = mesh["uvs"][:, 0].astype(np.float64)
    right = u[mesh["uv_faces"]].mean(1) > 0.5
    count = len(u)
    share = (u - 0.02) / 0.96
    halves = [np.stack([t + 0.02 + 0.96 * (2 * share - t), mesh["uvs"][:, 1]], -1) for t in (0, 1)]
    uv_faces = mesh["uv_faces"] + np.where(right, count, 0)[:, None]
    used, faces = np.unique(uv_faces, return_inverse=True)
    uvs = np.concatenate(halves)[used].astype(np.float32)
    return mesh | {"uvs": uvs, "uv_faces": faces.reshape(-1, 3).astype(np.int32)}


def smooth_light(order: int = 10) -> np.ndarray:
    """((order + 1)^2, 3) light, warm from +X +Y and cool from behind, positive everywhere."""
    light = np.zeros(((order + 1) ** 2, 3), np.float32)
    light[0] = np.sqrt(4 * np.pi) * np.array([1.0, 0.95, 0.9])
    light[1:4] = [[0.5, 0.45, 0.4], [0.5, 0.5, 0.55], [0.9, 0.8, 0.6]]  # along y, z, x
    light[6] = [0.2, 0.1, 0.3]
    return light


def texture_arrays(size: int = 128, tile: int | None = None) -> dict[str, np.ndarray]:
    """Maps that vary smoothly; their names are those of the bake stage. `tile`: of the ball that is cut in two."""
    v, u = np.meshgrid(1 - (np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    if tile is not None:
        u = 0.02 + 0.96 * ((u - 0.02) / 0.96 + tile) / 2
    wave = 0.5 + 0.5 * np.sin(12 * np.pi * u) * np.sin(6 * np.pi * v)
    one = np.ones_like(u)
    n = np.stack([0.15 * np.sin(20 * np.pi * u), 0.1 * np.cos(14 * np.pi * v), one], -1)
    columns = (np.arange(64) + 0.5) / 64
    basis = np.stack([0.04 + 0.5 * (1 - columns) ** 5, columns, one[0, 0] * np.ones(64)], -1)[None]
    return {
        "albedo": np.stack([0.25 + 0.35 * u, 0.2 + 0.25 * wave, 0.2 + 0.2 * v], -1),
        "normal": n / np.linalg.norm(n, axis=-1, keepdims=True),
        "roughness": (0.35 + 0.2 * wave)[..., None],
        "f0": (0.02 + 0.016 * u)[..., None],
        "specular_intensity": (0.3 * one)[..., None],
        "specular_coefficients": np.stack([0.3 * one, 0.05 * wave, 0.02 * u], -1),
        "inv_kappa": (0.05 + 0.1 * v)[..., None],
        "shininess": (1 / (0.05 + 0.1 * v))[..., None],
        "confidence": wave[..., None],
        "coverage": one[..., None],
        "basis_lut": basis,
    }


def write_textures(folder: Path, arrays: dict[str, np.ndarray]) -> Located[TextureSet]:
    """A TextureSet of these arrays, in the formats of the bake stage."""
    maps = {}
    for name, a in arrays.items():
        a = np.asarray(a, np.float32)
        files = {"exr": folder / f"{name}.exr"}
        write_exr(
            files["exr"],
            a,
            tuple(f"c{i}" for i in range(a.shape[2])) if name in ("specular_coefficients", "basis_lut") else None,
        )
        if name == "albedo":
            files["png"] = folder / "albedo.png"
            write_png_from_linear(files["png"], a)
        elif name not in ("basis_lut", "shininess", "inv_kappa", "specular_coefficients"):
            files["png"] = folder / f"{name}.png"
            write_png(files["png"], a * 0.5 + 0.5 if name == "normal" else a, 8)
        maps[name] = TextureMap(
            name=name,
            channels=a.shape[2],
            files={k: FileRef.of(folder, p) for k, p in files.items()},
            space="srgb_png" if name == "albedo" else "raw",
            minimum=float(a.min()),
            mean=float(a.mean()),
            maximum=float(a.max()),
        )
    size = len(arrays["albedo"])
    return Located(TextureSet(size=size, padding=4, maps=maps, coverage=0.9), folder)


def write_tiles(folder: Path, parts: list[dict[str, np.ndarray]]) -> Located[TextureSet]:
    """The same of several UDIM tiles, all of one size."""
    made = [write_textures(folder / str(1001 + t), arrays).artifact for t, arrays in enumerate(parts)]
    maps = {}
    for name, first in made[0].maps.items():
        files = {}
        for t, one in enumerate(made):
            for kind, ref in one.maps[name].files.items():
                suffix = kind if name == "basis_lut" else f"{1001 + t}.{kind}"
                target = folder / f"{name}.{suffix}"
                (folder / str(1001 + t) / ref.path).rename(target)
                files[suffix] = FileRef.of(folder, target)
        maps[name] = first.model_copy(update={"files": files})
    return Located(made[0].model_copy(update={"maps": maps, "tiles": len(parts)}), folder)


def cameras(count: int = 5, width: int = 96, height: int = 120) -> CameraSet:
    """Cameras on a ring 0.7 m away, with unequal focal lengths, an off-centre principal point and distortion."""
    out = []
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.2
        back = np.array([np.sin(angle) * np.cos(0.2), np.sin(0.2), np.cos(angle) * np.cos(0.2)])
        right = np.cross([0, 1, 0], back) / np.linalg.norm(np.cross([0, 1, 0], back))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, -np.cross(back, right), -back], 1)
        pose[:3, 3] = 0.7 * back
        K = np.array([[190.0, 0, 0.5 * width + 3.3], [0, 184.0, 0.5 * height - 2.1], [0, 0, 1]])
        out.append(
            Camera(
                index=3 * i,
                name=f"{3 * i}.png",
                width=width,
                height=height,
                K=rows(K),
                world_from_cam=rows(pose),
                distortion=(-0.05, 0.01, 0.001, -0.0007, 0.002),
            )
        )
    return CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.2, cameras=tuple(out)
    )


def write_inputs(
    folder: Path,
    *,
    mesh: dict[str, np.ndarray] | None = None,
    light: np.ndarray | None = None,
    arrays: dict[str, np.ndarray] | None = None,
    proxy: bool = True,
    held_out: tuple[int, ...] = (3, 9),
    scale: int = 1,
    tiled: bool = False,
) -> SyntheticInputs:
    """All inputs of the usd stage. The fit's predictions of held-out views are grey cards. tiled: on two UDIM tiles."""
    made = {n: folder / n for n in ("surface", "uv", "bake", "face", "poses", "capture")}
    for f in made.values():
        f.mkdir(parents=True, exist_ok=True)
    dense = ball(72, 36)
    np.savez(made["surface"] / "surface.npz", **{k: dense[k] for k in ("vertices", "normals", "faces")})
    surface = Surface(
        mesh=FileRef.of(made["surface"], "surface.npz"),
        vertices=len(dense["vertices"]),
        faces=len(dense["faces"]),
        watertight=True,
        components=1,
        removed_components=0,
        cell=0.001,
    )
    mesh = mesh or (cut_in_two(ball()) if tiled else ball())
    np.savez(made["uv"] / "mesh.npz", **mesh)
    refs = {"mesh": FileRef.of(made["uv"], "mesh.npz")}
    if proxy:
        coarse = ball(16, 10)
        np.savez(made["uv"] / "proxy.npz", **{k: coarse[k] for k in ("vertices", "normals", "faces")})
        refs["proxy"] = FileRef.of(made["uv"], "proxy.npz")
    uv = UvMesh(
        **refs,
        vertices=len(mesh["vertices"]),
        faces=len(mesh["faces"]),
        charts=2 if tiled else 1,
        tiles=2 if tiled else 1,
        utilisation=0.92,
        tile_utilisation=(0.92, 0.92) if tiled else (),
        stretch=1.4,
        overlap=0.0,
        deviation_mm=0.1,
    )
    np.savez(made["face"] / "light.npz", light=smooth_light() if light is None else light)
    rig = cameras()
    views = []
    for index in held_out:
        camera = next(c for c in rig.cameras if c.index == index)
        card = np.full((camera.height // scale, camera.width // scale, 4), 0.5, np.float32)
        write_exr(made["face"] / f"{index}.exr", card)
        write_png(made["face"] / f"{index}.png", card)
        views.append(
            HeldOutView(
                index=index,
                exr=FileRef.of(made["face"], f"{index}.exr"),
                png=FileRef.of(made["face"], f"{index}.png"),
                scale=scale,
            )
        )
    (made["face"] / "field.npz").write_bytes(b"not read here")
    face = FittedFace(
        field=FileRef.of(made["face"], "field.npz"),
        light=FileRef.of(made["face"], "light.npz"),
        rank=RANK,
        light_order=10,
        fitted_views=tuple(c.index for c in rig.cameras if c.index not in held_out),
        held_out=tuple(views),
        steps=10,
        loss=0.01,
        psnr=30.0,
        beta=0.001,
        cell=0.002,
        model={"specular": {"rank": 3, "modelled": True, "evidence": "synthetic"}},
    )
    return SyntheticInputs(
        Located(surface, made["surface"]),
        Located(RegisteredHead(registered=False, reason="not asked for"), folder),
        Located(uv, made["uv"]),
        write_tiles(made["bake"], [texture_arrays(tile=t) for t in (0, 1)])
        if tiled
        else write_textures(made["bake"], arrays or texture_arrays()),
        Located(face, made["face"]),
        Located(rig, made["poses"]),
        _capture(made["capture"], rig, held_out),
        Located(MaskSet(masks=()), folder),
    )


def _capture(folder: Path, rig: CameraSet, held_out: tuple[int, ...]) -> Located[Capture]:
    """Photos: a soft brown disc over black, so that metrics have something to look at."""
    views = []
    for camera in rig.cameras:
        y, x = np.mgrid[: camera.height, : camera.width]
        inside = np.hypot(x - camera.K[0][2], y - camera.K[1][2]) < 30
        photo = np.where(inside[..., None], [0.4, 0.25, 0.2], [0.0, 0.0, 0.0]) * (
            0.6 + 0.4 * x[..., None] / camera.width
        )
        write_png_from_linear(folder / camera.name, photo.astype(np.float32))
        views.append(
            CaptureView(
                index=camera.index,
                name=camera.name,
                image=FileRef.of(folder, camera.name),
                width=camera.width,
                height=camera.height,
                holdout=camera.index in held_out,
            )
        )
    return Located(Capture(kind="facescape", views=tuple(views)), folder)


def run_stage(inputs: SyntheticInputs, folder: Path, **config: object):
    from pipeline.contract import Context
    from stages.usd.stage import STAGE, Config, Inputs

    named = {n: getattr(inputs, n) for n in Inputs.__slots__}
    small = {"preview_size": 64, "environment_width": 64, "samples": 1} | config
    return STAGE.run(Inputs(**named), Config(**small), Context(folder, folder / "scratch"))
