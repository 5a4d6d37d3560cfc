"""Checks whether the mesh has the face where the photos show it: compares the mesh with the photos' face landmarks.

Symbols: u_nl landmark l in photo n, pixels; x_l its 3D position, from all photos that agree (pipeline.faces); c_n the
photo's camera; p_nl the point of the mesh under u_nl; t_nl the distance from c_n to the mesh along the ray to x_l. The
depth of a landmark is |x_l - c_n| - t_nl: it is positive where the mesh hides the landmark.

On a turned face the network guesses the hidden landmarks, so only photos from the front are used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera, CameraSet, FittedFace, Located, MaskSet
from pipeline.faces.landmarks3d import head_frame, residuals
from pipeline.fitted_cameras import cameras_of
from pipeline.meshes import F64, Mesh
from pipeline.transforms import matrix, rays
from pipeline.verdict import Finding, Limits, judged
from pipeline.visibility import Occluder

EYES, NOSE, MOUTH = (33, 133, 263, 362), (1, 4), (61, 291)  # eye corners, nose tip, mouth corners
BRIDGE, CHIN, LIPS = (6, 168), (152,), (0, 13, 14, 17)
STABLE = (*EYES, *NOSE, *MOUTH, *BRIDGE, *CHIN)
HIDDEN = {"eyes": EYES, "nose": NOSE, "mouth": (*MOUTH, *LIPS)}
OUTER = 33, 263
OUTER_MM = 88.0  # between the outer corners of the eyes, for captures without a scale; adults have 80 to 100
FRONT = 0.75  # cosine to the face's front: 41 degrees
MIN_PHOTOS, MAX_PHOTOS, MAX_PAIRS = 3, 30, 200
# On a scanned head with exact cameras the landmarks are 2.2 mm (median) from the true surface, single ones up to 8 mm,
# and reproject with 3.4 mm. Where a wrong part of the visual hull hides the face: 58, 80 and 13 mm.
SHAPE = Limits(5.0, 12.0, lower=False)
BURIED = Limits(8.0, 12.0, lower=False)  # single landmarks are up to 8 mm off in depth on clean head scans
REPROJECTED = Limits(6.0, 10.0, lower=False)
REMEDY = (
    "the mesh does not have the face that the photos show: take photos from more directions (up to both profiles, from "
    "above and from below) with a still face, and check the masks"
)


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Cameras of the N photos that agree on a face; uv (N, 468, 2) pixels; xyz (468, 3) asset coordinates."""

    cameras: Sequence[Camera]
    uv: F64
    xyz: F64


class _Inputs(Protocol):
    @property
    def poses(self) -> Located[CameraSet]: ...
    @property
    def masks(self) -> Located[MaskSet]: ...
    @property
    def inverse_rendering(self) -> Located[FittedFace]: ...


def face_findings(inputs: _Inputs, mesh: Mesh) -> tuple[Finding, ...]:
    """The findings for a mesh; none if the photos agree on no face."""
    masks, poses = inputs.masks, cameras_of(inputs.poses.artifact, inputs.inverse_rendering.artifact)
    if masks.artifact.landmarks is None:
        return ()
    found = read(masks.path(masks.artifact.landmarks), {c.index: c for c in poses.cameras})
    return judge_face(mesh, found, metric=poses.metric)


def read(path: Path, cameras: Mapping[int, Camera]) -> Landmarks:
    """The photos that agree and have a camera (pipeline.artifacts.MaskSet.landmarks). cameras: by index."""
    with np.load(path, allow_pickle=False) as file:
        data = {k: file[k] for k in file.files}
    kept = data.get("kept", np.ones(len(data["views"]), np.bool_))
    use = [n for n, v in enumerate(data["views"].tolist()) if kept[n] and v in cameras]
    return Landmarks(
        [cameras[int(data["views"][n])] for n in use],
        data["uv"][use].astype(np.float64),
        data["xyz"].astype(np.float64),
    )


def judge_face(mesh: Mesh, found: Landmarks, *, metric: bool) -> tuple[Finding, ...]:
    """Distance along the rays, depth and reprojection; no findings if too few photos show the face from the front."""
    found = in_front(found)
    if len(found.cameras) < MIN_PHOTOS or not np.isfinite(found.xyz[list(STABLE)]).all():
        return ()
    mm = 1000.0 if metric else OUTER_MM / float(np.linalg.norm(np.subtract(*found.xyz[list(OUTER)])))
    occluder = Occluder(mesh)
    return (*_depth(mm * depths(found, occluder)), _again(*reprojected(found, occluder), mm))


