"""A registered head for the usd stage: a cube of quads on the asset's ball, with charts on two tiles and a displacement
that is known in closed form; a smaller ball above it as hair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from support.synthetic_asset import RADIUS, SyntheticInputs, texture_arrays, write_inputs, write_textures, write_tiles

from pipeline import meshes
from pipeline.artifacts import FileRef, Located, MaskSet, Surface
from pipeline.contract import Context
from pipeline.head_artifacts import FittedEye, RegisteredHead
from pipeline.registration.head import Head, limit_surface
from pipeline.registration.rig import Rig
from pipeline.registration.subdivision import subdivided
from pipeline.template.model import Expressions
from stages.uv import stage as uv_stage
from tests.support.ball_head import ball_quads, ball_scan

SIDE, LEVELS = 6, 2  # quads along an edge of the cube; subdivisions
REGIONS, PARTS = ("face", "eyes", "lashes"), ("skin", "eye_left", "lashes_left")
HEIGHT = 0.002  # metres: largest displacement


def cube_uvs() -> np.ndarray:
    """(6 SIDE^2, 4, 2) sides 0 to 3 in the quarters of tile 1001, 4 and 5 on tile 1002."""
    at = np.arange(SIDE)
    x, y = np.meshgrid(at, at, indexing="ij")
    low = np.stack([x.ravel(), y.ravel()], -1)[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    place = np.array([[0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5], [1, 0], [1.5, 0]])
    return np.concatenate([0.05 + 0.4 * low / SIDE + p for p in place])


def height_at(points: np.ndarray) -> np.ndarray:
    """(N,) metres."""
    return HEIGHT * np.sin(points[:, 0] / (0.3 * RADIUS)) * np.cos(points[:, 1] / (0.4 * RADIUS))


def registered_head() -> Head:
    """Sides 0 to 4 are skin, displaced; side 5 is an eye but for its last row, lashes, which the asset leaves out. The
    parts share no vertices."""
    directions, quads = ball_quads(SIDE)
    corners = np.round(cube_uvs(), 9)
    uvs, index = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    region = np.zeros(len(quads), np.int64)
    region[5 * SIDE**2 :], region[-SIDE:] = 1, 2
    own, flat = np.unique(quads + len(directions) * region[:, None], return_inverse=True)
    directions, quads = directions[own % len(directions)], flat.reshape(-1, 4)
    level = subdivided(quads, len(directions), LEVELS)
    vertices = RADIUS * directions
    points, _, fine = limit_surface(vertices, level)
    free = np.isin(np.arange(len(points)), fine[np.repeat(region == 0, 4**LEVELS)])
    moved = np.where(free, height_at(points), 0.0).astype(np.float32)
    return Head(vertices, quads, uvs, index.reshape(-1, 4), region, region, moved, free.astype(np.float32), LEVELS)


def head_rig() -> Rig:
    """Two expressions of the skin, and an eye joint; the jaw turns what lies below the middle in front."""
    head = registered_head()
    front = np.flatnonzero(
        (head.vertices[:, 2] > 0.3 * RADIUS) & np.isin(np.arange(len(head.vertices)), head.quads[:72])
    )
    low = front[head.vertices[front, 1] < 0]
    offsets = np.concatenate([np.full((len(low), 3), [0.0, -0.01, 0.002]), 0.004 * head.vertices[front] / RADIUS])
    starts = np.array([0, len(low), len(low) + len(front)])
    shapes = Expressions(("jawOpen", "cheekPuff"), starts, np.concatenate([low, front]), offsets)
    eye = np.isin(np.arange(len(head.vertices)), head.quads[head.region == 1])
    jaw = np.isin(np.arange(len(head.vertices)), low) * 0.75
    places = np.array([[0, 0, 0], [0, -0.01, 0.02], [0, 0, 0.1]], np.float64)
    return Rig(shapes, ("head", "jaw", "eye_left"), places, np.stack([1 - jaw - eye, jaw, eye], 1))


def write_head(folder: Path) -> Located[RegisteredHead]:
    """The template stage's artifact."""
    folder.mkdir(parents=True, exist_ok=True)
    registered_head().save(folder / "head.npz")
    head_rig().save(folder / "rig.npz")
    made = RegisteredHead(
        registered=True, head=FileRef.of(folder, "head.npz"), rig=FileRef.of(folder, "rig.npz"),
        regions=REGIONS, parts=PARTS, levels=LEVELS,
    )  # fmt: skip
    return Located(made, folder)


