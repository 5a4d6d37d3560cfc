"""The reflectance field of a light stage in the asset: its maps, what describes them, and a shader.

    reflectance_field/NAME_MAP.exr      the field's own maps, under a second name
    reflectance_field/NAME_blocker.obj  what throws shadows
    reflectance_field/NAME_basis.json   lobes, lights, harmonics, shadows, and every file with its channels
    reflectance_field/NAME_field.osl    a shader for one lamp: reflectance_field.osl with the numbers of basis.json

docs/field_look.md describes them so that a shader can be written from them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.artifacts import Located
from pipeline.errors import StageError
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.store import link_or_copy
from stages.usd.layout import FIELD
from stages.usd.texture_names import DEFAULT, texture_name

MEANINGS = {
    "albedo": "diffuse albedo a, linear Rec.709",
    "lobes": "weight s_j of each global lobe: its reflectance at normal incidence",
    "normal": "normal n, x y z in asset coordinates; normalise after interpolation",
    "rest": "coefficients r_k of the light by way of other skin, channel 3 k + colour; radiance over e",
    "shadow": "share of each light of the stage that arrives less what is traced, one channel a light",
    "trust": "how far that is known, 0 to 1, one channel a light",
    "openpbr": "base colour (3), F0 and roughness of standard shaders; not used by the field",
    "coverage": "1 where a camera saw the texel, 0 where it was filled",
    "surface": "position in metres (3) and normal (3) of the field's mesh, asset coordinates; 32-bit floats",
}
READ_BY_SHADER = ("albedo", "lobes", "normal", "rest", "shadow", "trust")
BLOCKER, BASIS, SHADER = "blocker", "basis", "field"
CONVENTIONS = {
    "frame": "asset coordinates: metres, right-handed, +Y up, +Z out of the face",
    "texels": "row 0 is at v = 1; the centre of column i, row j is u = (i + .5) / size, v = 1 - (j + .5) / size; "
    "bilinear between centres, clamped at the border; on the first tile of the asset's texture coordinates",
    "units": "lamp: radiant intensity I per colour, linear Rec.709; result: radiance in the unit of I per square metre",
    "radiance": "max(V (a max(n.l, 0) / pi + sum_j s_j lobe_j) + sum_k r_k Y_k(d), 0) I e",
    "e": "max(axis . -l, 0) / distance^2; axis: along which the lamp shines",
    "lobe_j": "n.l D G / (4 n.l n.v) (1 + fresnel_rise (1 - v.h)^5) where n.l > 0; GGX of width alphas[j], Smith's "
    "shadowing correlated by height; n.l and n.v not below their least values in it",
    "V": "t^2 (3 - 2 t), t = clamp(traced + sum_i w_i trust_i shadow_i / (sum_i w_i trust_i + unknown), 0, 1)",
    "w_i": "exp((d . towards_i - 1) / (1 - cos kernel_degrees))",
    "d": "unit direction from centre to the lamp; that of the lamp itself if it is distant",
    "traced": "share of shadow.rays rays that meet no triangle of blocker, 0 where N.l <= shadow.least_n_dot_l; "
    "each from p + lift N to lamp + disc_radius (cos t across + sin t along), t = 2 pi k / rays + first_angle; "
    "N: normal of the surface; across = axis x (unit vector of its smallest part), normalised; along = axis x across",
    "Y_k": "sum of c x^i y^j z^l of d over the entries [c, i, j, l] of harmonics[k]",
    "towards": "unit directions from centre to the lights of the channels of shadow and trust; lights: their numbers",
}


@dataclass(frozen=True, slots=True)
class FieldLook:
    """Paths of the files in the asset by their names ("albedo", ..., "basis", "field"), relative to its layers."""

    files: Mapping[str, str]


def write_field(reflectance: Located[ReflectanceField], name: str, asset: Path) -> tuple[list[Path], FieldLook | None]:
    """Write the folder of a light stage's field; nothing for other captures. name: of the asset.

    Raises:
        StageError: the field has none of the files that a shader needs.
    """
    if not reflectance.artifact.present:
        return [], None
    sources = {f.path.rpartition("/")[2]: reflectance.path(f) for f in reflectance.artifact.files}
    wanted = [*(f"{n}.exr" for n in MEANINGS), f"{BLOCKER}.obj", f"{BASIS}.json"]
    missing = [n for n in wanted if n not in sources]
    if missing:
        raise StageError(
            "files of the reflectance field are missing",
            where="reflectance",
            value=", ".join(missing),
            limit="every map, blocker.obj and basis.json",
            remedy="run neuface run again: the reflectance stage writes them",
        )
    (asset / FIELD).mkdir(parents=True, exist_ok=True)
    written = {n: field_file(asset, name, n, "exr") for n in MEANINGS}
    for which, path in written.items():
        link_or_copy(sources[f"{which}.exr"], path)
    written[BLOCKER] = field_file(asset, name, BLOCKER, "obj")
    link_or_copy(sources[f"{BLOCKER}.obj"], written[BLOCKER])
    basis = json.loads(sources[f"{BASIS}.json"].read_text())
    written[BASIS] = field_file(asset, name, BASIS, "json")
    written[BASIS].write_text(json.dumps(described(basis, written), indent=1) + "\n")
    written[SHADER] = field_file(asset, name, SHADER, "osl")
    written[SHADER].write_text(shader_of(basis, written))
    return list(written.values()), FieldLook({n: f"./{FIELD}/{p.name}" for n, p in written.items()})


def field_file(asset: Path, name: str, which: str, kind: str) -> Path:
    """The file of a part of the field. Names are those of internal/: of one tile."""
    return asset / FIELD / f"{texture_name(DEFAULT, name, which)}.{kind}"


def described(basis: Mapping[str, Any], written: Mapping[str, Path]) -> dict[str, Any]:
    """basis.json of the asset: the field's own, with its files and its conventions."""
    files: dict[str, Any] = {
        n: {"file": written[n].name, "channels": basis["channels"][n], "meaning": text} for n, text in MEANINGS.items()
    }
    files[BLOCKER] = {"file": written[BLOCKER].name, "meaning": "triangles that throw shadows, asset coordinates"}
    kept = {k: v for k, v in basis.items() if k != "channels"}
    return {"conventions": CONVENTIONS, "files": files, **kept}


