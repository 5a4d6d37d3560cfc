"""The textured mesh from the registered template: its subdivided quads on the fitted surface, with its own texture
layout. Each quad is two triangles, rows 2 q and 2 q + 1, cut from its first to its third corner.

Lashes are left out: they need a material with opacity.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from pipeline import meshes, tiles
from pipeline.meshes import F32, F64, Charts, Indices, Mask, Mesh, joined, triangles_of
from pipeline.registration.facets import lifted
from pipeline.registration.head import Head, kept_quads, limit_surface
from pipeline.registration.quality import face_quads, outer_quads
from pipeline.registration.subdivision import subdivided
from stages.uv import decimate
from stages.uv.build import Built, Step, crumpled
from stages.uv.chart_quality import Quality, measure
from stages.uv.config import Config
from stages.uv.decimate import Deviation
from stages.uv.density import face_share
from stages.uv.hair import hair_faces, parted
from stages.uv.judge import judge
from stages.uv.remainder import beside_head, cut_out, left_over
from stages.uv.rim import with_rim
from stages.uv.unwrap import unwrap

SAMPLES = 20_000
SHARE = 2  # of uv.target_faces, for what is beside the head, and for hair
EARS = "ears"  # the region
NEAR = 0.004  # metres: parts of the head further from the fitted surface are hair or clothes, and are not compared


def build_registered(
    head: Head, regions: tuple[str, ...], dense: Mesh, config: Config, step: Step, hair: Mask | None = None
) -> Built:
    """The mesh, its layout, a proxy (the cage) and their figures. regions: names that head.region refers to; hair (V,):
    vertices of the dense mesh that are hair."""
    step(0, 3, "subdividing")
    kept = kept_quads(head, regions)
    fine = np.repeat(kept, 4**head.levels)
    mesh, rows = compacted(*_displaced(head), head.surface()[2][fine])
    uvs, uv_quads = head.fine_uvs()
    charts = _charts(uvs, uv_quads[fine])
    points, normals, _ = limit_surface(head.vertices, subdivided(head.quads, len(head.vertices), 0))
    proxy, _ = compacted(points, normals, head.quads[kept])
    face = np.repeat(face_quads(head, regions)[fine], 2)
    shown = _shown(head, regions, fine)
    whole, laid, hairs = mesh, charts, 0
    if config.rest:
        ears = mesh.vertices[np.unique(mesh.faces[_of_region(head, regions, fine, EARS)])]
        others, hairs = _others(mesh, charts, shown, ears, dense, hair, config)
        whole, laid = joined([(mesh, charts), *others])
    face = np.concatenate([face, np.zeros(len(whole.faces) - len(face), np.bool_)])
    with ThreadPoolExecutor(1) as beside:
        away = beside.submit(_away, dense, mesh, proxy, shown & (head.seen[rows][mesh.faces] > 0).all(1))
        step(1, 3, "measuring charts")
        given = np.arange(len(face)) < len(mesh.faces)
        quality = _skin_share(measure(whole, laid, face, given), laid, face)
        step(2, 3, "measuring distances")
        deviation, rough, against = away.result()
    step(3, 3, "done")
    span = float(np.ptp(whole.vertices, axis=0).max())
    findings = judge(quality, deviation, span, against, 0.0, crumpled(whole))
    return Built(whole, laid, proxy, quality, deviation, rough, (), findings, hair_faces=hairs)


def _others(
    mesh: Mesh, charts: Charts, shown: Mask, ears: F32, dense: Mesh, hair: Mask | None, config: Config
) -> tuple[list[tuple[Mesh, Charts]], int]:
    """What the scan shows beside the head, and hair last, each on the next tile; and the number of hair's faces."""
    vertices, faces, rows = meshes.compact(mesh.vertices, mesh.faces[shown])
    skin = Mesh(np.asarray(vertices, np.float32), mesh.normals[rows], faces)
    beside = beside_head(dense, skin, ears, hair)
    own = np.zeros(len(dense.faces), np.bool_) if hair is None else hair_faces(dense, hair, beside)
    rest = left_over(dense, beside, own)
    out, tile, hairs = list[tuple[Mesh, Charts]](), tiles.count(charts), 0
    for part in _parts(dense, rest, own, skin, config.target_faces // SHARE):
        hairs = 0
        if part is not None:
            laid = unwrap(part, config.changed(tiles=1, remesh="adaptive"))  # triangles
            out.append((part, Charts(laid.uvs + np.array([tile, 0], np.float32), laid.faces)))
            tile, hairs = tile + 1, len(part.faces)
    return out, hairs


def _parts(dense: Mesh, rest: Mask, hair: Mask, skin: Mesh, target: int) -> tuple[Mesh | None, Mesh | None]:
    """The rest and hair, given as faces (F,) of the dense mesh, with `target` faces each and rims beneath the skin."""
    if not (rest.any() or hair.any()):
        return None, None
    rimmed = with_rim(dense, rest | hair, skin)
    both = decimate.decimated(
        cut_out(rimmed.mesh, dense.faces[rimmed.faces]), target * (int(rest.any()) + int(hair.any()))
    )
    return parted(both, dense, rest, hair)


def _displaced(head: Head) -> tuple[F64, F64]:
    """(n, 3) points whose facets follow the fitted surface where it was seen, and their normals."""
    moved, quads = head.displaced(), head.surface()[2]
    normals = meshes.vertex_normals(moved, triangles_of(quads)).astype(np.float64)
    return lifted(moved, normals, quads, head.finer()), normals


def compacted(points: F64, normals: F64, quads: Indices) -> tuple[Mesh, Indices]:
    """A mesh of the vertices that quads (Q, 4) use, and their rows (n',)."""
    used, flat = np.unique(quads, return_inverse=True)
    faces = triangles_of(flat.reshape(-1, 4))
    return Mesh(points[used].astype(np.float32), normals[used].astype(np.float32), faces), np.asarray(used, np.int64)


def _charts(uvs: F64, quads: Indices) -> Charts:
    used, flat = np.unique(quads, return_inverse=True)
    return Charts(np.asarray(uvs[used], np.float32), triangles_of(flat.reshape(-1, 4)))


def _shown(head: Head, regions: tuple[str, ...], fine: Mask) -> Mask:
    """(F,) triangles of the skin's outside."""
    return np.asarray(np.repeat(np.repeat(outer_quads(head.region, regions), 4**head.levels)[fine], 2), np.bool_)


def _of_region(head: Head, regions: tuple[str, ...], fine: Mask, name: str) -> Mask:
    """(F,) triangles of a region."""
    own = head.region == regions.index(name) if name in regions else np.zeros(len(head.region), np.bool_)
    return np.asarray(np.repeat(np.repeat(own, 4**head.levels)[fine], 2), np.bool_)


def _skin_share(quality: Quality, charts: Charts, face: Mask) -> Quality:
    """The face's share of its own tile: eyes, teeth and the inside of the mouth have another one."""
    tile = tiles.of_face(charts)
    own = tile == np.bincount(tile[face]).argmax()
    return replace(quality, face_share=face_share(Charts(charts.uvs, charts.faces[own]), face[own]))


def _away(dense: Mesh, mesh: Mesh, proxy: Mesh, seen: Mask) -> tuple[Deviation, Deviation, float]:
    """Distances of the seen skin (F,) and of the proxy near the surface from the dense mesh, and the share of the seen
    skin that faces against it."""
    part = Mesh(mesh.vertices, mesh.normals, mesh.faces[seen])
    if not len(part.faces):
        return Deviation(0.0, 0.0), Deviation(0.0, 0.0), 0.0
    return _near(part, dense), _near(proxy, dense), decimate.flipped_share(dense, part)


def _near(mesh: Mesh, dense: Mesh) -> Deviation:
    d = decimate.one_way(mesh, dense, SAMPLES)
    d = d[d < NEAR]
    return Deviation(float(d.mean()), float(np.sqrt((d * d).mean()))) if len(d) else Deviation(0.0, 0.0)
