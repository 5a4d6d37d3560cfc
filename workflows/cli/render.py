"""`neuface render`: pictures of an exported asset, from any of a capture's cameras or around it, under any light."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import StageError, UsageError
from workflows.run.owned import partial_name, put_owned

if TYPE_CHECKING:
    from pipeline.camera import PinholeCamera
    from pipeline.images import F32
    from pipeline.transforms import F64
    from stages.usd.render.render import CarriedLight, Light, Renderer

CAPTURED = "captured"
TURNTABLE_SIDE = 1024  # pixels
ENVIRONMENTS = (".exr", ".hdr")
MADE_WIDTH = 256  # columns of the picture of a made light


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """The options of the command."""

    folder: Path
    out: Path
    light: str = CAPTURED
    cameras: Path | None = None
    views: str | None = None
    turntable: int | None = None
    width: int | None = None
    samples: int = 0


def render_pictures(
    request: RenderRequest, notify: Callable[[str], None] = lambda text: None
) -> Iterator[tuple[Path, float]]:
    """NAME.exr (linear RGBA, premultiplied) and NAME.png for each view; yields the EXR and the seconds it took.

    A file of the user's own of such a name, a photo for example, is renamed to NAME.yours-N, and `notify` is called.

    Raises:
        StageError: something of the asset, the cameras or the light is missing or damaged. UsageError: no such view.
    """
    from stages.usd.render.exported import load_exported
    from stages.usd.render.render import Renderer

    root = component_in(request.folder)
    renderer = Renderer(load_exported(root))
    views = _views(request, root, renderer)
    light = light_named(request.light, renderer, root)
    for name, view in views.items():
        start = time.perf_counter()
        shown = view.scaled(request.width) if request.width else view
        rgba = renderer.render(shown, samples=request.samples, light=light)
        yield put_picture(request.out, name, rgba, notify), time.perf_counter() - start


def put_picture(folder: Path, name: str, rgba: Any, notify: Callable[[str], None]) -> Path:
    """Write NAME.exr and NAME.png of a picture (H, W, 4), linear and premultiplied; a foreign file of that name is
    kept aside. Returns the path of the EXR."""
    from pipeline.images import write_exr
    from stages.usd.render.previews import write_rgba_png

    put_file(folder, f"{name}.exr", write_exr, rgba, notify)
    put_file(folder, f"{name}.png", write_rgba_png, rgba, notify)
    return folder / f"{name}.exr"


def put_file(
    folder: Path, name: str, write: Callable[[Path, Any], None], content: Any, notify: Callable[[str], None]
) -> None:
    """Write folder/name by `write`; a foreign file of that name is kept aside, and `notify` is called."""
    made = partial_name(folder, name)
    try:
        write(made, content)
        aside = put_owned(folder, name, made)
        if aside is not None:
            notify(f"{folder / name} is yours: kept as {folder / aside}")
    finally:
        made.unlink(missing_ok=True)


def component_in(folder: Path) -> Path:
    """NAME.usd of a run's folder, of its asset folder, or the file itself."""
    if folder.is_file():
        return folder
    for place in (folder / "asset", folder):
        found = sorted(p for p in place.glob("*.usd"))
        if found:
            return found[0]
    raise StageError(
        "there is no asset to render",
        where=folder,
        value="no .usd file",
        limit="a run's folder, or its asset folder",
        remedy="name the folder that was given as --out",
    )


def light_named(name: str, renderer: Renderer, root: Path) -> Light | CarriedLight | None:
    """The light of --env for one asset in the folder root: None for the captured light, a made one, or a file's.

    Raises:
        StageError: the file can't be read, or holds no light.
    """
    from pipeline.maths import studio_lights
    from stages.usd.render.previews import captured
    from stages.usd.render.relight import Environment
    from stages.usd.render.standard_light import StandardLight

    if name == CAPTURED:
        return captured(renderer, root)
    kind = Environment if renderer.asset.f0 is None else StandardLight
    picture, path = light_picture(name), Path(name)
    if picture is None:
        raise StageError(
            "this light can't be read",
            where=name,
            value="no such file" if not path.is_file() else f"a {path.suffix or 'nameless'} file",
            limit=f"{CAPTURED}, {', '.join(studio_lights.LIGHTS)}, or a file {' or '.join(ENVIRONMENTS)}",
            remedy="give --env an equirectangular picture",
        )
    return kind(renderer, picture, path.name)


