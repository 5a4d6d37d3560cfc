"""Reads the cameras that Agisoft Metashape exports as XML (`<document>` with `<sensors>` and `<cameras>`).

Metashape's frame camera: x = X / Z, y = Y / Z with OpenCV's axes, the first pixel's centre at (0.5, 0.5);
    x' = x (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + P1 (r^2 + 2 x^2) + 2 P2 x y
    y' = y (1 + K1 r^2 + ...)                      + P2 (r^2 + 2 y^2) + 2 P1 x y
    u = w / 2 + cx + x' f + x' B1 + y' B2,   v = h / 2 + cy + y' f
so that its P1 and P2 are OpenCV's p2 and p1. A camera's `transform` is chunk from camera; the chunk's similarity is
world from chunk. Source: Metashape user manual, appendix 'Camera models'.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pipeline.transforms import F64, apply, inverse_rigid, rigid, scale_of, similarity
from stages.capture.readers.cameras import (
    checked_frame,
    checked_K,
    checked_lens,
    checked_pose,
    checked_rotation,
    given_camera,
)
from stages.capture.readers.described import (
    Declared,
    Described,
    description,
    find_photo,
    five_terms,
    indices_of,
)
from stages.capture.readers.values import fault, pixels, printable, words

HEAD = 4096  # bytes that are read to detect the format
MIN_SCALE = 1e-9  # smallest scale from the chunk's units to the world's; the largest is 1 / MIN_SCALE
REMEDY = "export the cameras again (File > Export > Export Cameras, Agisoft XML), or remove the file"
Lens = tuple[F64, F64, tuple[int, int]]


def find(folder: Path) -> list[Path]:
    """The first XML file (by name) that is Metashape's."""
    for path in sorted(folder.glob("*.xml")):
        if not path.is_file():
            continue
        with path.open("rb") as f:
            head = f.read(HEAD)
        if b"<document" in head and b"<chunk" in head:
            return [path]
    return []


def read(folder: Path, files: Sequence[Path]) -> Described:
    """Aligned and enabled cameras with their photos. The others are left out."""
    chunk = _chunk(files[0])
    sensors = {s.get("id", ""): s for s in chunk.iter("sensor")}
    lenses: dict[str, Lens] = {}
    world_from_chunk = _world_from_chunk(chunk, files[0].name)
    cameras = [c for c in chunk.iter("camera") if c.get("label")]
    labels = [c.get("label", "") for c in cameras]
    views, left_out, warnings = [], [], []
    for index, label, camera in zip(indices_of(labels), labels, cameras, strict=True):
        photo, where = find_photo(folder, label), f"{files[0].name}, camera {printable(label)}"
        pose = camera.find("transform")
        if not _enabled(camera.get("enabled", "true"), where) or pose is None:
            left_out.append(f"{printable(label)}: {'not aligned' if pose is None else 'disabled'} in {files[0].name}")
        elif photo is None:
            left_out.append(f"{printable(label)}: its photo is missing")
            warnings.append(
                f"{files[0].name} lists {printable(label)}, which is not in the capture; put the photo beside it"
            )
        else:
            sensor = camera.get("sensor_id", "")
            if sensor not in lenses:
                lenses[sensor] = _lens(sensors.get(sensor), where)
            K, d, size = lenses[sensor]
            chunk_from_cam = checked_pose(words(pose.text, 16, where, REMEDY).reshape(4, 4), where)
            moved = _rigid_part(world_from_chunk, chunk_from_cam)
            given = given_camera(K, inverse_rigid(moved), d, where, size)
            views.append(Declared(index, photo.name, photo, given, size, f"sensor {camera.get('sensor_id')}"))
    return Described(tuple(views), tuple(left_out), tuple(n.split(":")[0] for n in left_out), tuple(warnings))


def _enabled(text: str, where: str) -> bool:
    """XML's boolean. Raises StageError for other words."""
    if text.strip().lower() not in ("true", "1", "false", "0"):
        raise fault("a flag is neither true nor false", f"{where}, enabled", printable(text), "true, false, 1 or 0",
                    REMEDY)  # fmt: skip
    return text.strip().lower() in ("true", "1")


