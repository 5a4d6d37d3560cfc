"""The artifacts of the capture: the user's files by content, and the imported photos with what is known of them.

They are manifests as in pipeline/artifacts.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipeline.artifacts import Artifact, FileRef, Matrix
from pipeline.verdict import Finding

CaptureKind = Literal[
    "olat", "facescape", "transforms", "idr", "metashape", "realityscan", "colmap", "photos", "video"
]  # fmt: skip


class Bracket(Artifact):
    """Photos of one view at several exposures.

    name: of the view. photo: path of the photo that stands in the source's `photos`; others: the rest. exposures: as
    stated by names or by brackets.json, of `photo` and of the others in their order, relative; empty if not stated.
    """

    name: str
    photo: str
    others: tuple[FileRef, ...]
    exposures: tuple[float, ...] = ()


class PolarisedPair(Artifact):
    """Two photos of one view under polarised light. cross: path of the one in the source's `photos`, whose filter takes
    the mirror reflection away; parallel: the one whose filter lets it pass."""

    cross: str
    parallel: FileRef


class CaptureSource(Artifact):
    """The files in the user's folder, by content; the folder itself is not part of it.

    photos: or the single video file. cameras: files that describe cameras, for the kinds that have them. plates: photos
    of the same views without the subject. metres_from_world: 4x4 similarity to metres, +Y up and the face along +Z, if
    a file beside the capture contains it. passed_over: names of pictures whose format is not supported; twins: of
    those that are one of the photos in another format. stage: the pictures under single lights and the tracking
    pictures of a light stage. brackets: views that were photographed at several exposures; pairs: under polarised
    light.
    """

    kind: CaptureKind
    photos: tuple[FileRef, ...]
    cameras: tuple[FileRef, ...] = ()
    masks: tuple[FileRef, ...] = ()
    plates: tuple[FileRef, ...] = ()
    metres_from_world: Matrix | None = None
    passed_over: tuple[str, ...] = ()
    stage: tuple[FileRef, ...] = ()
    brackets: tuple[Bracket, ...] = ()
    pairs: tuple[PolarisedPair, ...] = ()
    twins: tuple[str, ...] = ()

    def origin(self, folder: Path) -> Path:
        """Of a video the file itself: other people's videos may lie in the same folder."""
        return folder / self.photos[0].path if self.kind == "video" else folder


class GivenCamera(Artifact):
    """A camera that came with the capture, in the capture's own coordinates.

    K: pixels, centre of the first pixel at (0.5, 0.5). cam_from_world: OpenCV axes. distortion: k1 k2 p1 p2 k3.
    """

    K: Matrix
    cam_from_world: Matrix
    distortion: tuple[float, ...]


class CaptureView(Artifact):
    """One photo. `index`: its number for the user; `holdout`: excluded from every fit; `plate`: the same view without
    the subject.

    place_m: east, north and up in metres, relative to the capture's first photo with a GPS position. clipped: mask
    (255) of the pixels at the end of the file's range, whose value is only a lower bound. exposure: relative to the
    median photo of the capture, from EXIF; linear values are proportional to it; 1 if unknown. flash: whether a flash
    fired, None if the metadata do not say it. parallel: the parallel-polarised photo of a view whose `image` is the
    cross-polarised one, its clipped pixels, and its exposure over that of `image` (pipeline/polarised.py). merged:
    number of exposures in the image, 1 for a plain photo.
    """

    index: int
    name: str
    image: FileRef
    width: int
    height: int
    camera: GivenCamera | None = None
    mask: FileRef | None = None
    plate: FileRef | None = None
    focal_px: float | None = None
    camera_group: str = ""
    place_m: tuple[float, float, float] | None = None
    clipped: FileRef | None = None
    exposure: float = 1.0
    flash: bool | None = None
    parallel: FileRef | None = None
    parallel_clipped: FileRef | None = None
    parallel_exposure: float = 1.0
    merged: int = 1
    holdout: bool = False


class ChartFound(Artifact):
    """The colour checker as seen by one camera, in the photo with the best fit.

    camera_group: as in CaptureView. corners: (4, 2) pixels around the checker, starting at the first patch (dark skin).
    matrix: 3 x 3, from the photo's original linear colours, divided by its exposure, to reflectance of the checker.
    way: its degrees of freedom. error: relative root mean square error on patches that were left out. white: linear
    colour of a perfect white in place of the checker in the photo.
    """

    camera_group: str
    photo: str
    index: int
    corners: Matrix
    matrix: Matrix
    way: Literal["gains", "matrix"]
    error: float
    patches: int
    white: tuple[float, float, float]


class ColourChart(Artifact):
    """The colour checker of a capture, by which all photos were white-balanced. photos: names of those that show it.
    level: linear value, divided by the photo's exposure, of a perfect white in place of the checker, in the original
    files."""

    photos: tuple[str, ...]
    level: float
    fits: tuple[ChartFound, ...]


class StageLight(Artifact):
    """One lamp of a light stage, in the capture's coordinates: a small Lambertian disc.

    position: metres (the capture's unit). axis: unit vector along which it shines. intensity: radiant intensity along
    the axis, linear RGB: a white Lambertian surface that faces it at distance d has the value intensity / (pi d^2).
    frame: when its pictures were taken, counted with the tracking pictures.
    """

    index: int
    position: tuple[float, float, float]
    axis: tuple[float, float, float]
    intensity: tuple[float, float, float]
    frame: int


class StageFrame(Artifact):
    """A picture of a light stage, linear. camera: index of the view with its camera. number: the light's index, or of a
    tracking picture its frame."""

    camera: int
    number: int
    image: FileRef


class LightStage(Artifact):
    """Pictures under one light at a time, and how they were lit. The capture's views are the pictures under all lights.

    frames: under single lights; tracking: under all lights, at later times. gain: the views' values are those of the
    files times gain (their files are too bright for a photo's range); frames and tracking are as in the files. share:
    of the light in the views that the lights account for; the rest is of lights that failed or are not calibrated.
    """

    lights: tuple[StageLight, ...]
    frames: tuple[StageFrame, ...]
    tracking: tuple[StageFrame, ...] = ()
    gain: float = 1.0
    share: float = 1.0


class Capture(Artifact):
    """The imported photos, checked. colours_drift: white balance or exposure differ between the photos, so that one
    colour has several values. metres_from_world: see CaptureSource. chart: None if no colour checker was found, or the
    search is off. stage: the pictures under single lights of a light stage."""

    kind: CaptureKind
    views: tuple[CaptureView, ...]
    colours_drift: bool = False
    chart: ColourChart | None = None
    metres_from_world: Matrix | None = None
    stage: LightStage | None = None
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def polarised(self) -> bool:
        """Whether the views are cross-polarised photos: they show no mirror reflection."""
        return any(v.parallel is not None for v in self.views)
