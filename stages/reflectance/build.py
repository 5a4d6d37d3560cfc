"""The order of the stage's steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.artifacts import (
    Camera,
    CameraSet,
    Located,
    MaskSet,
    UvMesh,
)
from pipeline.capture_artifacts import Capture, LightStage
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import read_linear
from pipeline.maths.rigid_motion import motion_matrix
from pipeline.ray_casting import RayCaster
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.transforms import F64, matrix, rows
from stages.reflectance import motion as moves
from stages.reflectance.deform import REST, write_rest
from stages.reflectance.evidence import FOLDER as SHOWN
from stages.reflectance.evidence import fewer_lamps, listed, write_pictures
from stages.reflectance.field import Field, centre_of, save
from stages.reflectance.find_corneas import find_corneas, lids_of
from stages.reflectance.judge import judge
from stages.reflectance.layer import standard_of
from stages.reflectance.openpbr import NAME as OPENPBR
from stages.reflectance.openpbr import OpenPbr
from stages.reflectance.paint import marked, read_masks, replaced
from stages.reflectance.pooled import Pooled
from stages.reflectance.reshape import reshaped
from stages.reflectance.rig import Rig, rig_of
from stages.reflectance.samples import Step, gather
from stages.reflectance.score import Score, decibels, score
from stages.reflectance.sidecar import write_sidecar
from stages.reflectance.split import Fitted, chosen_widths, split
from stages.reflectance.texels import Pairs, Points, arriving_of_all, known_surface, pairs_of, points_of

if TYPE_CHECKING:
    from stages.reflectance.config import Config

FEWEST_LIGHTS = 8  # a texel has eight numbers
OFFSET = 3  # of the lights that are left out
TRACKED = 20_000  # points of the surface that say how the head moved
BRIGHT, LEVEL = 0.99, 0.9  # this quantile of a lit picture is shown as this value when pictures are compared
FOLDER = "reflectance"


@dataclass(frozen=True, slots=True)
class _Predicted:
    """Scores of the pictures under left-out lights, and the gain of the display that they are for."""

    scores: tuple[Score, ...]
    gain: float


def build(
    capture: Located[Capture],
    poses: Located[CameraSet],
    masks: Located[MaskSet],
    uv: Located[UvMesh],
    config: Config,
    context: Context,
) -> ReflectanceField:
    """The field of a light stage's capture, written below the work folder."""
    stage = capture.artifact.stage
    assert stage is not None

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    path = uv.path(uv.artifact.mesh)
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    points, caster = points_of(mesh, charts, config.size), RayCaster(mesh.vertices, mesh.faces)
    cameras = [c for c in poses.artifact.cameras if c.index in {f.camera for f in stage.frames}]
    kept_out = {config.camera, *(v.index for v in capture.artifact.views if v.holdout)}
    fitted_cameras = [c for c in cameras if c.index not in kept_out]
    _enough(len(fitted_cameras), 1, "cameras")
    six, pivot = _tracked(capture, stage, points, fitted_cameras, caster, config, step)
    at = {f: motion_matrix(v, pivot) for f, v in six.items()}
    world = matrix(poses.artifact.capture_from_asset).reshape(4, 4)
    whole = rig_of(stage.lights, cameras, world, at)
    left_out = [i for i in range(len(whole.index)) if config.every and i % config.every == OFFSET % config.every]
    fitted = [i for i in range(len(whole.index)) if i not in left_out]
    _enough(len(fitted), FEWEST_LIGHTS, "lights")
    rig = rig_of([stage.lights[i] for i in fitted], fitted_cameras, world, at)
    given = mesh
    pictures = _pictures(capture, stage, rig)
    if config.reshape:
        mesh = reshaped(mesh, rig, pictures, context.scratch, context.check, step)
        points, caster = points_of(mesh, charts, config.size), RayCaster(mesh.vertices, mesh.faces)
    pairs = pairs_of(points, fitted_cameras, caster)
    field, parts = fitted_field(
        mesh, charts, points, pairs, rig, pictures, config, context.scratch, context.check, step
    )
    field = field.with_corneas(find_corneas(field, rig, pictures, lids_of(masks, rig), step))
    motion = {str(f): rows(m.round(9)) for f, m in sorted(at.items())}
    record = {"lights": rig.index, "left_out": [whole.index[i] for i in left_out], "motion": motion}
    save(field, context.workdir / FOLDER, record | write_sidecar(field, context.workdir / FOLDER))
    write_rest(context.workdir / FOLDER / REST, mesh, charts)
    figures = _figures(field, parts, points, pairs, six) | {"moved_mm": _moved(given, mesh)}
    figures |= {"corneas": float(len(field.corneas))}
    shots = _pictures(capture, stage, whole)
    unseen = [n for n, c in enumerate(cameras) if c.index in kept_out]
    found = _predicted(field, whole, shots, fitted, left_out, step)
    figures |= _scored(found, unseen)
    seen = np.zeros(len(points.texel), np.bool_)
    seen[pairs.texel[pairs.camera == 0]] = True
    eye = matrix(fitted_cameras[0].world_from_cam)[:3, 3]
    figures |= fewer_lamps(field, eye, seen, lambda d, n: step(d, n, "an environment by fewer lamps"))
    shown = write_pictures(field, whole, shots, found.scores, found.gain, context.workdir / SHOWN)
    files = sorted(p.relative_to(context.workdir) for p in (context.workdir / FOLDER).iterdir())
    return ReflectanceField(
        present=True,
        files=tuple(context.file(p) for p in files),
        size=config.size,
        lights=len(fitted),
        left_out=tuple(whole.index[i] for i in left_out),
        cameras=tuple(c.index for c in cameras if c.index in kept_out),
        alphas=field.alphas,
        motion=motion,
        figures=figures,
        predicted=listed(found.scores, whole),
        shown=tuple(context.file(p) for p in shown),
        findings=judge(figures),
    )


