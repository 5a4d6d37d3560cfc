"""Bake stage: evaluates the fitted field at the texels of the UV mesh; the output is a TextureSet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface, TextureMap, TextureSet, UvMesh
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage, StageConfig
from pipeline.fields.protocol import Field as FittedField
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mask, Mesh
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.units import Texels

F64 = npt.NDArray[np.float64]
SCAN = "scan"  # folder of the maps of the scan's mesh, if the asset has both meshes


@dataclass(frozen=True, slots=True)
class Inputs:
    """The mesh, the field, the cameras and masks for the visibility of texels, the photos for the fine detail, the
    registered head for its eyes, and what a light stage measured."""

    surface: Located[Surface]
    uv: Located[UvMesh]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    capture: Located[Capture]
    template: Located[RegisteredHead]
    reflectance: Located[ReflectanceField]


class Config(StageConfig):
    """Settings of the bake stage."""

    size: Texels = Field(1024, ge=256, le=16384, description="width and height of the maps in texels")
    beside: Literal[1, 2, 4] = Field(
        1,
        description="made from the head template: tiles without the face (mouth, clothes, hair) have size / beside "
        "texels along a side",
    )
    detail: bool = Field(True, description="add the fine detail of the fitted photos to the albedo")
    fit_standard: bool = Field(
        True,
        description="fit base colour, F0 and roughness of standard shaders to the photos; off, or without detail: "
        "convert NeuFace's lobe",
    )
    even_skin: float = Field(
        0.5, ge=0, le=1,
        description="part of the slow variation of the skin's colour that is taken for an error of the light, by what "
        "the two sides of the face differ, and taken out; 0: the base colour is what the photos have in their light",
    )  # fmt: skip

    @field_validator("beside", mode="before")
    @classmethod
    def _number(cls, value: object) -> object:
        """A command line gives text, of which pydantic makes a number, but not one of a choice of numbers."""
        return int(value) if isinstance(value, str) and value.isdecimal() else value


def run(inputs: Inputs, config: Config, context: Context) -> TextureSet:
    """Bake every map; with two meshes, once for each. Raises StageError if a mesh has no charts or the field is not
    finite on it."""
    made, second = _baked(inputs, config, context), inputs.uv.artifact.scan
    if second is None:
        return made
    inside = replace(context, workdir=context.workdir / SCAN)
    inside.workdir.mkdir(parents=True)
    elsewhere = Located(ReflectanceField(present=False), inputs.reflectance.folder)  # the field has the first's charts
    own = _baked(replace(inputs, uv=Located(second, inputs.uv.folder), reflectance=elsewhere), config, inside)
    return made.model_copy(update={"scan": own.model_copy(update={"maps": _within(own.maps, SCAN)})})


def _within(maps: Mapping[str, TextureMap], folder: str) -> dict[str, TextureMap]:
    """Maps whose files lie in a folder of the artifact's."""
    out = {}
    for name, one in maps.items():
        files = {k: f.model_copy(update={"path": f"{folder}/{f.path}"}) for k, f in one.files.items()}
        out[name] = one.model_copy(update={"files": files})
    return out


