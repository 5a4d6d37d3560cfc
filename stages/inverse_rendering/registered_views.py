"""The held-out photos from registered cameras.

Held-out photos have cameras with errors of their own, which are not the model's. After the fit, each is registered
alone to the finished model, and predicted a second time. The fit never reads them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.artifacts import CameraSet, HeldOutView, Located, MaskSet, RefinedCamera, RegisteredView
from pipeline.capture_artifacts import Capture
from pipeline.colour import as_photographed
from pipeline.contract import Context
from pipeline.fields.face import FaceModel
from pipeline.images import write_exr
from pipeline.maths.rigid_motion import camera_of_moved
from pipeline.transforms import matrix, rows
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.load_views import camera_only, read_views
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.registration import register
from stages.inverse_rendering.sight import pair_of


def registered_views(
    model: FaceModel,
    capture: Located[Capture],
    poses: CameraSet,
    masks: Located[MaskSet],
    predicted: Sequence[HeldOutView],
    config: Config,
    context: Context,
) -> tuple[RegisteredView, ...]:
    """Register each held-out photo that has a mask, and write its prediction, registered/I.exr. None of a model that is
    not our own."""
    if model.spec.geometry != "grid":
        return ()
    cut = {m.index for m in masks.artifact.masks}
    exposure = {v.index: v.exposure for v in capture.artifact.views}
    cameras = {c.index: c for c in poses.cameras}
    wanted = [v for v in predicted if v.index in cut]
    out = []
    for n, held in enumerate(wanted):
        context.check()
        context.progress(n, len(wanted), "registering held-out views")
        view = read_views(capture, poses, masks, [held.index], config.image_side)[0]
        response = matrix(held.response)
        pair = pair_of(model, view, response / exposure[held.index], config.image_side, config.samples, context.device)
        found = register(pair)
        six = found.xi if found.better else np.zeros(6)
        camera = cameras[held.index]
        pose = camera_of_moved(view.world_from_cam, six)
        moved = camera_only(camera.model_copy(update={"world_from_cam": rows(pose)}))
        rgba = as_photographed(predict_view(model, moved, held.scale, config.samples, context.device), held.response)
        exr = f"registered/{held.index}.exr"
        write_exr(context.workdir / exr, rgba, half=True)
        factor = camera.width / view.size[0] * pair.factor
        refined = RefinedCamera(
            index=held.index, world_from_cam=rows(pose), pixels=round(factor * found.pixels(six), 4)
        )
        out.append(RegisteredView(camera=refined, exr=context.file(exr)))
    return tuple(out)