def light_picture(name: str) -> F32 | None:
    """The lat-long picture of a made light or of a file; None if the name is neither's."""
    from pipeline.images import read_linear
    from pipeline.maths import studio_lights

    if name in studio_lights.LIGHTS:
        return studio_lights.picture(name, MADE_WIDTH)
    path = Path(name)
    return read_linear(path) if path.suffix.lower() in ENVIRONMENTS and path.is_file() else None


def _views(request: RenderRequest, root: Path, renderer: Renderer) -> dict[str, PinholeCamera]:
    from stages.usd.render.exported import read_cameras
    from stages.usd.render.previews import framing

    if request.turntable is not None:
        turns = 2 * np.pi * np.arange(request.turntable) / request.turntable
        return {f"turn_{i:03d}": framing(renderer, float(t), TURNTABLE_SIDE) for i, t in enumerate(turns)}
    if request.cameras is not None:
        found = given_cameras(request.cameras, request.folder)
        chosen = list(found)
    else:
        captured = read_cameras(root.parent / "lookdev.usda")
        found = {i: view for i, (view, _) in captured.items()}
        chosen = [i for i, (_, held_out) in captured.items() if held_out] or list(found)
    return chosen_views(request.views, found, chosen)


def chosen_views(listed: str | None, found: dict[int, PinholeCamera], chosen: list[int]) -> dict[str, PinholeCamera]:
    """The cameras of --views by their number as text; without it, the chosen ones. Raises UsageError."""
    if listed is not None:
        chosen = _indices(listed)
    missing = [i for i in chosen if i not in found]
    if missing:
        raise UsageError(
            "there is no such view",
            where="--views",
            value=", ".join(map(str, missing)),
            limit=f"one of {', '.join(map(str, sorted(found)))}",
            remedy="leave --views out to render all",
        )
    return {str(i): found[i] for i in chosen}


def _indices(text: str) -> list[int]:
    parts = [p.strip() for p in text.split(",") if p.strip()]
    if not parts or not all(p.isdecimal() for p in parts):
        raise UsageError(
            "the views can't be read",
            where="--views",
            value=text,
            limit="whole numbers with commas between",
            remedy="for example --views 2,7",
        )
    return [int(p) for p in parts]


def given_cameras(params: Path, folder: Path) -> dict[int, PinholeCamera]:
    """Cameras of a params.json, moved from the capture's world into the asset's by the run's own matrix."""
    from pipeline.camera import PinholeCamera
    from pipeline.transforms import inverse_rigid, matrix, rescale_camera
    from stages.capture.readers.facescape import given_view, is_valid, read_params, view_indices

    if not params.is_file():
        raise UsageError(
            "there is no file with cameras",
            where="--cameras",
            value=params,
            limit="the params.json of a capture",
            remedy="check the path, or leave --cameras out to use the cameras in lookdev.usda",
        )
    capture_from_asset = capture_from_asset_of(
        folder, "name a run's folder, or leave --cameras out to use the cameras in lookdev.usda"
    )
    found = read_params(params)
    out = {}
    for index in view_indices(found):
        if is_valid(found, index):
            camera, (width, height) = given_view(found, index)
            capture_from_cam = inverse_rigid(matrix(camera.cam_from_world))
            pose = rescale_camera(matrix(np.linalg.inv(capture_from_asset)), capture_from_cam)
            out[index] = PinholeCamera(matrix(camera.K), pose, width, height, np.array(camera.distortion, np.float64))
    return out


def capture_from_asset_of(folder: Path, remedy: str = "name a run's folder") -> F64:
    """4x4 similarity of a run's record. Raises StageError, with this remedy, if there is none."""
    from pipeline.transforms import matrix

    record = folder / "run.json"
    try:
        return matrix(json.loads(record.read_text())["capture_from_asset"]).reshape(4, 4)
    except (OSError, ValueError, KeyError) as e:
        raise StageError(
            "where the capture lies in the asset's world is not known",
            where=record,
            value=e,
            limit="the run.json of a finished run",
            remedy=remedy,
        ) from e
