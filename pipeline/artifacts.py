"""What the stages hand to each other: frozen manifests that name files by content.

An artifact is a pydantic model saved as `manifest.json` beside its files. It holds figures and `FileRef`s, never
arrays and never absolute paths, so that two runs with the same content have the same manifest, wherever they lie.

Frames: every matrix reads `<to>_from_<from>`. Asset coordinates are right-handed, +Y up, origin at the centre of the
region of interest, metres (nominal metres where `metric` is false).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict

from pipeline.verdict import Finding

Matrix = tuple[tuple[float, ...], ...]
UNCHANGED: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _stays_inside(path: str) -> str:
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or "\\" in path or not pure.parts:
        raise ValueError(f"{path!r} is not a plain relative path")
    return path


RelativePath = Annotated[str, AfterValidator(_stays_inside)]


class Artifact(BaseModel):
    """Base of every manifest."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def canonical_json(self) -> str:
        """One string per content: sorted keys, no spaces."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))

    def digest(self) -> str:
        """sha256 of the canonical manifest, and through its FileRefs of every byte that it names."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()


class FileRef(Artifact):
    """A file of an artifact: where it lies in the artifact's folder and what is in it."""

    path: RelativePath
    sha256: str
    size: int

    @classmethod
    def of(cls, folder: Path, path: Path | str) -> FileRef:
        """Hash `path` (relative to `folder`, or inside it)."""
        full = folder / path
        return cls(path=full.relative_to(folder).as_posix(), sha256=sha256_of(full), size=full.stat().st_size)


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes, read in blocks."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


A = TypeVar("A", bound=Artifact, covariant=True)


@dataclass(frozen=True, slots=True)
class Located(Generic[A]):
    """An artifact and the folder that its files are in. Only the artifact counts for the content key."""

    artifact: A
    folder: Path

    def path(self, ref: FileRef) -> Path:
        """The absolute path of one of the artifact's files."""
        return self.folder / ref.path


# ------------------------------------------------------------------ capture
CaptureKind = Literal[
    "facescape", "transforms", "idr", "metashape", "realityscan", "colmap", "photos", "video"
]  # fmt: skip


class CaptureSource(Artifact):
    """What was found in the user's folder, by content; the folder itself is not part of it.

    photos: or the one film, for a video. cameras: the files that describe cameras, for the kinds that have them.
    plates: photos of the same views without the subject. metres_from_world: 4x4 similarity to metres, +Y up and the
    face along +Z, where a file beside the capture says it. passed_over: names of pictures whose format is not read.
    """

    kind: CaptureKind
    photos: tuple[FileRef, ...]
    cameras: tuple[FileRef, ...] = ()
    masks: tuple[FileRef, ...] = ()
    plates: tuple[FileRef, ...] = ()
    metres_from_world: Matrix | None = None
    passed_over: tuple[str, ...] = ()


class GivenCamera(Artifact):
    """A camera that came with the capture, in the capture's own world.

    K: pixels, centre of the first pixel at (0.5, 0.5). cam_from_world: OpenCV axes. distortion: k1 k2 p1 p2 k3.
    """

    K: Matrix
    cam_from_world: Matrix
    distortion: tuple[float, ...]


class CaptureView(Artifact):
    """One photo. `index` is the number that the user knows it by; `holdout` keeps it from every fit; `plate` shows the
    same view without the subject.

    place_m: east, north and up in metres of the capture's first photo with a GPS position. clipped: picture of the
    pixels (255) whose value is at the end of the file's range, and so only a lower bound. exposure: what a grey's
    linear value is proportional to, against the capture's middle photo, from EXIF; 1 where that does not tell.
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
    holdout: bool = False


class ChartFound(Artifact):
    """The colour chart as one camera saw it, in the photo where it fits best.

    camera_group: as CaptureView has it. corners: (4, 2) pixels around the chart, from the first patch's (dark skin).
    matrix: 3 x 3, reflectance of the chart from the photo's linear colours as it came, over its exposure. way: how much
    of it was free. error: root mean square over patches left out, relative. white: linear colour that a perfect white
    at the chart's place has in the photo.
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
    """The colour chart of a capture, to whose white all photos were brought. photos: names of those that show it.
    level: linear value, over the photo's exposure, of a perfect white at the chart's place in the capture's files."""

    photos: tuple[str, ...]
    level: float
    fits: tuple[ChartFound, ...]


