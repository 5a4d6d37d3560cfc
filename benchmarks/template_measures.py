"""What `benchmarks.template_figures` measures on a finished run whose asset is made from the head template.

Lengths in millimetres. Nothing here uses the distances, shares or landmarks that the stages themselves report: surfaces
are compared by exact distances to triangles, and files are read as any other program reads them.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import meshes
from pipeline.artifacts import CameraSet, Located
from pipeline.camera import PinholeCamera
from pipeline.head_artifacts import FittedEye, RegisteredHead
from pipeline.meshes import F64, Charts, Mask, Mesh, triangles_of
from pipeline.registration.head import Head, kept_quads, load_head
from pipeline.registration.quality import face_piercings, face_quads, outer_quads
from pipeline.transforms import apply, matrix, scale_of
from workflows.bench.captures_figures import Run
from workflows.evaluation import geometry, rendered_person

POINTS = 20_000  # on the seen skin
NOT_SKIN = ("pupil", "eye_centre")  # names of the truth that are no place of the skin


@dataclass(frozen=True, slots=True)
class Made:
    """A run's registered head and the mesh that the asset shows: its first triangles are the head's."""

    run: Run
    artifact: RegisteredHead
    head: Head
    mesh: Mesh
    charts: Charts

    @property
    def own(self) -> int:
        """Number of triangles of the head; what follows is hair and clothes."""
        return 2 * 4**self.head.levels * int(kept_quads(self.head, self.artifact.regions).sum())


def made_of(run: Run) -> Made:
    """Read it. ValueError if the template was not registered, or the asset is the scan's."""
    artifact = RegisteredHead.model_validate(run.manifest("template"))
    if artifact.head is None or not run.manifest("uv").get("of_template"):
        why = artifact.reason or "the run has uv.mesh=scan"
        raise ValueError(f"{run.out.name} has no registered template: {why}")
    path = run.path("uv", run.manifest("uv")["mesh"])
    head = load_head(run.path("template", artifact.head.model_dump()))
    return Made(run, artifact, head, meshes.load(path), meshes.load_charts(path))


# ------------------------------------------------------------------ the layout
def face_share(made: Made) -> float:
    """Share of the skin's tile (the unit square) that lies under the face, with brows, lids, lips and nose."""
    head, face = made.head, np.flatnonzero(_face_of_cage(made))
    at = head.uvs[triangles_of(head.uv_quads[face])]
    a, b = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def off_upright(made: Made) -> float:
    """Degrees between v and the image of the head's up direction in the texture, mean over the face's area."""
    head, face = made.head, np.flatnonzero(_face_of_cage(made))
    up = matrix(made.artifact.world_from_template)[:3, 1]
    rows, uv_rows = triangles_of(head.quads[face]), triangles_of(head.uv_quads[face])
    return abs(tilt(head.vertices[rows], head.uvs[uv_rows], up))


def tilt(corners: F64, uvs: F64, up: F64) -> float:
    """Degrees from v to the mean image of a direction up (3,): corners (F, 3, 3), uvs (F, 3, 2). Positive: to +u."""
    edge = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], 2)  # (F, 3, 2)
    along = np.linalg.pinv(edge) @ up  # the part of `up` in the triangle's plane, in its edges
    step = np.stack([uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]], 2)
    image = (step @ along[..., None])[..., 0]
    area = 0.5 * np.linalg.norm(np.cross(edge[..., 0], edge[..., 1]), axis=1)
    mean = (image * area[:, None]).sum(0)
    return float(np.degrees(np.arctan2(mean[0], mean[1])))


def _face_of_cage(made: Made) -> Mask:
    return face_quads(made.head, made.artifact.regions)[:: 4**made.head.levels]


