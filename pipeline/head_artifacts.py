"""The artifacts of a registered head template: the head on the fitted surface, and its eyes; and what a batch makes of
several: a person's measured expressions, and the average head.

They are manifests as in pipeline/artifacts.py.
"""

from __future__ import annotations

from pipeline.artifacts import Artifact, FileRef, Matrix
from pipeline.verdict import Finding


class FittedEye(Artifact):
    """An eye that was fitted to the photos, in asset coordinates. part: of the head; centre, radius of the ball and
    radius of the iris in metres; axes: rows to the person's left, up, and along the gaze. figures: pixels across the
    iris in the photos, score and seen share of its edge, and the surface's median distance from the ball in mm."""

    part: str
    centre: tuple[float, float, float]
    radius: float
    iris: float
    axes: Matrix
    figures: dict[str, float] = {}


class RegisteredHead(Artifact):
    """The head template on the fitted surface; if it does not hold, registered is false and reason says why.

    head: npz of pipeline.registration.head; rig: of pipeline.registration.rig, if the template has joints. template,
    licence: its name and licence. regions, parts: names that the file's indices refer to. levels: subdivisions of the
    displacement. quads: of the control cage. world_from_template: 4x4 similarity to asset coordinates; identity:
    weights in standard deviations. figures: by name, see docs/stages/template.md. distances_mm: by region (median and
    95 % of the subdivided head's distance from the fitted surface, then both with displacement), over skin that the
    photos show. eyes: those that were fitted; eyes_reason: why others stay the template's own. hair: npz of `hair`
    (V,), the vertices of the fitted surface that are hair; hair_reason: why there is none. quality: the checks; they
    count for the stage uv where the asset is made from this head, and for no verdict else. faulty: it was registered,
    but with a fault that the settings do not allow.
    """

    registered: bool
    reason: str = ""
    head: FileRef | None = None
    rig: FileRef | None = None
    template: str = ""
    licence: str = ""
    regions: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()
    levels: int = 0
    quads: int = 0
    world_from_template: Matrix = ()
    identity: tuple[float, ...] = ()
    figures: dict[str, float] = {}
    distances_mm: dict[str, tuple[float, float, float, float]] = {}
    eyes: tuple[FittedEye, ...] = ()
    eyes_reason: str = ""
    hair: FileRef | None = None
    hair_reason: str = ""
    quality: tuple[Finding, ...] = ()
    faulty: bool = False
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


class MeasuredShapes(Artifact):
    """A person's expressions on the neutral head, from captures of their own.

    file: npz of pipeline.registration.measured; None if there is no usable expression. shapes: names in it, with the
    figures of each (pipeline.registration.measured.Measured). left_out: why others are no shape, by name.
    """

    file: FileRef | None = None
    shapes: dict[str, dict[str, float]] = {}
    left_out: dict[str, str] = {}


class AverageHead(Artifact):
    """The mean of registered heads and of their albedo. files: average.obj with its material and textures, and a
    picture. heads: how many. metric: all units are metres. deviation_mm: by region (median and 95 % over its places of
    the root of the summed variances). sharpness: of the mean albedo near landmarks, by group and of "all"; 1: the maps
    agree. size_deviation: standard deviation of the heads' log sizes.
    """

    files: tuple[FileRef, ...]
    heads: int
    metric: bool
    texture_size: int
    size_deviation: float
    deviation_mm: dict[str, dict[str, float]]
    sharpness: dict[str, float] = {}