class Capture(Artifact):
    """The photos that take part, checked and in one place. colours_drift: the camera set white balance or exposure
    anew for each photo, so that one colour is not one value. metres_from_world: see CaptureSource. chart: None where
    none is seen, or none was looked for."""

    kind: CaptureKind
    views: tuple[CaptureView, ...]
    colours_drift: bool = False
    chart: ColourChart | None = None
    metres_from_world: Matrix | None = None
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ poses
class Camera(Artifact):
    """A solved or given camera, in asset coordinates.

    K: pixels, centre of the first pixel at (0.5, 0.5). world_from_cam: OpenCV axes (x right, y down, z forward).
    distortion: k1 k2 p1 p2 k3. Photos are never resampled: rays go through the exact inverse of the distortion.
    """

    index: int
    name: str
    width: int
    height: int
    K: Matrix
    world_from_cam: Matrix
    distortion: tuple[float, float, float, float, float]


class CameraSet(Artifact):
    """Cameras around the subject.

    capture_from_asset: 4x4 similarity, column vectors. roi_radius: asset units, around the origin. view_errors_px: mean
    reprojection error of each view, by its photo's name. scale: where the unit is from, in words; metric: whether that
    makes it metres. left_out: why each of the `unregistered` photos has no place, in plain words, where that is known.
    groups: numbers of photos that fit among themselves, of solved cameras: first that of the cameras, then the others,
    the largest first. seen_directions: how many fitted views see what faces each
    direction (pipeline.directions).
    """

    source: Literal["given", "colmap"]
    metric: bool
    scale: str = ""
    capture_from_asset: Matrix
    roi_radius: float
    cameras: tuple[Camera, ...]
    unregistered: tuple[str, ...] = ()
    left_out: dict[str, str] = {}
    groups: tuple[int, ...] = ()
    reprojection_error_px: float | None = None
    view_errors_px: dict[str, float] = {}
    points: FileRef | None = None
    seen_directions: tuple[tuple[int, ...], ...] = ()
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ masks
class Cut(Artifact):
    """A plane: points with normal . x > offset lie beyond it. normal: unit, asset coordinates."""

    normal: tuple[float, float, float]
    offset: float


class Extent(Artifact):
    """The part of space that the asset is made of: an ellipsoid less what lies beyond its cuts, asset coordinates.

    axes: unit vectors in rows (to the person's left, up, to the front); radii along them. head: length from chin to
    the top of the forehead, by which all margins are measured.
    """

    centre: tuple[float, float, float]
    axes: Matrix
    radii: tuple[float, float, float]
    cuts: tuple[Cut, ...] = ()
    head: float


class ViewMask(Artifact):
    """Soft alpha of one photo, 8-bit PNG at the photo's size. hull_iou: agreement with the other views' hull.

    labels: where face or hair was found, PNG of codes, whose names MaskSet.label_names has. labelled: the names of
    those in this photo, the background not among them. asked: 8-bit PNG at the photo's size, white where the photo
    shows the subject inside its extent, or background; what is black is neither fitted nor scored. None: all is asked.
    """

    index: int
    mask: FileRef
    source: str
    coverage: float
    hull_iou: float | None = None
    labels: FileRef | None = None
    labelled: tuple[str, ...] = ()
    asked: FileRef | None = None


class MaskSet(Artifact):
    """Which pixels show the subject. `dropped`: views whose mask disagrees with all others; not fitted. label_names: of
    the codes 0, 1, ... in the views' labels.

    landmarks: the face in space, None where fewer than three fitted photos agree on one. npz: views (N,) indices of
    the fitted photos with a face, uv (N, 468, 2) pixels there, xyz (468, 3) asset coordinates, error_px (N,) median
    distance of a photo's landmarks from where xyz projects to, kept (N,) photos that agree (pipeline.faces). extent:
    the part of the subject that the asset is made of; None for objects, of which all in the region of interest is.
    """

    masks: tuple[ViewMask, ...]
    label_names: tuple[str, ...] = ()
    dropped: tuple[int, ...] = ()
    landmarks: FileRef | None = None
    extent: Extent | None = None
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ inverse rendering
class HeldOutView(Artifact):
    """A prediction from the fitted field, linear Rec.709 RGBA, premultiplied: EXR, and PNG for people.

    response: rows of the matrix that took the model's colours to those of the photo's camera; it is in both files.
    """

    index: int
    exr: FileRef
    png: FileRef
    scale: int
    response: Matrix = UNCHANGED


