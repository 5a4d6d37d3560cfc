"""The artifacts that stages exchange: frozen manifests that refer to files by content. Those of the capture are in
pipeline/capture_artifacts.py, those of the asset in pipeline/asset_artifacts.py.

An artifact is a pydantic model saved as `manifest.json` beside its files. It contains figures and `FileRef`s, but no
arrays and no absolute paths, so that two runs with the same content have the same manifest in any folder.

Frames: every matrix is named `<to>_from_<from>`. Asset coordinates are right-handed, +Y up, origin at the centre of the
region of interest, metres (an assumed scale if `metric` is false).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, SerializerFunctionWrapHandler, model_serializer

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
        """sha256 of the canonical manifest, and through its FileRefs of the content of all its files."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()

    def origin(self, folder: Path) -> Path:
        """What the lineage calls this artifact, whose files are in `folder`: the folder, if it holds nothing else."""
        return folder


class FileRef(Artifact):
    """A file of an artifact: path in the artifact's folder, hash and size."""

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
    """An artifact and the folder of its files. Only the artifact enters the content key."""

    artifact: A
    folder: Path

    @property
    def origin(self) -> Path:
        """What the lineage calls it."""
        return self.artifact.origin(self.folder)

    def path(self, ref: FileRef) -> Path:
        """The absolute path of one of the artifact's files."""
        return self.folder / ref.path


