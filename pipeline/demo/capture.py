"""Write the demo capture: photos and cameras in FaceScape's format, and the ground truth.

Folder
    {i}.png            8-bit sRGB, black background; of a polarised capture the cross-polarised photo
    parallel/{i}.png   of a polarised capture: the parallel-polarised photo
    params.json        FaceScape's keys; pixel centres at integers, so cx = (W - 1) / 2
    truth/alpha        coverage of every view, 8 bit
    truth/albedo       linear RGB, every fifth view (i % 5 == 2), the photo's pixels
    truth/normal       unit normals of the world, the same views
    truth/mesh_gt.ply  metres
    truth/light.json   coefficients (121, 3) of the light; truth/env.exr the same as a lat-long
    demo.json          written last: the arguments and a hash over them

World: metres, +Y up, +Z out of the face. The folder appears under its name only when it is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import trimesh

from pipeline.demo import head, light
from pipeline.demo.mesh import Mesh, mesh_from_distance
from pipeline.demo.render import Camera, Picture, Scene, render, scene_from_mesh
from pipeline.demo.rig import rig_cameras

F64 = npt.NDArray[np.float64]
Progress = Callable[[int, int, str], None]

VERSION = 1
"""Increased whenever the same arguments give another capture."""

MARKER = "demo.json"
PARALLEL = "parallel"
EXPOSURE = 0.52
"""Scale of the studio light: it sets the photos' brightness, like a camera's exposure."""

POLARISED_EXPOSURE = 1.6
"""Exposure of a polarised capture over that of a plain one: a filter passes half of the diffuse light."""

_ENV_HEIGHT = 128
_TRUTH_STEP = 0.0027  # metres; gives some 60 000 faces
_TRUTH_EVERY, _TRUTH_AT = 5, 2


@dataclass(frozen=True, slots=True)
class Request:
    """Everything that determines the bytes of a capture."""

    views: int
    size: int
    samples: int
    mesh_step: float
    seed: int
    shadows: bool
    version: int = VERSION
    polarised: bool = False

    def digest(self) -> str:
        """Hash of the arguments, hexadecimal."""
        return hashlib.sha256(json.dumps(self.plain(), sort_keys=True).encode()).hexdigest()

    def plain(self) -> dict[str, object]:
        """The arguments; those of a capture that is not polarised are as they were before there was a choice."""
        return {k: v for k, v in asdict(self).items() if k != "polarised" or v}


def write_demo_capture(
    folder: Path,
    *,
    views: int = 40,
    size: int = 384,
    samples: int = 16,
    mesh_step: float = 0.001,
    seed: int = 0,
    shadows: bool = False,
    polarised: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write the demo capture to `folder`, or return at once if it already contains the requested one.

    `views` photos of `size` x `size` pixels; `samples` (a power of two) light samples for each lobe in each
    quarter pixel; `mesh_step` metres, the grid of the traced mesh; `polarised`: a cross- and a
    parallel-polarised photo of each view; `progress(done, total, what)`.
    A folder with any other content is not overwritten: FileExistsError.
    """
    request = Request(views, size, samples, mesh_step, seed, shadows, polarised=polarised)
    _check(request)
    if is_complete(folder, request):
        return
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder} is not empty and does not contain this demo capture; choose another folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
    try:
        _write(partial, request, progress or (lambda done, total, what: None))
        partial.chmod(0o755)  # mkdtemp makes it private
        partial.replace(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def is_complete(folder: Path, request: Request) -> bool:
    """Whether `folder` contains exactly the capture of `request`."""
    try:
        marker = json.loads((folder / MARKER).read_text())
    except (OSError, ValueError):
        return False
    return isinstance(marker, dict) and marker.get("digest") == request.digest()


def _check(request: Request) -> None:
    if request.views < 1 or request.size < 8:
        raise ValueError(f"a demo capture needs at least 1 view and 8 pixels, not {request.views} and {request.size}")
    if request.samples < 1 or request.samples & (request.samples - 1):
        raise ValueError(f"samples must be a power of two, not {request.samples}")
    if not 2e-4 <= request.mesh_step <= 8e-3:
        raise ValueError(f"mesh_step must be between 0.2 and 8 mm, not {request.mesh_step * 1000:g} mm")


def _write(folder: Path, request: Request, progress: Progress) -> None:
    """Fill `folder`, which is empty; the marker comes last."""
    for name in ("alpha", "albedo", "normal"):
        (folder / "truth" / name).mkdir(parents=True)
    if request.polarised:
        (folder / PARALLEL).mkdir()
    cameras = rig_cameras(request.views, request.size, request.seed)
    _write_json(folder / "params.json", facescape_params(cameras))
    total = request.views + 1
    progress(0, total, "modelling the head")
    mesh = _head_mesh(request.mesh_step)
    truth = mesh if request.mesh_step >= _TRUTH_STEP else _head_mesh(_TRUTH_STEP)
    _write_mesh(folder / "truth" / "mesh_gt.ply", truth)
    coefficients = light.studio_coefficients(EXPOSURE)
    _write_light(folder / "truth", coefficients)
    scene = scene_from_mesh(mesh, coefficients, request.samples, request.seed, request.shadows)
    with ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, 4)) as pool:
        jobs = [pool.submit(_write_view, folder, scene, camera, i, request.polarised)
                for i, camera in enumerate(cameras)]  # fmt: skip
        try:
            for i, job in enumerate(jobs):
                progress(i + 1, total, f"photo {i + 1} of {len(jobs)}")
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    _write_json(folder / MARKER, {"digest": request.digest(), **request.plain()})
    progress(total, total, "done")