class FittedFace(Artifact):
    """The fitted field. `field`: npz of every parameter (see pipeline.fields.face). Figures are from the fit itself."""

    field: FileRef
    light: FileRef
    rank: int
    light_order: int
    fitted_views: tuple[int, ...]
    held_out: tuple[HeldOutView, ...]
    steps: int
    loss: float
    psnr: float
    beta: float
    cell: float
    model: dict[str, dict[str, str | float | bool]]
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ mesh
class Surface(Artifact):
    """Zero set of the SDF as triangles. npz: vertices (V, 3) float32, normals (V, 3) float32, faces (F, 3) int32.
    trimmed: share of its area that no photo saw and that was cut off. handles_cut: small handles that were opened and
    closed; handles_left: those that are too wide for a fault."""

    mesh: FileRef
    vertices: int
    faces: int
    watertight: bool
    components: int
    removed_components: int
    cell: float
    trimmed: float = 0.0
    handles_cut: int = 0
    handles_left: int = 0
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


class UvMesh(Artifact):
    """A mesh with charts. npz: vertices (V, 3), normals (V, 3), faces (F, 3), uvs (U, 2) float32, uv_faces (F, 3).

    UV origin bottom left. `proxy`: a coarser mesh without UVs, same npz keys less the uvs. stretch: L2, stretch_max:
    Linf of [Sander 2001]. seam_front_mm: length of seams where the surface looks to the front. deviation: of the mesh
    and of the proxy from the dense mesh. tiles: UDIM tiles (pipeline.tiles) that the charts lie in; tile_utilisation:
    share of each under charts, where there are several, and utilisation their mean. face_share: of the area under
    charts that belongs to the face; None where no face is known.
    """

    mesh: FileRef
    proxy: FileRef | None = None
    vertices: int
    faces: int
    charts: int
    tiles: int = 1
    utilisation: float
    tile_utilisation: tuple[float, ...] = ()
    stretch: float
    overlap: float
    stretch_max: float = 0.0
    seam_front_mm: float = 0.0
    deviation_mm: float
    deviation_rms_mm: float = 0.0
    proxy_deviation_rms_mm: float = 0.0
    face_share: float | None = None
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ maps
class TextureMap(Artifact):
    """One map. `files` by what follows its name: "exr", "png"; "1001.exr", "1002.exr", ... where it has tiles
    (pipeline.tiles). space: "srgb_png" (EXR linear) or "raw"."""

    name: str
    channels: int
    files: dict[str, FileRef]
    space: Literal["srgb_png", "raw"]
    minimum: float
    mean: float
    maximum: float


class TextureSet(Artifact):
    """Maps on the UV mesh, `size` texels square, row 0 = top (v = 1); with several UDIM tiles each map has `tiles`
    files of that size (but for tables, which no texture coordinate looks up). zero_set_rms_mm: root mean square
    distance of the mesh from the SDF's zero set, over the texels that have one near them; lod_rms_mm: that of each
    level of detail, over its area. coverage: share of all texels under charts. figures: shares of the covered
    texels that no photo saw (`unseen`), whose albedo was clamped (`albedo_clamped`), that have photo detail
    (`detail_support`); mean edge of a texel and median edge of the photos' finest pixel on the surface (`texel_mm`,
    `photo_pixel_mm`). regions: share of the surface's area by the name of its region; empty without labelled photos."""

    size: int
    tiles: int = 1
    padding: int
    maps: dict[str, TextureMap]
    coverage: float
    zero_set_rms_mm: float = 0.0
    lod_rms_mm: dict[str, float] = {}
    figures: dict[str, float] = {}
    regions: dict[str, float] = {}
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


# ------------------------------------------------------------------ asset and report
class UsdAsset(Artifact):
    """The exported component. `root` is the file to open; `files` are all of it, relative paths kept.

    figures: what the export measured on its maps, by name. stated: author, licence, consent, as the user gave them.
    """

    name: str
    root: RelativePath
    files: tuple[FileRef, ...]
    views: tuple[HeldOutView, ...] = ()
    figures: dict[str, float] = {}
    stated: dict[str, str] = {}
    checks: int
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


class Report(Artifact):
    """One self-contained page and its figures."""

    files: tuple[FileRef, ...]
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
