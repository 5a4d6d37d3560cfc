"""The variant `look=reflectance_field` of a light stage's asset.

It gives the material of the first tile the files of the measured field as attributes `reflectance_field:NAME`. Its
networks stay those of the standard look, which every program shows: USD has no kind of network for such a field, and
its validators refuse a shader prim that no renderer has registered.
"""

from __future__ import annotations

from collections.abc import Sequence

from pxr import Sdf, Usd

from stages.usd.write.field_files import FieldLook
from stages.usd.write.shading import T
from stages.usd.write.variants import STANDARD

FIELD_LOOK = "reflectance_field"


def write_field_look(stage: Usd.Stage, prim: Usd.Prim, names: Sequence[str], look: FieldLook) -> None:
    """Add the variant to the set `look` of the component. names: of the materials that have the field."""
    looks = prim.GetVariantSets().GetVariantSet("look")
    looks.AddVariant(FIELD_LOOK)
    looks.SetVariantSelection(FIELD_LOOK)
    with looks.GetVariantEditContext():
        for name in names:
            material = stage.OverridePrim(prim.GetPath().AppendPath(f"mtl/{name}"))
            for which, file in look.files.items():
                made = material.CreateAttribute(
                    f"{FIELD_LOOK}:{which}", T.Asset, custom=True, variability=Sdf.VariabilityUniform
                )
                made.Set(Sdf.AssetPath(file))
    looks.SetVariantSelection(STANDARD)