def _baked(inputs: Inputs, config: Config, context: Context) -> TextureSet:
    from pipeline import footprint, meshes
    from pipeline.fields.face import load_face
    from pipeline.fields.faired import fair_again
    from pipeline.lighting.surroundings import surroundings_of
    from pipeline.people import shows_person
    from pipeline.visibility import seen_by
    from stages.bake.build import Baker, Photos
    from stages.bake.delighting import figures_of, shown
    from stages.bake.deviation import zero_set_rms
    from stages.bake.eyes import painted_eyes
    from stages.bake.head import on_head
    from stages.bake.judge import chosen, judge
    from stages.bake.judge import together as texels_of_all
    from stages.bake.lit import measured_of
    from stages.bake.mouth import hidden_tiles, inside_of
    from stages.bake.smaller import smaller
    from stages.bake.statistics import together
    from stages.bake.unseen import with_hair
    from stages.bake.write import joined, write_maps

    uv, fitted = inputs.uv, inputs.inverse_rendering
    surface = inputs.surface
    fairing = None if surface.artifact.fairing is None else surface.path(surface.artifact.fairing)
    field = fair_again(load_face(fitted.path(fitted.artifact.field), context.device), fairing)
    path = uv.path(uv.artifact.mesh)
    views = seen_by(fitted.artifact, inputs.poses.artifact, inputs.masks, inputs.capture)
    exposure = {v.index: v.exposure for v in inputs.capture.artifact.views}
    response = responses(field, [exposure[v.camera.index] for v in views])
    photos = Photos(response, fitted.artifact.attenuation) if config.detail else None

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    mesh, charts = meshes.load(path), meshes.load_charts(path)
    labels = inputs.masks.artifact.label_names
    skin = labels.index("face") if "face" in labels else -1
    eyes = painted_eyes(inputs.template, field, mesh, views, response) if uv.artifact.of_template else None
    mouth = inside_of(inputs.template, mesh) if uv.artifact.of_template else None
    (region, even), hair = on_head(inputs.masks, mesh, config.even_skin), hair_of(mesh, uv.artifact.hair_faces)
    if region is not None and hair is not None:
        region = with_hair(region, hair)
    baker = Baker(
        field, mesh, charts, views, config.size, step, photos, context.scratch, skin, config.fit_standard, eyes, mouth,
        region, hair, labels.index("hair") if "hair" in labels else -1,
        measured_of(inputs.reflectance, config.size), even, surroundings_of(fitted),
    )  # fmt: skip
    parts, sides, counted, judged, shades, areas = [], [], [], [], [], Counter[int]()
    for number in range(baker.tiles):
        baked = baker.tile(number)
        factor = config.beside if uv.artifact.of_template and number > 0 else 1
        written = smaller(baked, factor, context.scratch)
        parts.append(write_maps(written, context, number, baker.tiles))
        sides.append(written.size)
        counted.append(baked.statistics)
        shades.append(shown(baked.samples, baked.texel, baked.size, baked.votes))
        judged.append(chosen(baked.samples, baked.texel, baked.size, baked.votes, labels))
        areas.update(baked.regions)
        del baked, written
    maps, all_tiles = joined(parts, [s.texels for s in counted], context), together(counted)
    pixel = footprint.pixel(mesh, (v.camera for v in views))
    sizes = {"texel_mm": footprint.texel(mesh, charts, config.size), "photo_pixel_mm": pixel}
    figures = all_tiles.figures(detail=baker.detailed) | baker.material_figures | figures_of(shades, labels)
    hidden = hidden_tiles(inputs.template, charts) if uv.artifact.of_template else frozenset[int]()
    outside = together([s for number, s in enumerate(counted) if number not in hidden])
    figures["unseen"] = outside.figures(detail=False)["unseen"]
    figures |= {k: round(1000 * v, 5) for k, v in sizes.items() if v}
    head = inputs.template.artifact
    if uv.artifact.of_template:
        figures |= {k: head.figures[k] for k in ("eyes_fitted", "iris_pixels") if k in head.figures}
    levels = {"render": mesh, "high": meshes.load(inputs.surface.path(inputs.surface.artifact.mesh))}
    if uv.artifact.proxy is not None:
        levels["proxy"] = meshes.load(uv.path(uv.artifact.proxy))
    # every texel between the charts is filled, so the padding is the whole picture
    return TextureSet(
        size=config.size,
        tiles=baker.tiles,
        sides=tuple(sides),
        padding=config.size,
        maps=maps,
        coverage=all_tiles.coverage,
        zero_set_rms_mm=1000 * all_tiles.deviation,
        lod_rms_mm={name: round(1000 * zero_set_rms(field, level), 5) for name, level in levels.items()},
        figures=figures,
        regions=region_shares(areas, labels),
        standard_fitted=baker.standard_fitted,
        warnings=all_tiles.warnings(baker.residual, len(views)) + unfitted_eyes(head, uv.artifact),
        findings=judge(texels_of_all(judged), figures, person=shows_person(inputs.masks.artifact)),
    )


def hair_of(mesh: Mesh, faces: int) -> Mask | None:
    """(V,) vertices of a mesh whose last faces are hair; None without any."""
    if not faces:
        return None
    out = np.zeros(len(mesh.vertices), np.bool_)
    out[mesh.faces[-faces:]] = True
    return out


def unfitted_eyes(head: RegisteredHead, uv: UvMesh) -> tuple[str, ...]:
    """Why eyes of the asset stay the template's own."""
    return (f"eyes stay the template's own: {head.eyes_reason}",) if uv.of_template and head.eyes_reason else ()


def region_shares(areas: Mapping[int, float], names: Sequence[str]) -> dict[str, float]:
    """Shares of the surface by region name. areas: by code; code 0: no photo has a label there."""
    total = sum(areas.values())
    named = {code: "unlabelled" if code == 0 else names[code] if code < len(names) else str(code) for code in areas}
    return {named[code]: round(areas[code] / total, 6) for code in sorted(areas)}


def responses(field: FittedField, exposures: Sequence[float]) -> F64:
    """(views, 3, 3) e_n A_n of each photo: its exposure, by which the fit divided it, and the fitted A_n; the identity
    if the field has none. [NeuFace eq. 19]"""
    e = np.asarray(exposures, np.float64)[:, None, None]
    fitted = field.colour_responses
    return np.asarray(e * (np.eye(3) if fitted is None else fitted), np.float64)


STAGE = Stage(name="bake", version=50, inputs=Inputs, config=Config, output=TextureSet, run=run)