def _enough(count: int, least: int, what: str) -> None:
    if count < least:
        raise StageError(
            f"too few {what} are left for the fit of the reflectance",
            where="reflectance.every, reflectance.camera",
            value=count,
            limit=f"at least {least} {what}",
            remedy="leave fewer out",
        )


def _pictures(capture: Located[Capture], stage: LightStage, rig: Rig) -> dict[tuple[int, int], Path]:
    cameras = {c.index: n for n, c in enumerate(rig.cameras)}
    lights = {index: n for n, index in enumerate(rig.index)}
    return {
        (cameras[f.camera], lights[f.number]): capture.path(f.image)
        for f in stage.frames
        if f.camera in cameras and f.number in lights
    }


def _tracked(
    capture: Located[Capture],
    stage: LightStage,
    points: Points,
    cameras: Sequence[Camera],
    caster: RayCaster,
    config: Config,
    step: Step,
) -> tuple[dict[int, F64], F64]:
    """Six numbers of the head's motion at each frame of a light or a tracking picture, and their pivot."""
    pivot = np.asarray(points.position.mean(0), np.float64)
    frames = sorted({light.frame for light in stage.lights} | {t.number for t in stage.tracking})
    shown = {(t.camera, t.number): capture.path(t.image) for t in stage.tracking}
    times = sorted({t.number for t in stage.tracking})
    if not config.motion or len(times) < 2:
        return dict.fromkeys(frames, np.zeros(6)), pivot
    used = [c for c in cameras if all((c.index, f) in shown for f in times)]
    seen = pairs_of(points, used, caster)
    surface = [points.position[seen.texel[seen.camera == n]] for n in range(len(used))]
    thin = [p[:: max(1, len(p) * len(used) // TRACKED)] for p in surface]
    if not used or sum(map(len, thin)) < moves.FEWEST:
        return dict.fromkeys(frames, np.zeros(6)), pivot
    first = [moves.prepared(read_linear(shown[c.index, times[0]]), stage.gain) for c in used]
    poses = {times[0]: np.zeros(6)}
    for n, frame in enumerate(times[1:]):
        step(n, len(times), "motion of the head")
        later = [moves.prepared(read_linear(shown[c.index, frame]), stage.gain) for c in used]
        poses[frame] = moves.pose_between(thin, used, first, later, pivot)
    moves.checked(poses)
    return moves.path(poses, frames), pivot


def fitted_field(
    mesh: meshes.Mesh,
    charts: meshes.Charts,
    points: Points,
    pairs: Pairs,
    rig: Rig,
    pictures: Mapping[tuple[int, int], Path],
    config: Config,
    scratch: Path,
    check: Callable[[], None],
    step: Step,
) -> tuple[Field, Fitted]:
    """The field of a mesh and what was fitted. pictures: as for `gather`; scratch: folder for samples, which are
    removed."""
    table = gather(scratch / "samples.npy", points, pairs, rig, pictures, step)
    lamps, axes = rig.lamps()
    step(0, 1, "shadows")
    blocker = RayCaster(mesh.vertices, known_surface(mesh, points, pairs.seen))
    arrives = arriving_of_all(points, blocker, lamps, axes, check)
    alphas = chosen_widths(points, pairs, table, rig, arrives, config.normal_prior, step)
    parts = split(points, pairs, table, rig, arrives, alphas, config.normal_prior, config.order, step)
    step(0, 1, "filling what no camera saw")
    pooled = Pooled(points, pairs, parts.albedo.astype(np.float64))
    parts = replace(parts, lobes=pooled(parts.lobes), rest=pooled(parts.rest))
    flat = parts.rest.reshape(len(parts.rest), -1)
    marks = marked(read_masks(Path(config.paint)), points) if config.paint else np.zeros(len(flat), np.bool_)
    standard = standard_of(parts.layers, points.position)
    standard[:, 3:] = pooled(standard[:, 3:])
    fitted = np.concatenate([parts.albedo, parts.lobes, standard, flat], 1)
    filled = replaced(fitted, marks, pairs.sure, points.position)
    parts = _unmarked(parts, marks, points)
    arrays: dict[str, npt.NDArray[Any]] = {
        "albedo": filled[:, :3], "lobes": filled[:, 3:6], "normal": parts.normal, "rest": filled[:, 11:],
        OPENPBR: filled[:, 6:11],
        "shadow": parts.shadow, "trust": parts.trust, "coverage": pairs.seen[:, None].astype(np.float32),
    }  # fmt: skip
    field = Field(mesh, charts, points, arrays, alphas, rig.towards, centre_of(rig.position, rig.axis))
    (scratch / "samples.done").unlink()
    (scratch / "samples.npy").unlink()
    return field, parts


def _unmarked(parts: Fitted, marks: npt.NDArray[np.bool_], points: Points) -> Fitted:
    """Normals and shadows of marked texels as around them."""
    if not marks.any():
        return parts
    both = np.concatenate([parts.shadow, parts.trust], 1).astype(np.float32)
    found = replaced(both, marks, np.ones_like(marks), points.position).astype(np.float16)
    lights = parts.shadow.shape[1]
    normal = np.where(marks[:, None], points.normal, parts.normal).astype(np.float32)
    return replace(parts, normal=normal, shadow=found[:, :lights], trust=found[:, lights:])


def _figures(field: Field, parts: Fitted, points: Points, pairs: Pairs, six: Mapping[int, F64]) -> dict[str, float]:
    seen = pairs.seen
    turned = np.degrees(np.arccos(np.clip((parts.normal[seen] * points.normal[seen]).sum(1), -1, 1)))
    texels = float(seen.sum()) or 1.0
    figures = {
        "seen": float(seen.mean()),
        "motion_mm": 1000 * max(float(np.linalg.norm(v[3:])) for v in six.values()),
        "motion_degrees": float(np.degrees(max(float(np.linalg.norm(v[:3])) for v in six.values()))),
        "normals_turned_degrees": float(np.median(turned)) if turned.size else 0.0,
        "f0": float(field.f0[seen].sum() / texels),
        "roughness": float(field.roughness[seen].sum() / texels),
        "error": float(np.sqrt(np.mean(parts.error[seen] ** 2))) if seen.any() else 0.0,
    }
    return {k: round(v, 5) for k, v in figures.items()}


def _moved(given: meshes.Mesh, mesh: meshes.Mesh) -> float:
    """Millimetres by which the farther tenth of the vertices was moved at least."""
    far = np.linalg.norm((mesh.vertices - given.vertices).astype(np.float64), axis=1)
    return round(1000 * float(np.quantile(far, 0.9)), 3) if far.size else 0.0


def _predicted(
    field: Field,
    rig: Rig,
    pictures: dict[tuple[int, int], Path],
    fitted: Sequence[int],
    left_out: Sequence[int],
    step: Step,
) -> _Predicted:
    wanted = [(c, i) for i in left_out for c in range(len(rig.cameras)) if (c, i) in pictures]
    if not wanted:
        return _Predicted((), 1.0)
    tops = [float(np.quantile(read_linear(pictures[key]).max(2), BRIGHT)) for key in wanted]
    gain = LEVEL / max(float(np.quantile(tops, 0.75)), 1e-9)
    found = score(field, rig, pictures, fitted, wanted, gain, lambda d, n: step(d, n, "predicting left-out lights"),
                  standard=OpenPbr.of(field))  # fmt: skip
    return _Predicted(tuple(found), gain)


def _scored(found: _Predicted, unseen: Sequence[int]) -> dict[str, float]:
    """Figures of the left-out lights; unseen: places of the cameras that were left out too."""
    if not found.scores:
        return {}
    other = [s.field for s in found.scores if s.camera in unseen]
    return {
        **({"left_out_camera_psnr": decibels(other)} if other else {}),
        "left_out_psnr": decibels([s.field for s in found.scores]),
        "blend_psnr": decibels([s.blend for s in found.scores]),
        "openpbr_psnr": decibels([s.standard for s in found.scores]),
        "left_out_angle": round(float(np.mean([s.angle for s in found.scores])), 2),
        "display_gain": round(found.gain, 5),
    }
