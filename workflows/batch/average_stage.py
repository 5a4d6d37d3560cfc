"""A stage beside the chain: the average of registered heads and of their albedo, from the captures of a batch.

Its inputs are numbered captures, so that the key holds all of them, and the lineage every person's photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import make_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pipeline import tiles
from pipeline.artifacts import CameraSet, Located, TextureSet
from pipeline.contract import Context, Stage, StageConfig
from pipeline.head_artifacts import AverageHead, RegisteredHead
from pipeline.meshes import F32, F64, Indices
from pipeline.registration.head import Head
from pipeline.units import ContentHash
from workflows.batch.heads import Found
from workflows.batch.page import AVERAGE

NAME, PICTURE = AVERAGE, "average.png"
STEPS = 1  # subdivisions of the written mesh
KINDS = {"template": RegisteredHead, "poses": CameraSet, "bake": TextureSet}


class Config(StageConfig):
    """Which template the heads are of: its landmarks say where edges count."""

    folder: str = Field("", description="folder of another template; default: the project's own", exclude=True)
    folder_digest: ContentHash = Field("", description="sha256 of the files in folder")


def average_stage(count: int) -> Stage[Any, Any, Any]:
    """The stage for so many captures."""
    fields = [(f"{kind}_{i}", Located[of]) for i in range(count) for kind, of in KINDS.items()]  # type: ignore[valid-type]
    inputs = make_dataclass("Inputs", fields, frozen=True)
    return Stage(NAME, 1, inputs, Config, AverageHead, partial(run, count), any_threads=True)


def inputs_of(stage: Stage[Any, Any, Any], heads: Sequence[Found]) -> Any:
    """The stage's inputs from heads with maps."""
    named = {
        f"{k}_{i}": v for i, f in enumerate(heads) for k, v in zip(KINDS, (f.template, f.poses, f.baked), strict=True)
    }
    return stage.inputs(**named)


def run(count: int, inputs: Any, config: Config, context: Context) -> AverageHead:
    """Average the heads, then their albedo tile by tile."""
    from pipeline.registration.average import average_shape, region_scatter
    from pipeline.registration.head import load_head
    from pipeline.template.load import load_template
    from stages.usd.write.obj import write_obj
    from workflows.batch.average_picture import picture

    heads: list[Located[RegisteredHead]] = [getattr(inputs, f"template_{i}") for i in range(count)]
    maps: list[Located[TextureSet]] = [getattr(inputs, f"bake_{i}") for i in range(count)]
    first = heads[0].artifact

    def read(i: int) -> Head:
        context.check()
        context.progress(i, 2 * count, "heads")
        ref = heads[i].artifact.head
        assert ref is not None, "only registered heads are inputs"
        return load_head(heads[i].path(ref))

    shape = average_shape(
        [partial(read, i) for i in range(count)], first.regions, np.asarray(first.world_from_template)
    )
    head = read(0)
    template = load_template(Path(config.folder) if config.folder else None)
    known = template if np.array_equal(template.quads, head.quads) else None
    mesh = surface_of(head, first.regions, shape.points)
    textures = _textures(maps, _tiles(mesh.uvs), known, context)
    for tile, texture in textures.items():
        _write_map(context.workdir / _map(tile), texture.mean)
    look = _look({t: x.mean for t, x in textures.items()})
    written = write_obj(context.workdir, NAME, mesh, look)
    picture(context.workdir / PICTURE, mesh, {t: x.mean for t, x in textures.items()})
    return AverageHead(
        files=tuple(context.file(p.name) for p in (*written, *(Path(_map(t)) for t in textures), Path(PICTURE))),
        heads=count,
        metric=all(getattr(inputs, f"poses_{i}").artifact.metric for i in range(count)),
        texture_size=next(iter(textures.values())).size,
        size_deviation=round(float(np.std(np.log(shape.scales), ddof=1)), 6),
        deviation_mm=region_scatter(shape, head, first.regions),
        sharpness={n: round(v, 4) for n, v in textures[0].sharpness().items()},
    )


def surface_of(head: Head, regions: tuple[str, ...], points: F64) -> Any:
    """The average as a mesh of quads with texture: STEPS subdivisions of the cage, whose vertices come first among the
    points (n, 3) of all subdivisions."""
    from pipeline.meshes import triangles_of, vertex_normals
    from pipeline.registration.head import kept_quads
    from pipeline.registration.subdivision import subdivided
    from stages.usd.write.mesh import UvSurface

    steps = min(STEPS, head.levels)
    keep = np.repeat(kept_quads(head, regions), 4**steps)
    normals = vertex_normals(points, triangles_of(head.surface()[2]))
    quads: Indices = subdivided(head.quads, len(head.vertices), steps).quads[keep]
    level = subdivided(head.uv_quads, len(head.uvs), steps, "sharp")
    rows, faces = np.unique(quads, return_inverse=True)
    used, uv_faces = np.unique(level.quads[keep], return_inverse=True)
    return UvSurface(
        points[rows].astype(np.float32), normals[rows], triangles_of(faces.reshape(-1, 4)),
        np.asarray(level.stencil @ head.uvs)[used].astype(np.float32), triangles_of(uv_faces.reshape(-1, 4)),
        paired=True,
    )  # fmt: skip


def _tiles(uvs: F32) -> list[int]:
    return list(range(max(1, int(np.ceil(uvs[:, 0].max() - 1e-6)))))


def _textures(
    maps: Sequence[Located[TextureSet]], wanted: Sequence[int], template: Any, context: Context
) -> dict[int, Any]:
    """The mean albedo of each tile. One capture's maps are in memory at a time."""
    from pipeline.images import read_exr
    from pipeline.registration.average import MeanTexture, landmark_discs

    size = min(m.artifact.size for m in maps)
    discs = {} if template is None else landmark_discs(template, size)
    out = {t: MeanTexture(size, discs if t == 0 else {}) for t in wanted}
    for number, one in enumerate(maps):
        context.check()
        context.progress(len(maps) + number, 2 * len(maps), "textures")
        for tile, texture in out.items():
            kind = tiles.form("exr", tile, one.artifact.tiles)
            albedo, seen = (read_exr(one.path(one.artifact.maps[n].files[kind]))[0] for n in ("albedo", "confidence"))
            texture.add(albedo[..., :3], seen[..., 0])
    return out


def _map(tile: int) -> str:
    return f"{NAME}_albedo.{tiles.FIRST + tile}.png"


def _write_map(path: Path, albedo: F32) -> None:
    from pipeline.images import write_png_from_linear

    write_png_from_linear(path, albedo)


def _look(albedo: dict[int, F32]) -> Any:
    from stages.usd.write.shading import Look

    name = f"{NAME}_albedo.{tiles.TOKEN}.png" if len(albedo) > 1 else _map(0)
    mean = [float(x) for x in albedo[0].reshape(-1, 3).mean(0)]
    return Look(name, None, None, 1.4, (mean[0], mean[1], mean[2]))
