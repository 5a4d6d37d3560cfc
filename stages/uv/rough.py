"""Charts for rough surfaces: as many pieces as needed, so that every face has texture area and none is mirrored.

A rough surface can't be cut into a few discs. In each round all pieces that can't be parameterised without mirrored
triangles are split. What is left after ROUNDS, a few faces, is parameterised face by face. Fragments are then merged
with a neighbour if both together can be parameterised.

Symbols
    fragment  a chart with less than FRAGMENT of the area: it is useless for painting, and its seams are visible
    short     a face whose share of the texture is less than SHORT of its share of the surface: it has no texels
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Charts, Faces, Indices, Mask, Mesh
from stages.uv.charts import Surface, flats_of, laid_flat, surface_of, together
from stages.uv.parameterise import Flat, local_frames, signed_areas
from stages.uv.segment import connected, halved, segment

log = logging.getLogger("neuface.uv")
ROUNDS = 24  # of splitting; on a broken torso with 50,000 faces 12 rounds leave 0.1 % of the area
MAX_PIECES = 1500  # from this number on xatlas is faster
FRAGMENT = 5e-4  # of the area. For a head of 0.15 m^2: 75 mm^2, a square of 9 mm
MERGES = 300  # fragments that are tried, the smallest first: each takes 0.2 s with large neighbours
SHORT = 1e-3
MIN_HEIGHT = 1e-2  # of a face's length: height of faces without area, so that they have texels


def in_pieces(mesh: Mesh, smooth: F64, *, quads: bool = False) -> tuple[F64, Faces, Indices] | None:
    """Texture vertices (U, 2) at one common scale, faces (F, 3) into them and the chart (F,) of each; not packed. None
    if more than MAX_PIECES charts would be needed.

    smooth: (V, 3) smoothed vertices. quads: see `surface_of`.
    """
    surface = surface_of(mesh, smooth, quads=quads)
    label = segment(smooth, mesh.faces, surface.pairs, quads=quads)
    known: dict[bytes, Flat] = {}
    for _ in range(ROUNDS):
        flats = flats_of(surface, label, known)
        bad = [f for f in flats if not f.good and len(f.member) > 1]
        if not bad or len(flats) > MAX_PIECES:
            break
        label = _all_parted(surface, label, bad)
    flats = flats_of(surface, label, known)
    flats = _merged(surface, flats)
    log.info("uv: %d pieces, %d of them parameterised face by face", len(flats), sum(not f.good for f in flats))
    flats = [one for f in flats for one in ([f] if f.good else _face_by_face(surface, f))]
    if len(flats) > MAX_PIECES:
        return None
    return together(surface, flats)


def short(mesh: Mesh, charts: Charts) -> Mask:
    """(F,) faces whose area in the texture is far too small for their area on the surface."""
    t = np.abs(signed_areas(charts.uvs.astype(np.float64), charts.faces.astype(np.int64)))
    area = meshes.areas(mesh.vertices, mesh.faces)
    return np.asarray(t / max(float(t.sum()), 1e-30) < SHORT * area / max(float(area.sum()), 1e-30))


def _all_parted(surface: Surface, label: Indices, bad: list[Flat]) -> Indices:
    """Labels (F,) with each of the bad pieces split in two, across its longest direction in space."""
    for flat in bad:
        centre = surface.smooth[surface.faces[flat.member]].mean(1)
        centre = centre - centre.mean(0)
        place = np.zeros(len(label))
        place[flat.member] = centre @ np.linalg.svd(centre, full_matrices=False)[2][0]
        label = halved(place, label, int(label[flat.member[0]]), surface.area, surface.pairs)
    return connected(label, surface.pairs)


def _merged(surface: Surface, flats: list[Flat]) -> list[Flat]:
    """Merge fragments with the neighbour of the longest common border, if both together can be parameterised."""
    chart = np.zeros(len(surface.area), np.int64)
    for i, flat in enumerate(flats):
        chart[flat.member] = i
    size = np.bincount(chart, surface.area, len(flats)) / surface.area.sum()
    pairs = surface.pairs
    small = np.flatnonzero(size < FRAGMENT)
    for which in small[np.argsort(size[small], kind="stable")][:MERGES].tolist():
        a, b = chart[pairs.a], chart[pairs.b]
        border = (a == which) != (b == which)
        if not border.any():
            continue  # no neighbour, or already merged
        beside = np.where(a == which, b, a)[border]
        length = np.bincount(beside, pairs.length[border])
        for into in np.argsort(-length, kind="stable")[:3].tolist():
            if not length[into] or not flats[into].good:
                continue
            joint = laid_flat(surface, np.flatnonzero((chart == into) | (chart == which)))
            if joint.good:
                flats[into], flats[which] = joint, replace(flats[which], member=np.zeros(0, np.int64))
                chart[joint.member] = into
                break
    return [f for f in flats if len(f.member)]


def _face_by_face(surface: Surface, flat: Flat) -> list[Flat]:
    """Each face of a piece as a chart of its own, without stretch; a face without area gets the height MIN_HEIGHT."""
    faces = surface.faces[flat.member].astype(np.int64)
    frame = local_frames(surface.true, faces)
    span = float(np.ptp(surface.true, axis=0).max())
    frame[:, 1, 0] = np.maximum(frame[:, 1, 0], 1e-6 * span)
    frame[:, 2, 1] = np.maximum(frame[:, 2, 1], MIN_HEIGHT * frame[:, 1, 0])
    own = np.arange(3, dtype=np.int32)[None]
    return [Flat(flat.member[i : i + 1], own, frame[i], faces[i], good=True) for i in range(len(faces))]
