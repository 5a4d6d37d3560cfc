"""`neuface render --light`, `--field`: pictures by the reflectance field of a light stage's capture."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import UsageError
from workflows.cli.render import (
    CAPTURED,
    ENVIRONMENTS,
    RenderRequest,
    capture_from_asset_of,
    chosen_views,
    given_cameras,
    light_picture,
    put_picture,
)

if TYPE_CHECKING:
    from pipeline.camera import PinholeCamera
    from pipeline.transforms import F64
    from stages.reflectance.field import Field, Lamp

FOLDER = "reflectance"


def relit_pictures(
    request: RenderRequest,
    lights: Sequence[str],
    notify: Callable[[str], None] = lambda text: None,
    *,
    quick: bool,
    mesh: Path | None = None,
) -> Iterator[tuple[Path, float]]:
    """NAME.exr (linear RGBA, premultiplied) and NAME.png for each view; yields the EXR and its seconds, of which the
    first includes the shadows of all lamps. mesh: OBJ of the field's mesh, deformed.

    Raises:
        StageError: the run has no field, a file can't be read, or the mesh is not the field's. UsageError: a light or a
            view can't be read.
    """
    from stages.reflectance.deform import deformed
    from stages.reflectance.field import load
    from stages.reflectance.relight import look_up, picture, under_lamps

    start = time.perf_counter()
    folder = request.folder / FOLDER if (request.folder / FOLDER).is_dir() else request.folder
    field = load(folder) if mesh is None else deformed(load(folder), mesh)
    views = _views(request)
    capture_from_asset = capture_from_asset_of(request.folder)
    lamps = [lamp_from(text, capture_from_asset, field) for text in lights]
    if not lights or request.light != CAPTURED:
        lamps += environment(request.light, capture_from_asset, quick=quick)
    shown = [v.scaled(request.width) if request.width else v for v in views.values()]
    made = under_lamps(field, shown, lamps, lambda done, total: None)
    for name, view, lit in zip(views, shown, made, strict=True):
        rgba = picture(view, look_up(field, view, max(2, request.samples)), lit)
        yield put_picture(request.out, name, rgba, notify), time.perf_counter() - start
        start = time.perf_counter()


def lamp_from(text: str, capture_from_asset: F64, field: Field) -> Lamp:
    """The lamp of --light: position in the capture's world, and radiant intensity. It shines at the stage's centre."""
    from pipeline.transforms import apply, matrix, scale_of
    from stages.reflectance.field import Lamp

    try:
        numbers = [float(x) for x in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 6) or not np.isfinite(numbers).all() or min([0.0, *numbers[3:]]) < 0:
        raise UsageError(
            "a light can't be read",
            where="--light",
            value=text,
            limit="three numbers X,Y,Z, or six X,Y,Z,R,G,B, intensities not negative",
            remedy="for example --light 0.3,0.4,1.2,4,4,4",
        )
    scale = scale_of(capture_from_asset)
    position = apply(matrix(np.linalg.inv(capture_from_asset)), matrix([numbers[:3]]))[0]
    away = field.centre - position
    far = float(np.linalg.norm(away))
    if far < 0.5 * float(np.ptp(field.mesh.vertices, axis=0).max()):
        raise UsageError(
            "a light is inside the head, or too near to it",
            where="--light",
            value=f"{text}: {far * scale:.2f} from the stage's centre",
            limit="outside of the head",
            remedy="give the position in the capture's world, as in lights.json",
        )
    strength = np.array(numbers[3:] or [1.0, 1.0, 1.0]) / scale**2
    return Lamp(position, away / far, strength)


def environment(name: str, capture_from_asset: F64, *, quick: bool) -> list[Lamp]:
    """Distant lamps of --env: a made light or a file, as it stands in the capture's world."""
    from pipeline.maths import studio_lights
    from pipeline.transforms import scale_of
    from stages.reflectance.relight import lamps_of

    picture = light_picture(name)
    if picture is None:
        raise UsageError(
            "the reflectance field needs a light",
            where="--env",
            value=name,
            limit=f"{', '.join(studio_lights.LIGHTS)}, or a file {' or '.join(ENVIRONMENTS)}",
            remedy="give --light or --env",
        )
    turn = np.linalg.inv(capture_from_asset)[:3, :3]
    turn *= scale_of(capture_from_asset)
    return [replace(p, position=turn @ p.position, axis=turn @ p.axis) for p in lamps_of(picture, name, quick=quick)]


def _views(request: RenderRequest) -> dict[str, PinholeCamera]:
    from stages.usd.render.exported import read_cameras

    if request.turntable is not None:
        raise UsageError(
            "a turntable by the reflectance field is not made",
            where="--turntable",
            value=request.turntable,
            limit="the captured cameras, or --cameras",
            remedy="leave --turntable out",
        )
    if request.cameras is not None:
        found = given_cameras(request.cameras, request.folder)
    else:
        found = {i: view for i, (view, _) in read_cameras(request.folder / "asset" / "lookdev.usda").items()}
    return chosen_views(request.views, found, list(found))
