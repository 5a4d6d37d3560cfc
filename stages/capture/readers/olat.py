"""Reads a light stage: cameras, calibrated lights, pictures under all lights and under one light at a time.

    params.json                       cameras, FaceScape's keys
    lights.json                       {"lights": [{index, position, direction or axis, intensity_rgb, frame}, ...]}
    full_on/{camera}.exr              under all lights: the views of which the geometry is made
    olat/{camera}/{light}.exr         under one light
    tracking/{camera}/{frame}.exr     under all lights, now and then: they say how the head moved

Pictures may lie elsewhere: `pictures` in lights.json says where (stage_pictures.py), such as one folder for each light.

Pictures are linear: EXR, or 16-bit PNG or TIFF where lights.json says `"encoding": "linear"`. `direction` points from
the stage's centre to the light, `axis` is where it shines; one of them, or `stage_centre` of the file, is needed. For
all lights: `scale`, metres in one unit of the positions; `intensity_rgb` of lights without their own; `distance`, in
metres from the stage's centre, of lights with `azimuth` and `elevation` in place of a position (degrees; 0, 0 is +z,
azimuth grows to +x, elevation to +y).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.capture_artifacts import StageLight
from pipeline.errors import StageError
from stages.capture.readers.described import PHOTO_SUFFIXES, Declared, Described, natural_key, read_json
from stages.capture.readers.facescape import PARAMS, given_view, is_valid, read_params, view_indices
from stages.capture.readers.stage_pictures import Pattern, read_patterns
from stages.capture.readers.values import DIGITS, fault, label, number, printable, shown, table

LIGHTS, FULL_ON, SINGLE, TRACKING = "lights.json", "full_on", "olat", "tracking"
MAX_LIGHTS = 10_000
FEWEST = 8  # lights: albedo, normal and three lobes are eight numbers a texel
UNREADABLE, COPY = "lights.json can't be read", "copy the file again from the stage's calibration"
UNLIKE_UNIT = 0.02  # a direction's length may differ from 1 by this


@dataclass(frozen=True, slots=True)
class Lamps:
    """The calibrated lights, by index; linear: whether lights.json says that integer files are linear; notes on entries
    that can't be used."""

    lights: dict[int, StageLight]
    linear: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Pictures:
    """The stage's pictures on disk: (camera, light or frame) -> file. doubled: pairs of files for one picture."""

    single: dict[tuple[int, int], Path] = field(default_factory=dict)
    tracking: dict[tuple[int, int], Path] = field(default_factory=dict)
    doubled: list[str] = field(default_factory=list)


def find(folder: Path) -> list[Path]:
    """params.json and lights.json, if there are pictures under single lights too."""
    files = [folder / PARAMS, folder / LIGHTS]
    if not all(f.is_file() for f in files):
        return []
    return files if (folder / SINGLE).is_dir() or patterns(folder) else []


def patterns(folder: Path) -> dict[str, Pattern]:
    """Where the pictures are by lights.json: empty if it does not say. Raises StageError for a pattern that is none."""
    path = folder / LIGHTS
    content = read_json(path, UNREADABLE, COPY) if path.is_file() else {}
    given = content.get("pictures") if isinstance(content, dict) else None
    return {} if given is None else read_patterns(given, f"{LIGHTS}, pictures")


def read(folder: Path, files: Sequence[Path]) -> Described:
    """The views under all lights. Invalid ones, and those without a picture, are left out."""
    params = read_params(files[0])
    photos, elsewhere = _full_on(folder), bool(patterns(folder))
    views, left_out, absent, warnings = [], [], [], []
    for index in view_indices(params):
        photo = photos.get(index)
        name = photo.name if photo and not elsewhere else f"{index}{photo.suffix if photo else ''}"
        if is_valid(params, index) and photo is not None:
            camera, size = given_view(params, index)
            serial = label(params.get(f"{index}_sn", ""), f"params.json, key {index}_sn")
            views.append(Declared(index, name, photo, camera, size, serial))
            continue
        absent.append(name)
        if photo is not None:
            left_out.append(f"{name}: params.json marks it invalid")
        else:
            left_out.append(f"{name}: its picture under all lights is missing")
            warnings.append(f"params.json lists camera {index}, but {FULL_ON}/ has no picture of it")
    return Described(tuple(views), tuple(left_out), tuple(absent), tuple(warnings))