# ------------------------------------------------------------------ poses
class Camera(Artifact):
    """A camera from structure from motion or from the capture, in asset coordinates.

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
    reprojection error of each view, by its photo's name. scale: source of the unit, as text; metric: whether the unit
    is metres. left_out: for `unregistered` photos the reason, as text, if it is known. groups: sizes of the groups of
    photos that structure from motion could connect: first that of the cameras, then the others, the largest first.
    seen_directions: number of fitted views that see surface facing each direction (pipeline.directions).
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
    """A plane: points with normal . x > offset are cut off. normal: unit, asset coordinates."""

    normal: tuple[float, float, float]
    offset: float


class Extent(Artifact):
    """The part of space that the asset covers: an ellipsoid, cut by planes, asset coordinates.

    axes: unit vectors in rows (to the person's left, up, to the front); radii: along them. head: length from chin to
    the top of the forehead, the unit of all margins.
    """

    centre: tuple[float, float, float]
    axes: Matrix
    radii: tuple[float, float, float]
    cuts: tuple[Cut, ...] = ()
    head: float


class ViewMask(Artifact):
    """Soft alpha of one photo, 8-bit PNG at the photo's size. hull_iou: IoU with the visual hull of the other views.

    labels: PNG of codes, if face or hair was found; MaskSet.label_names has their names. labelled: names of the labels
    in this photo, without the background. asked: pixels that count, 8-bit PNG at the photo's size: white where the
    photo shows the subject inside its extent, or background; black pixels are neither fitted nor scored. None: all
    count.
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
    """The masks of the subject. `dropped`: views whose mask disagrees with all others; not fitted. label_names: of the
    codes 0, 1, ... in the views' labels.

    landmarks: 3D face landmarks, None if fewer than three fitted photos agree on a face. npz: views (N,) indices of the
    fitted photos with a face, uv (N, 468, 2) pixels there, xyz (468, 3) asset coordinates, error_px (N,) median
    reprojection error of each photo's landmarks, kept (N,) photos that agree (pipeline.faces). extent: the part of the
    subject that the asset covers; None for objects: everything in the region of interest.
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
    """A prediction from the fitted field, linear Rec.709 RGBA, premultiplied: EXR, and PNG for viewing.

    response: rows of the matrix from the model's colours to those of the photo's camera; it is applied in both files.
    """

    index: int
    exr: FileRef
    png: FileRef
    scale: int
    response: Matrix = UNCHANGED


class RefinedCamera(Artifact):
    """The pose of a photo after its registration to the model. pixels: root mean square displacement of the subject
    against the pose of the poses stage, pixels of the photo."""

    index: int
    world_from_cam: Matrix
    pixels: float


class RegisteredView(Artifact):
    """A held-out photo whose camera was refined by registering this photo alone to the finished model; the fit never
    used it. exr: the model's prediction from that camera, like that of the HeldOutView. camera: its pose is that of the
    poses stage where the photo does not confirm another one."""

    camera: RefinedCamera
    exr: FileRef


class FittedPhoto(Artifact):
    """How the fit shows one of its photos. psnr: dB over pixels of the subject that the model covers. weight: mean
    weight of the photo's pixels in the fit, 1 where photos are not weighed; low_share: share of them with a low
    weight."""

    index: int
    psnr: float
    weight: float = 1.0
    low_share: float = 0.0


class SecondFitted(Artifact):
    """What the fit tells of a second capture of the subject, under another light. light: its light, as that of the
    FittedFace, in the same asset coordinates; held_out, photos: of its views, by their own indices; psnr_held_out: mean
    over its held-out views, dB, over the subject's pixels, None without such views."""

    light: FileRef
    held_out: tuple[HeldOutView, ...] = ()
    photos: tuple[FittedPhoto, ...] = ()
    psnr_held_out: float | None = None


class FittedFace(Artifact):
    """The fitted field. `field`: npz of every parameter (see pipeline.fields.face). The figures are from the fit.
    refined: fitted photos whose cameras the fit moved (pipeline.fitted_cameras). registered: held-out photos, for
    figures without the error of their cameras; nothing else uses these poses. photos: the fitted
    photos, as the finished fit shows them. surroundings: npz of what the photos show behind the subject
    (pipeline.lighting.surroundings), None where that tells nothing of the light. second: of a second capture that was
    fitted as well; without one, the manifest does not have the entry."""

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
    refined: tuple[RefinedCamera, ...] = ()
    registered: tuple[RegisteredView, ...] = ()
    photos: tuple[FittedPhoto, ...] = ()
    surroundings: FileRef | None = None
    second: SecondFitted | None = None
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    @model_serializer(mode="wrap")
    def _without_empty(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = dump(self)
        return {k: v for k, v in found.items() if k != "second" or v is not None}

    @property
    def attenuation(self) -> str:
        """Name of the light's attenuation in the fit; the paper's exponential if the model does not have the entry."""
        return next((str(v["attenuation"]) for v in self.model.values() if "attenuation" in v), "exponential")


# ------------------------------------------------------------------ mesh
class Surface(Artifact):
    """Zero set of the SDF as triangles. npz: vertices (V, 3) float32, normals (V, 3) float32, faces (F, 3) int32.
    trimmed: share of its area that no photo shows and that was cut off. handles_cut: number of handles that were
    removed; handles_left: number of those that are too wide to be noise. fairing: the distances of what no photo shows
    (pipeline.fields.faired); None: all are the field's own."""

    mesh: FileRef
    fairing: FileRef | None = None
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

    UV origin bottom left. `proxy`: a coarser mesh without UVs, same npz keys without the uvs. stretch: L2, stretch_max:
    Linf of [Sander 2001]. seam_front_mm: length of seams where the surface faces the front. deviation: of the mesh and
    of the proxy from the dense mesh. tiles: number of UDIM tiles (pipeline.tiles); tile_utilisation: share of each tile
    under charts, if there are several; utilisation: their mean. face_share: share of the area under charts that belongs
    to the face; None if the face is unknown. of_template: the mesh is the subdivided and displaced cage of the
    RegisteredHead, without the regions that the asset leaves out (pipeline.registration.head), then what lies beside.
    scan: the decimated scan with its own charts, if the asset has both meshes. quads: of `uv.remesh=quads`: pairs of
    faces 2 q and 2 q + 1 that are one quad in space and texture; 0: triangles. hair_faces: of_template only: the
    mesh's last faces are hair, on the last tile.
    """

    mesh: FileRef
    proxy: FileRef | None = None
    of_template: bool = False
    scan: UvMesh | None = None
    vertices: int
    faces: int
    quads: int = 0
    hair_faces: int = 0
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
    """One map. `files` by the end of their name: "exr", "png"; "1001.exr", "1002.exr", ... if it has tiles
    (pipeline.tiles). space: "srgb_png" (EXR linear) or "raw"."""

    name: str
    channels: int
    files: dict[str, FileRef]
    space: Literal["srgb_png", "raw"]
    minimum: float
    mean: float
    maximum: float


class TextureSet(Artifact):
    """Maps on the UV mesh, square, row 0 = top (v = 1). With several UDIM tiles each map has `tiles` files (lookup
    tables have one), tile t with `sides[t]` texels along a side; no sides: all have `size`. zero_set_rms_mm: root mean
    square distance of the mesh from the SDF's zero set, over texels near it; lod_rms_mm: that of each level of detail,
    over its area. coverage: share of all texels under charts. figures: shares of the covered texels that no photo shows
    (`unseen`), whose albedo was clamped (`albedo_clamped`), that have photo detail (`detail_support`); mean edge of a
    texel and median edge of the photos' finest pixel on the surface (`texel_mm`, `photo_pixel_mm`). regions: share of
    the surface's area by region name; empty without labelled photos. standard_fitted: base colour, F0 and roughness
    were fitted to the photos; else they are converted from NeuFace's lobe. scan: those of the scan's mesh, if the asset
    has both meshes."""

    size: int
    tiles: int = 1
    sides: tuple[int, ...] = ()
    padding: int
    maps: dict[str, TextureMap]
    coverage: float
    zero_set_rms_mm: float = 0.0
    lod_rms_mm: dict[str, float] = {}
    figures: dict[str, float] = {}
    regions: dict[str, float] = {}
    standard_fitted: bool = False
    scan: TextureSet | None = None
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    def side(self, tile: int) -> int:
        """Width and height of a tile's maps in texels."""
        return self.sides[tile] if self.sides else self.size