def shader_of(basis: Mapping[str, Any], written: Mapping[str, Path]) -> str:
    """The OSL shader of a field: the numbers of its basis.json as definitions, then reflectance_field.osl."""
    terms = [[k, *term] for k, harmonic in enumerate(basis["harmonics"]) for term in harmonic]
    lists = {
        "TOWARDS": [x for d in basis["towards"] for x in d],
        "TERMS": [x for t in terms for x in t],
        "ALPHAS": basis["alphas"],
    }
    lobe, shadow = basis["lobe"], basis["shadow"]
    numbers = {
        "LIGHTS": len(basis["towards"]), "CENTRE": ", ".join(_number(x) for x in basis["centre"]),
        "KERNEL_DEGREES": basis["kernel_degrees"], "UNKNOWN": basis["unknown"],
        "FRESNEL_RISE": lobe["fresnel_rise"], "LEAST_NL": lobe["least_n_dot_l"], "LEAST_NV": lobe["least_n_dot_v"],
        "LIFT": shadow["lift"], "DISC_RADIUS": shadow["disc_radius"], "RAYS": shadow["rays"],
        "FIRST_ANGLE": shadow["first_angle"], "LEAST_TRACED": shadow["least_n_dot_l"],
    }  # fmt: skip
    lines = [f'#define {n.upper()} "{written[n].name}"' for n in READ_BY_SHADER]
    lines += [f"#define {n} {v}" for n, v in numbers.items()]
    for n, values in lists.items():
        lines += [f"#define {n}_COUNT {len(values)}", f"#define {n} {{ {', '.join(map(_number, values))} }}"]
    return "\n".join(lines) + "\n\n" + Path(__file__).with_name("reflectance_field.osl").read_text()


def _number(value: float) -> str:
    return f"{float(value):.9g}"