# ------------------------------------------------------------------ the surface
def from_surface(made: Made, dense: Mesh, cameras: list[PinholeCamera]) -> tuple[float, float]:
    """Median and 95 % of the distance of the displaced head's seen skin from the fitted surface: skin whose outside
    three fitted photos see, on the asset with its hair and clothes."""
    import trimesh

    whole = trimesh.Trimesh(made.mesh.vertices, made.mesh.faces, process=False)
    kept = kept_quads(made.head, made.artifact.regions)
    shown = outer_quads(made.head.region, made.artifact.regions)[kept]
    rows = np.flatnonzero(np.repeat(shown, 2 * 4**made.head.levels))
    skin = trimesh.Trimesh(made.mesh.vertices, made.mesh.faces[rows], process=False)
    points, normals = geometry.spread(skin, POINTS)
    count = sum(geometry.visible(whole, points, normals, c).astype(int) for c in cameras)
    seen = points[np.asarray(count) >= geometry.SEEN_BY]
    if not len(seen):
        raise ValueError("no three photos see the same skin")
    away = 1000 * geometry.distances(trimesh.Trimesh(dense.vertices, dense.faces, process=False), seen)
    return float(np.median(away)), float(np.quantile(away, 0.95))


def crossings(made: Made) -> int:
    """Edges of the displaced face that pass through another part of it."""
    return face_piercings(made.head, made.artifact.regions)


# ------------------------------------------------------------------ the files
def quads_of(usd: Path) -> tuple[int, int]:
    """Quads and other faces of the control cage in an asset's USD."""
    from pxr import Usd, UsdGeom

    from stages.usd.write.cage import is_cage

    stage = Usd.Stage.Open(str(usd))
    cages = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh) and is_cage(UsdGeom.Mesh(p))]
    counts = np.concatenate([np.asarray(m.GetFaceVertexCountsAttr().Get()) for m in cages] or [np.zeros(0, int)])
    return int((counts == 4).sum()), int((counts != 4).sum())


def shapes_in_usd(usd: Path) -> tuple[str, ...]:
    """Names of the blend shapes of the skeleton's animation."""
    from pxr import Usd, UsdSkel

    stage = Usd.Stage.Open(str(usd))
    found = [UsdSkel.Animation(p) for p in stage.Traverse() if p.IsA(UsdSkel.Animation)]
    return tuple(str(n) for a in found for n in a.GetBlendShapesAttr().Get() or ())


def shapes_in_glb(glb: Path) -> tuple[str, ...]:
    """Names of the morph targets of a binary glTF's first mesh that has some."""
    data = glb.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    named = (m.get("extras", {}).get("targetNames", []) for m in document["meshes"])
    return tuple(next((n for n in named if n), []))


# ------------------------------------------------------------------ rendered persons
@dataclass(frozen=True, slots=True)
class Person:
    """A run of a rendered person in the truth's frame. truth_from_asset: the cameras' similarity, refined on seen skin;
    scale: metres of the truth per unit of the asset, by the cameras alone; marks: places of the skin by name."""

    made: Made
    truth_from_asset: F64
    scale: float
    marks: dict[str, F64]
    truth: Path


def person_of(made: Made, truth: Path) -> Person:
    """Place a run in the frame of its truth. ValueError if fewer than three cameras are known."""
    import trimesh

    cameras = rendered_person.true_cameras(truth)
    placed = rendered_person.head_from_asset(made.run, cameras)
    if placed is None:
        raise ValueError(f"{made.run.out.name}: fewer than three cameras have a truth")
    skin = trimesh.load(truth / "skin.obj", process=False, force="mesh")
    points, normals = geometry.spread(skin, rendered_person.POINTS)
    seen = rendered_person.sight_of(skin, points, normals, cameras, truth).sum(1) >= rendered_person.SEEN_BY
    asset, _ = geometry.asset_mesh(made.run.out / made.run.record["asset"], placed)
    refined = rendered_person.refined(asset, points[seen])
    named = json.loads((truth / "landmarks.json").read_text())
    marks = {
        k: np.array(v, np.float64)
        for k, v in named.items()
        if isinstance(v, list) and len(v) == 3 and not k.startswith(NOT_SKIN)
    }
    return Person(made, refined @ placed, scale_of(placed), marks, truth)


