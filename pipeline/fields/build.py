"""Selects the parts of a model by its spec: our own, or those of a system that the paper compares.

appearance   hash | sinusoidal               the Spatial MLP
shading      neural | phong | disney         the specular term [NeuFace section 5.2]
light        sh | cubemap
integral     low_rank | direct | feature     the material integral [NeuFace eq. 6], [NeuFace eq. 8]
geometry     grid | displaced                a spline grid, or a prior and a displacement [NeuFace eq. 17]

density      crossing | laplace           how the samples of a ray are weighted
volumetric   off | on                    shade every sample of a ray

The first of each is ours. All others are in pipeline.fields.paper, which is loaded only if one of them is selected.
"""

from __future__ import annotations

from pipeline.fields import makers
from pipeline.fields.parts import System
from pipeline.fields.spec import FaceSpec

OURS = {
    "appearance": "hash", "shading": "neural", "light": "sh", "integral": "low_rank", "geometry": "grid",
    "density": "crossing", "volumetric": False,
}  # fmt: skip


def system_of(spec: FaceSpec) -> System:
    """The constructors of a model's parts. The only use of pipeline.fields.paper."""
    if all(getattr(spec, part) == name for part, name in OURS.items()):
        return System(
            makers.geometry, makers.spatial, makers.basis, makers.light, makers.shading, makers.rendering
        )  # fmt: skip
    from pipeline.fields.paper.build import compared

    return compared(spec)