def _head_mesh(step: float) -> Mesh:
    return mesh_from_distance(head.signed_distance, head.distance_and_gradient, head.BOUNDS, step)


def facescape_params(cameras: list[Camera]) -> dict[str, object]:
    """FaceScape's flat dictionary of `cameras`."""
    params: dict[str, object] = {}
    for i, camera in enumerate(cameras):
        params[f"{i}_K"] = camera.k.tolist()
        params[f"{i}_Rt"] = camera.cam_from_world.tolist()
        params[f"{i}_distortion"] = [0.0] * 5
        params[f"{i}_width"] = params[f"{i}_height"] = camera.size
        params[f"{i}_valid"] = True
        params[f"{i}_matches"] = 1000
        params[f"{i}_sn"] = f"DEMO{i:03d}"
        params[f"{i}_ori"] = f"{i}.png"
    return params


def srgb_from_linear(linear: F64) -> npt.NDArray[np.uint8]:
    """8-bit sRGB of linear values, clipped to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1.0 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * encoded), dtype=np.uint8)


def through_filters(picture: Picture) -> tuple[F64, F64]:
    """Cross- and parallel-polarised radiance (H, W, 3): half of the diffuse light, and with all of the mirror
    reflection, which keeps its polarisation."""
    cross = 0.5 * POLARISED_EXPOSURE * (picture.radiance - picture.specular)
    return cross, cross + POLARISED_EXPOSURE * picture.specular


def _write_view(folder: Path, scene: Scene, camera: Camera, i: int, polarised: bool) -> None:
    picture = render(scene, camera, i)
    photo = picture.radiance
    if polarised:
        photo, parallel = through_filters(picture)
        _write_png(folder / PARALLEL / f"{i}.png", srgb_from_linear(parallel)[..., ::-1])
    _write_png(folder / f"{i}.png", srgb_from_linear(photo)[..., ::-1])
    _write_png(folder / "truth" / "alpha" / f"{i}.png", np.rint(255.0 * picture.alpha).astype(np.uint8))
    if i % _TRUTH_EVERY == _TRUTH_AT:
        _write_truth(folder / "truth", picture, i)


def _write_truth(truth: Path, picture: Picture, i: int) -> None:
    _write_exr(truth / "albedo" / f"{i}.exr", picture.albedo.astype(np.float16))
    _write_exr(truth / "normal" / f"{i}.exr", picture.normal.astype(np.float16))


def _write_light(truth: Path, coefficients: F64) -> None:
    _write_exr(truth / "env.exr", light.lat_long(coefficients, _ENV_HEIGHT))
    about = {
        "basis": "real orthonormal spherical harmonics, index l (l + 1) + m, no Condon-Shortley sign",
        "polar_axis": "+Z",
        "world": "+Y up, +Z out of the face",
        "degree": light.DEGREE,
        "coefficients": coefficients.tolist(),
    }
    _write_json(truth / "light.json", about)


def _write_mesh(path: Path, mesh: Mesh) -> None:
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)


def _write_png(path: Path, pixels: npt.NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not done:
        raise OSError(f"could not encode {path.name}")
    path.write_bytes(data.tobytes())


def _write_exr(path: Path, pixels: npt.NDArray[np.float16] | npt.NDArray[np.float32]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels)}) as file:
        file.write(str(path))


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")
