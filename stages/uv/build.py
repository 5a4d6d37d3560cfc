"""From the dense mesh to a mesh with texture coordinates, and its proxy."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pipeline import footprint, meshes
from pipeline.errors import StageError
from pipeline.meshes import F64, Charts, Mesh
from pipeline.verdict import Finding
from stages.uv import decimate
from stages.uv.chart_quality import Quality, measure
from stages.uv.config import Config
from stages.uv.decimate import Deviation
from stages.uv.density import front_of
from stages.uv.judge import judge
from stages.uv.quads import quadded
from stages.uv.remesh import remeshed
from stages.uv.unwrap import COARSER, most_tiles, unwrap

MAX_OVERLAP, MAX_FLIPPED, MAX_EMPTY, MAX_AGAINST = 1e-3, 1e-3, 5e-3, 1e-3
MANY_FRAGMENTS = 50

Step = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Built:
    """The decimated mesh, its charts, the proxy, the charts' figures, and the distances of mesh and proxy from the
    dense mesh (m). quads: number of its pairs of triangles that are quads (meshes.whole_quads); 0 for triangles.
    hair_faces: number of the mesh's last faces that are hair."""

    mesh: Mesh
    charts: Charts
    proxy: Mesh
    quality: Quality
    deviation: Deviation
    proxy_deviation: Deviation
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...] = ()
    quads: int = 0
    hair_faces: int = 0


def build(
    dense: Mesh,
    config: Config,
    step: Step,
    *,
    texel: float | None = None,
    landmarks: F64 | None = None,
) -> Built:
    """Decimate, unwrap and measure. texel: see `unwrap`. landmarks: (468, 3) of the face, which then gets more texels.

    Raises:
        StageError: the mesh is not a manifold, or can't be decimated or unwrapped.
    """
    found = meshes.topology(dense.faces, len(dense.vertices))
    if not found.sound:
        raise StageError(
            "the mesh is not a manifold",
            where="surface",
            value=found,
            limit="two faces at every edge (one at a border), one fan of faces around every vertex",
            remedy="run the surface stage again",
        )
    step(0, 4, "decimating")
    ways = {"adaptive": decimate.decimated, "uniform": remeshed, "quads": quadded}
    mesh = ways[config.remesh](dense, config.target_faces)
    step(0, 4, "decimating")
    proxy = decimate.decimated(mesh, config.proxy_faces)
    with ThreadPoolExecutor(1) as beside:  # the distances between the meshes do not depend on the charts
        away = beside.submit(_away, dense, mesh, proxy)
        step(1, 4, "unwrapping")
        front = front_of(mesh, landmarks)
        charts = unwrap(mesh, config, front, texel, lambda: step(1, 4, "unwrapping"))
        step(2, 4, "measuring charts")
        quality = measure(mesh, charts, None if front is None else front.face)
        step(3, 4, "measuring the decimation")
        deviation, rough, against = away.result()
    tiles = len(quality.tile_utilisation)
    step(4, 4, "done")
    rest = np.ones(len(mesh.faces), np.bool_) if front is None else ~front.region
    others = Mesh(mesh.vertices, mesh.normals, mesh.faces[rest]), Charts(charts.uvs, charts.faces[rest])
    short = _too_few(config, texel, tiles, footprint.texel(*others, config.tile_size))
    span = float(np.ptp(mesh.vertices, axis=0).max())
    findings = judge(quality, deviation, span, against, _opened(found, mesh), crumpled(mesh))
    quads = int(meshes.whole_quads(mesh.faces, charts.faces).sum()) if config.remesh == "quads" else 0
    return Built(mesh, charts, proxy, quality, deviation, rough, _warnings(quality, against) + short, findings, quads)


def _opened(dense: meshes.Topology, mesh: Mesh) -> float:
    """Share of the edges that are open in the decimated mesh; 0 if the dense mesh is open too."""
    if not dense.watertight:
        return 0.0
    return meshes.topology(mesh.faces, len(mesh.vertices)).boundary_edges / max(1.5 * len(mesh.faces), 1.0)


def crumpled(mesh: Mesh) -> float:
    """Share of the faces that point against the normals at their own corners."""
    mean = mesh.normals[mesh.faces].astype(np.float64).sum(1)
    return float(((meshes.area_vectors(mesh.vertices, mesh.faces) * mean).sum(1) < 0).mean())


def _away(dense: Mesh, mesh: Mesh, proxy: Mesh) -> tuple[Deviation, Deviation, float]:
    """Distances of mesh and proxy from the dense mesh, and the share of the mesh that faces against it."""
    against = decimate.flipped_share(dense, mesh)
    return decimate.deviation(dense, mesh), decimate.deviation(dense, proxy), against


def _warnings(quality: Quality, against: float) -> tuple[str, ...]:
    checks = (
        (quality.overlap, MAX_OVERLAP, "of the covered texels lie under two faces"),
        (quality.flipped, MAX_FLIPPED, "of the surface is mirrored in its chart"),
        (quality.empty, MAX_EMPTY, "of the surface has no area in texture space"),
        (against, MAX_AGAINST, "of the decimated surface faces against the dense mesh"),
    )
    out = [f"{value:.2%} {what}" for value, limit, what in checks if value > limit]
    if quality.fragments > MANY_FRAGMENTS:
        out.append(f"{quality.fragments} of {quality.charts} charts are fragments: the surface is rough")
    return tuple(out)


def _too_few(config: Config, wished: float | None, tiles: int, texel: float) -> tuple[str, ...]:
    """Warnings if the texels are coarser than the photos' pixels, or if fewer tiles than requested could be used."""
    if wished is not None and texel > 1.001 * COARSER * wished:
        return (
            f"{tiles} tile(s) of {config.tile_size} texels give texels of {1e3 * texel:.3g} mm; the photos' "
            f"pixels are {1e3 * wished:.3g} mm: raise bake.size to keep their detail",
        )
    most = most_tiles(config, wished)
    if wished is None and tiles < most:
        return (f"the charts fill only {tiles} of {most} tiles",)
    return ()
