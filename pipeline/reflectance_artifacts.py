"""The artifacts of a light stage's reflectance field. They are manifests as in pipeline/artifacts.py."""

from __future__ import annotations

from pipeline.artifacts import Artifact, FileRef, Matrix
from pipeline.verdict import Finding


class LeftOutPicture(Artifact):
    """A picture under a light that a field was not fitted to. camera, light: their numbers; angle: from the light to
    the nearest fitted one, degrees. psnr, blend_psnr: of the field, and of blending the pictures under the three
    nearest lights, dB."""

    camera: int
    light: int
    angle: float
    psnr: float
    blend_psnr: float


class ReflectanceField(Artifact):
    """How each texel answers light from every direction, measured by a light stage; if the capture is of none, present
    is false. files: maps, mesh and basis.json (docs/reflectance.md); size: texels along each side of the maps.

    lights: number of those in the fit; left_out: lights, and cameras those, that were kept from it for the figures.
    alphas: GGX widths of the global lobes. motion: 4x4 of the head in asset coordinates by frame. figures: by name,
    see docs/stages/reflectance.md. predicted: pictures under left-out lights; shown: some of them for the report, truth
    on the left, field on the right.
    """

    present: bool
    files: tuple[FileRef, ...] = ()
    size: int = 0
    lights: int = 0
    left_out: tuple[int, ...] = ()
    cameras: tuple[int, ...] = ()
    alphas: tuple[float, ...] = ()
    motion: dict[str, Matrix] = {}
    figures: dict[str, float] = {}
    predicted: tuple[LeftOutPicture, ...] = ()
    shown: tuple[FileRef, ...] = ()
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