def _chunk(path: Path) -> ElementTree.Element:
    try:
        root = ElementTree.fromstring(description(path))
    except (ElementTree.ParseError, ValueError, LookupError) as e:
        raise fault("the cameras' file can't be read", path.name, printable(str(e)), "Agisoft XML", REMEDY) from e
    chunk = root.find("chunk")
    if chunk is None or next(chunk.iter("camera"), None) is None:
        raise fault("the cameras' file has no cameras", path.name, "no <camera>", "at least 3 cameras", REMEDY)
    return chunk


def _world_from_chunk(chunk: ElementTree.Element, name: str) -> F64:
    """The chunk's similarity (4, 4); the identity if the file has none."""
    found = chunk.find("transform")
    if found is None:
        return np.eye(4)
    where = f"{name}, the chunk's transform"
    rotation, translation, scale = (found.findtext(k) for k in ("rotation", "translation", "scale"))
    R = words(rotation, 9, where, REMEDY).reshape(3, 3) if rotation else np.eye(3)
    t = words(translation, 3, where, REMEDY) if translation else np.zeros(3)
    s = float(words(scale, 1, where, REMEDY)[0]) if scale else 1.0
    if not MIN_SCALE <= s <= 1 / MIN_SCALE:
        raise fault("the chunk has no scale", where, s, f"{MIN_SCALE:g} to {1 / MIN_SCALE:g}", REMEDY)
    checked_rotation(R, where)
    return similarity(s, R, t)


def _rigid_part(world_from_chunk: F64, chunk_from_cam: F64) -> F64:
    """world_from_cam (4, 4): the rotation of the product, and the camera centre in the world."""
    scale = scale_of(world_from_chunk)
    centre = apply(world_from_chunk, chunk_from_cam[None, :3, 3])[0]
    return rigid(world_from_chunk[:3, :3] / scale @ chunk_from_cam[:3, :3], centre)


def _lens(sensor: ElementTree.Element | None, where: str) -> Lens:
    found = [] if sensor is None else sensor.findall("calibration")
    adjusted = [c for c in found if c.get("class") == "adjusted"] or found
    if not adjusted:
        raise fault("a camera has no calibration", where, "no <calibration> of its sensor", "an adjusted one", REMEDY)
    c = adjusted[0]
    if c.get("type", "frame") != "frame":
        raise fault("the lens model is not supported", where, c.get("type"), "frame",
                    "undistort the photos in Metashape and export the undistorted photos")  # fmt: skip
    resolution = c.find("resolution")
    if resolution is None:
        raise fault("a calibration has no size", where, "no <resolution>", "width and height", REMEDY)
    width, height = (_pixels(resolution.get(k, ""), f"{where}, {k}") for k in ("width", "height"))

    def value(name: str) -> float:
        text = c.findtext(name)
        return float(words(text, 1, f"{where}, {name}", REMEDY)[0]) if text else 0.0

    f, skew = value("f"), value("b2")
    K = np.array([[f + value("b1"), skew, width / 2 + value("cx")], [0, f, height / 2 + value("cy")], [0, 0, 1.0]])
    radial, p = np.array([value(f"k{i}") for i in (1, 2, 3, 4)]), (value("p1"), value("p2"))
    K = checked_frame(checked_K(K, where), (width, height), where)
    d = checked_lens(K, np.array([radial[0], radial[1], p[1], p[0], radial[2]]), (width, height), where)
    if radial[3] == 0:
        return K, d, (width, height)

    def image_from_plane(xy: F64) -> F64:
        x, y, r2 = xy[:, 0], xy[:, 1], (xy * xy).sum(1)
        bent = 1 + r2 * (radial[0] + r2 * (radial[1] + r2 * (radial[2] + r2 * radial[3])))
        across = x * bent + p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y
        down = y * bent + p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y
        return np.stack([K[0, 0] * across + skew * down + K[0, 2], f * down + K[1, 2]], -1)

    K5, d5, _ = five_terms(image_from_plane, K, width, height, where)
    return K5, d5, (width, height)


def _pixels(text: str, where: str) -> int:
    return pixels(float(words(text, 1, where, REMEDY)[0]), where, REMEDY)