def in_front(found: Landmarks) -> Landmarks:
    """The photos that show the face from the front; if there are many, an evenly spaced subset."""
    frame = head_frame(found.xyz)
    away = np.array([matrix(c.world_from_cam)[:3, 3] for c in found.cameras]).reshape(-1, 3) - frame.eyes
    use = np.flatnonzero(away @ frame.axes[2] > FRONT * np.linalg.norm(away, axis=1))
    use = use[:: max(1, -(-len(use) // MAX_PHOTOS))]
    return Landmarks([found.cameras[int(n)] for n in use], found.uv[use], found.xyz)


def depths(found: Landmarks, occluder: Occluder) -> F64:
    """(N, 468) depth of the landmarks in the mesh, asset units: minus infinity where the ray misses the mesh, NaN where
    a landmark has no 3D position."""
    out = []
    for camera in found.cameras:
        centre = matrix(camera.world_from_cam)[:3, 3]
        away = found.xyz - centre
        far = np.linalg.norm(away, axis=1)
        known = np.isfinite(far)
        depth = np.full(len(far), np.nan)
        depth[known] = far[known] - occluder.distance(centre, away[known] / far[known, None])
        out.append(depth)
    return np.stack(out)


def reprojected(found: Landmarks, occluder: Occluder) -> tuple[float, float]:
    """Median reprojection error: the mesh point under a landmark of one photo is projected into another photo and
    compared with the landmark there. In pixels, and in asset units at the face. Infinite where the mesh is missing."""
    stable = list(STABLE)
    at = [_under(c, uv[stable], occluder) for c, uv in zip(found.cameras, found.uv, strict=True)]
    middle = np.median(found.xyz[stable], 0)
    pairs = list(permutations(range(len(found.cameras)), 2))
    off, scaled = [], []
    for n, m in pairs[:: -(-len(pairs) // MAX_PAIRS)]:
        camera = found.cameras[m]
        pixels = residuals([camera], found.uv[m][None, stable], np.where(np.isfinite(at[n]), at[n], 0.0))[0]
        pixels = np.where(np.isfinite(at[n]).all(1), pixels, np.inf)
        far = float(np.linalg.norm(matrix(camera.world_from_cam)[:3, 3] - middle))
        off.append(pixels)
        scaled.append(pixels * far / np.sqrt(camera.K[0][0] * camera.K[1][1]))
    return float(np.median(off)), float(np.median(scaled))


def _under(camera: Camera, uv: F64, occluder: Occluder) -> F64:
    """(L, 3) points of the mesh under pixels uv (L, 2), infinite where the ray misses it."""
    o, d = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion), uv)
    far = occluder.distance(o, d)
    return np.asarray(np.where(np.isfinite(far)[:, None], o + np.nan_to_num(far, posinf=0.0)[:, None] * d, np.inf))


def _depth(mm: npt.NDArray[np.float64]) -> list[Finding]:
    """The findings for depths (N, 468) in millimetres."""
    shape = float(np.median(np.abs(mm[:, list(STABLE)])))
    where = (
        f"are {shape:.1f} mm (median) from the mesh along the rays of the photos"
        if np.isfinite(shape)
        else "are not on the mesh"
    )
    of = {name: float(np.nanmedian(mm[:, list(points)])) for name, points in HIDDEN.items()}
    deepest = max(of, key=lambda name: of[name])
    buried = max(of[deepest], 0.0)
    message = (
        f"{deepest}: {buried:.1f} mm behind the mesh, seen from the photos"
        if buried > BURIED.good
        else f"eyes, nose and mouth are on the mesh, at most {buried:.1f} mm behind it"
        if np.isfinite(list(of.values())).all()
        else "the mesh hides no part of the face"
    )
    return [
        judged("face_shape_mm", shape, SHAPE, f"the face's landmarks {where}", REMEDY, unit="mm"),
        judged("nose_buried_mm", buried, BURIED, message, REMEDY, unit="mm"),
    ]


def _again(pixels: float, distance: float, mm: float) -> Finding:
    message = (
        f"reprojection error of the face landmarks, from one photo over the mesh into another: {pixels:.1f} pixels "
        f"({mm * distance:.1f} mm), median"
        if np.isfinite(distance)
        else "the mesh is missing where the photos show the face landmarks"
    )
    return judged("face_reprojection_mm", mm * distance, REPROJECTED, message, REMEDY, unit="mm")
