"""The albedo at a mesh's vertices, with what photos show badly, wrongly or not at all filled (unseen.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Indices, Mesh
from pipeline.smoothing import continued
from pipeline.visibility import FittedPhoto, Occluder, Sight, sight_of
from stages.bake.mouth import Inside
from stages.bake.outline_depth import outline_depth
from stages.bake.unseen import CLEAR, LENGTH, LOOSE, region_colours, replaced_share


@dataclass(frozen=True, slots=True)
class Filler:
    """sight of the vertices; region (V,) of the head; depth (V,) inside of the silhouettes; mouth: its inside."""

    mesh: Mesh
    sight: Sight
    region: Indices
    depth: F64
    mouth: Inside | None = None

    @classmethod
    def of(
        cls, mesh: Mesh, views: Sequence[FittedPhoto], occluder: Occluder, mouth: Inside | None, region: Indices | None
    ) -> Filler:
        """region None: one region."""
        sight = sight_of(mesh.vertices.astype(np.float64), meshes.unit(mesh.normals), views, occluder)
        region = np.zeros(len(mesh.vertices), np.int64) if region is None else region
        depth = outline_depth(mesh, np.flatnonzero(np.isin(region, LOOSE)), views, occluder, CLEAR)
        return cls(mesh, sight, region, depth, mouth)

    def __call__(self, albedo: F64, doubt: F64 | None = None) -> tuple[F64, F64]:
        """How far each vertex is replaced (V,), and by which albedo (V, 3), of the field's albedo (V, 3) and how far
        that is doubted (V,), if at all."""
        cosine = self.sight.cosine
        replaced = replaced_share(cosine, self.region)
        if doubt is not None:
            replaced = np.maximum(replaced, doubt)
            cosine = np.where(doubt > 0, 0.0, cosine)
        well = replaced == 0
        if well.any():
            points = self.mesh.vertices.astype(np.float64)
            colours = region_colours(points, albedo, self.region, cosine, self.depth)
            albedo = continued(self.mesh, albedo, well, colours, LENGTH)
        if self.mouth is not None:
            albedo = self.mouth.in_place_of(albedo, self.sight.cosine == 0)
        return replaced, albedo