def pictures_of(folder: Path) -> Pictures:
    """All pictures under single lights and all tracking pictures, by the numbers in their paths."""
    doubled: list[str] = []
    found = patterns(folder)
    if found:
        frames = {} if found[SINGLE].by_light else _light_of_frame(folder / LIGHTS)
        single = {(c, frames.get(n, n)): p for (c, n), p in found[SINGLE].matches(folder, doubled).items()
                  if not frames or n in frames}  # fmt: skip
        tracking = found[TRACKING].matches(folder, doubled) if TRACKING in found else {}
        return Pictures(single, tracking, doubled)
    single, tracking = (_by_camera(folder / name, doubled) for name in (SINGLE, TRACKING))
    return Pictures(single, tracking, doubled)


def _full_on(folder: Path) -> dict[int, Path]:
    """The picture under all lights of each camera."""
    found = patterns(folder)
    if not found:
        return _numbered(folder / FULL_ON, [])
    return {camera: path for (camera, _), path in found[FULL_ON].matches(folder, []).items()}


def _light_of_frame(path: Path) -> dict[int, int]:
    return {light.frame: index for index, light in read_lights(path).lights.items()}


def _by_camera(folder: Path, doubled: list[str]) -> dict[tuple[int, int], Path]:
    cameras = [p for p in folder.iterdir() if p.is_dir() and _is_number(p.name)] if folder.is_dir() else []
    return {(int(c.name), n): file for c in sorted(cameras) for n, file in _numbered(c, doubled).items()}


def _numbered(folder: Path, doubled: list[str]) -> dict[int, Path]:
    """Pictures whose name is a number. Of two files with the same number none is taken; `doubled` names them."""
    found: dict[int, list[Path]] = {}
    for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)) if folder.is_dir() else []:
        if path.suffix.lower() in PHOTO_SUFFIXES and _is_number(path.stem) and path.is_file():
            found.setdefault(int(path.stem), []).append(path)
    doubled += [" and ".join(f"{folder.name}/{p.name}" for p in files) for files in found.values() if len(files) > 1]
    return {n: files[0] for n, files in found.items() if len(files) == 1}


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= DIGITS


def read_lights(path: Path) -> Lamps:
    """The lights of lights.json.

    An entry without position, direction or intensity is no error: its pictures are left out, and a note says so.
    Raises StageError if the file has no list of lights, a value is not a number, or too few lights are left.
    """
    content = read_json(path, UNREADABLE, COPY)
    entries = content.get("lights") if isinstance(content, dict) else None
    if not isinstance(entries, list) or len(entries) > MAX_LIGHTS:
        raise fault("lights.json has no list of lights", path.name, shown(content),
                    f"an object with lights: [...], at most {MAX_LIGHTS}",
                    "write one entry for each light: index, position, direction, intensity_rgb, frame")  # fmt: skip
    lights: dict[int, StageLight] = {}
    notes: list[str] = []
    twice: set[int] = set()
    for place, entry in enumerate(entries):
        light = _light(entry, place, content, notes)
        if light is None:
            continue
        if light.index in lights:
            twice.add(light.index)
        lights[light.index] = light
    for index in sorted(twice):
        del lights[index]
        notes.append(f"light {index} is twice in lights.json")
    if len(lights) < FEWEST:
        raise _too_few(path, len(lights), notes)
    return Lamps(lights, _is_linear(content), tuple(notes))


def _is_linear(content: Mapping[str, Any]) -> bool:
    """Whether `encoding` declares integer files as linear. Raises StageError for another word: the pictures would be
    read as something that they are not."""
    found = content.get("encoding")
    if found is None or found == "linear":
        return found is not None
    raise fault("the encoding of a light stage's pictures is not supported", f"{LIGHTS}, encoding", shown(found),
                '"linear", or none for float files', "export linear EXR, and remove the key")  # fmt: skip