def with_told_hair(template: Located[RegisteredHead], dense: meshes.Mesh) -> Located[RegisteredHead]:
    """The same, with the vertices above the ball told as hair."""
    np.savez(template.folder / "hair.npz", hair=dense.vertices[:, 1] > 1.2 * RADIUS)
    told = template.artifact.model_copy(update={"hair": FileRef.of(template.folder, "hair.npz")})
    return Located(told, template.folder)


def template_inputs(
    folder: Path, mesh: Literal["template", "both"] = "template", *, hair_told: bool = False
) -> SyntheticInputs:
    """The inputs of the usd stage with uv.mesh=template or both. hair_told: the ball above is hair, and one beside is
    the rest; else the ball above is the rest."""
    plain, template = write_inputs(folder / "plain"), write_head(folder / "head")
    balls = [ball_scan(RADIUS), ball_scan(0.25 * RADIUS, 12, (0, 1.5 * RADIUS, 0))]
    if hair_told:
        balls.append(ball_scan(0.3 * RADIUS, 12, (1.6 * RADIUS, 0, 0)))
    first = np.cumsum([0, *(len(b.vertices) for b in balls)])
    dense = meshes.Mesh(
        np.concatenate([b.vertices for b in balls]), np.concatenate([b.normals for b in balls]),
        np.concatenate([b.faces + n for b, n in zip(balls, first[:-1].astype(np.int32), strict=True)]),
    )  # fmt: skip
    meshes.save(folder / "surface.npz", dense)
    if hair_told:
        template = with_told_hair(template, dense)
    surface = Located(
        Surface(
            mesh=FileRef.of(folder, "surface.npz"), vertices=len(dense.vertices), faces=len(dense.faces),
            watertight=True, components=len(balls), removed_components=0, cell=0.001,
        ),
        folder,
    )  # fmt: skip
    (folder / "uv").mkdir()
    files = uv_stage.Inputs(surface, None, None, Located(MaskSet(masks=()), folder), template)  # type: ignore[arg-type]
    uv = uv_stage.run(
        files,
        uv_stage.Config(mesh=mesh, target_faces=3000, proxy_faces=300),
        Context(folder / "uv", folder / "scratch"),
    )
    bake = write_tiles(folder / "bake", [texture_arrays() for _ in range(uv.tiles)])
    if uv.scan is not None:
        own = write_textures(folder / "bake/scan", texture_arrays()).artifact
        maps = {
            name: m.model_copy(
                update={"files": {k: f.model_copy(update={"path": f"scan/{f.path}"}) for k, f in m.files.items()}}
            )
            for name, m in own.maps.items()
        }
        scan = own.model_copy(update={"maps": maps})
        bake = Located(bake.artifact.model_copy(update={"scan": scan}), bake.folder)
    return replace(plain, surface=surface, template=template, uv=Located(uv, folder / "uv"), bake=bake)


def with_fitted_eye(inputs: SyntheticInputs) -> SyntheticInputs:
    """The same with side 5 as a fitted eye."""
    eye = FittedEye(
        part="eye_left", centre=(0, 0, 0), radius=RADIUS, iris=0.3 * RADIUS, axes=((1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    registered = inputs.template.artifact.model_copy(update={"eyes": (eye,)})
    return replace(inputs, template=Located(registered, inputs.template.folder))