def places_on_head(person: Person) -> dict[str, tuple[int, F64]]:
    """By landmark: triangle of the head's mesh and barycentric weights (3,) of the place nearest to the truth."""
    import trimesh

    made, names = person.made, list(person.marks)
    points = apply(person.truth_from_asset, made.mesh.vertices.astype(np.float64))
    outside = _outside(made)
    skin = trimesh.Trimesh(points, made.mesh.faces[outside], process=False)
    where, _, face = trimesh.proximity.closest_point_naive(skin, np.stack([person.marks[n] for n in names]))
    weights = trimesh.triangles.points_to_barycentric(skin.triangles[face], where)
    return {n: (int(outside[f]), np.asarray(w)) for n, f, w in zip(names, face, weights, strict=True)}


def uvs_of(person: Person) -> dict[str, F64]:
    """(2,) texture coordinates of each landmark's place, in sides of the tile."""
    charts = person.made.charts
    return {n: w @ charts.uvs[charts.faces[f]].astype(np.float64) for n, (f, w) in places_on_head(person).items()}


def carried_landmarks(person: Person, other: Person) -> dict[str, float]:
    """Millimetres between a person's true landmarks and the places of its head that are the other's landmarks: same
    triangle, same weights. Both heads have one topology."""
    mesh = person.made.mesh
    out = {}
    for name, (face, weights) in places_on_head(other).items():
        if name in person.marks:
            place = apply(person.truth_from_asset, (weights @ mesh.vertices[mesh.faces[face]])[None])[0]
            out[name] = 1000 * float(np.linalg.norm(place - person.marks[name]))
    return out


def uv_differences(person: Person, other: Person) -> dict[str, float]:
    """Distance of each landmark's texture coordinates on two persons, in sides of the tile."""
    mine, theirs = uvs_of(person), uvs_of(other)
    return {n: float(np.linalg.norm(mine[n] - theirs[n])) for n in mine if n in theirs}


def pupil_errors(person: Person) -> dict[str, float]:
    """Millimetres between the front of each fitted eye along its gaze and the true pupil."""
    named = json.loads((person.truth / "landmarks.json").read_text())
    out = {}
    for eye in person.made.artifact.eyes:
        side = eye.part.removeprefix("eye_")
        front = apply(person.truth_from_asset, front_of(eye)[None])[0]
        out[side] = 1000 * float(np.linalg.norm(front - np.array(named[f"pupil_{side}"])))
    return out


def front_of(eye: FittedEye) -> F64:
    """(3,) the place of a fitted eye's ball along its gaze, asset coordinates."""
    return np.array(eye.centre) + eye.radius * np.array(eye.axes)[2]


def _outside(made: Made) -> F64:
    """Rows of the triangles of the skin's outside."""
    kept = kept_quads(made.head, made.artifact.regions)
    shown = outer_quads(made.head.region, made.artifact.regions)[kept]
    return np.flatnonzero(np.repeat(shown, 2 * 4**made.head.levels))


# ------------------------------------------------------------------ cost
def cameras_of(run: Run) -> list[PinholeCamera]:
    """The fitted photos' cameras, asset coordinates."""
    poses = CameraSet.model_validate(run.manifest("poses"))
    fitted = set(run.manifest("inverse_rendering")["fitted_views"])
    held = {v["index"] for v in run.manifest("capture")["views"] if v.get("holdout")}
    return [
        PinholeCamera(matrix(c.K), matrix(c.world_from_cam), c.width, c.height, np.array(c.distortion))
        for c in poses.cameras
        if c.index in fitted - held
    ]


def processor_seconds(run: Run) -> float:
    """Processor time of the template stage, run once more on the same inputs, in a folder that is thrown away."""
    import tempfile
    import time

    from pipeline.contract import execute
    from pipeline.store import Store
    from stages.registry import REGISTRY

    stage = next(s for s in REGISTRY if s.name == "template")
    kinds: dict[str, Any] = {s.name: s.output for s in REGISTRY}
    inputs = stage.inputs(
        **{
            n: Located(kinds[n].model_validate(run.manifest(n)), run.folder(n))
            for n in stage.inputs.__dataclass_fields__
        }
    )
    config = stage.config(enabled=True, levels=int(run.manifest("template")["levels"]))
    with tempfile.TemporaryDirectory() as folder:
        before = time.process_time()
        execute(stage, inputs, config, Store(Path(folder)))
        return time.process_time() - before