def _light(entry: Any, place: int, content: Mapping[str, Any], notes: list[str]) -> StageLight | None:
    where = f"{LIGHTS}, entry {place}"
    if not isinstance(entry, dict) or not isinstance(entry.get("index"), int) or isinstance(entry.get("index"), bool):
        notes.append(f"{where}: it has no index")
        return None
    index = int(entry["index"])
    where = f"{LIGHTS}, light {index}"
    position = _position(entry, content, where)
    intensity = _three(entry.get("intensity_rgb", content.get("intensity_rgb")), f"{where}, intensity_rgb")
    axis = _axis(entry, content, position, where)
    if position is None or intensity is None or axis is None or min(intensity) <= 0 or not 0 <= index < 10**DIGITS:
        missing = [k for k, v in (("position", position), ("intensity_rgb", intensity), ("direction", axis)) if not v]
        what = f"no {' and no '.join(missing)}" if missing else "an intensity or an index that is not positive"
        notes.append(f"light {index} has {what} in {LIGHTS}")
        return None
    frame = number(entry.get("frame", place), f"{where}, frame")
    if frame != round(frame):
        raise fault("a light's frame is not a whole number", f"{where}, frame", frame, "a whole number",
                    "number the pictures in the order in which they were taken")  # fmt: skip
    return StageLight(index=index, position=position, axis=axis, intensity=intensity, frame=round(frame))


def _position(entry: Mapping[str, Any], content: Mapping[str, Any], where: str) -> Any:
    """`position` in metres, or the place that `azimuth`, `elevation` and the file's `distance` say."""
    scale = number(content.get("scale", 1.0), f"{LIGHTS}, scale")
    if not scale > 0:
        raise fault("the unit of the lights' positions is not positive", f"{LIGHTS}, scale", scale, "above 0",
                    "write the metres in one unit: 0.001 for millimetres")  # fmt: skip
    found = _three(entry.get("position"), f"{where}, position")
    if found is not None:
        return tuple(scale * x for x in found)
    if any(k not in entry for k in ("azimuth", "elevation")) or "distance" not in content:
        return None
    far = number(content["distance"], f"{LIGHTS}, distance")
    a, e = (np.radians(number(entry[k], f"{where}, {k}")) for k in ("azimuth", "elevation"))
    centre = _three(content.get("stage_centre", [0, 0, 0]), f"{LIGHTS}, stage_centre") or (0.0, 0.0, 0.0)
    towards = (np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a))
    return tuple(float(scale * c + far * t) for c, t in zip(centre, towards, strict=True))


def _three(value: Any, where: str) -> tuple[float, float, float] | None:
    if value is None:
        return None
    found = table(value, where)
    if found.shape != (3,):
        raise fault("a light's vector has the wrong length", where, shown(value), "three numbers",
                    "write x, y and z, or red, green and blue")  # fmt: skip
    return float(found[0]), float(found[1]), float(found[2])


def _axis(entry: Mapping[str, Any], content: Mapping[str, Any], position: Any, where: str) -> Any:
    """Unit vector along which the light shines: `axis`, or against `direction`, or towards the stage's centre."""
    for key, sign in (("axis", 1.0), ("direction", -1.0)):
        found = _three(entry.get(key), f"{where}, {key}")
        if found is not None:
            length = float(np.linalg.norm(found))
            if abs(length - 1) > UNLIKE_UNIT:
                raise fault("a light's direction is not a unit vector", f"{where}, {key}", f"length {length:.4g}",
                            "length 1", "divide it by its length")  # fmt: skip
            return tuple(sign * x / length for x in found)
    by_angles = "position" not in entry and position is not None
    centre = _three(content.get("stage_centre", [0, 0, 0] if by_angles else None), f"{LIGHTS}, stage_centre")
    if centre is None or position is None:
        return None
    away = np.subtract([number(content.get("scale", 1.0), f"{LIGHTS}, scale") * x for x in centre], position)
    if not np.linalg.norm(away) > 0:
        return None
    return tuple(float(x) for x in away / np.linalg.norm(away))


def _too_few(path: Path, count: int, notes: Sequence[str]) -> StageError:
    return StageError(
        "too few lights are calibrated",
        where=path.name,
        value=f"{count}" + (f" ({printable(notes[0])})" if notes else ""),
        limit=f"at least {FEWEST} lights with position, direction and intensity",
        remedy="add the missing entries from the stage's calibration",
    )
