"""The HTML page: one self-contained file without network access. Only the 3D view's script may run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

from jinja2 import DictLoader, Environment, StrictUndefined, Template
from markupsafe import Markup, escape

from stages.report.collect import own_colours

ISLAND = re.compile(r'(<script type="application/json" id="timing">).*?(</script>)', re.S)
TABLE = re.compile(r"(<!-- timing -->).*?(<!-- /timing -->)", re.S)


@dataclass(frozen=True, slots=True)
class Picture:
    """A data URI and its caption."""

    uri: str
    caption: str


@dataclass(frozen=True, slots=True)
class ViewRow:
    """Pictures of one view: photo, model, asset, error. `note`: name of the photo and whether it was held out."""

    title: str
    note: str
    pictures: Sequence[Picture]


@dataclass(frozen=True, slots=True)
class Pictures:
    """The pictures of the page. `scale`: legend of the heat map, from 0 to `scale_top`."""

    views: Sequence[ViewRow] = ()
    sides: Sequence[Picture] = ()
    films: Sequence[Picture] = ()
    maps: Sequence[Picture] = ()
    light: Picture | None = None
    scale: str = ""
    scale_top: float = 0.0
    captured: object | None = None  # stages.report.capture_figures.Captured
    verdict: object | None = None  # stages.report.verdict.VerdictShown
    viewer: object | None = None  # stages.report.viewer.Viewer
    field: object | None = None  # stages.report.light_stage.FieldShown


def render_page(metrics: Mapping[str, Any], pictures: Pictures) -> str:
    """The page from the content of metrics.json and the pictures. The same input gives the same bytes."""
    return _template().render(m=metrics, p=pictures, headline=headline(metrics), sections=sections(metrics))


def headline(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """The most important figures: (value, name, explanation)."""
    h, kind = metrics["holdout"], "held-out photos" if metrics["holdout"]["held_out"] else "FITTED photos"
    out = []
    for prefix, what in (("", "model"), ("asset_", "exported asset")):
        if h.get(f"{prefix}psnr") is not None:
            out.append((f"{h[f'{prefix}psnr']:.1f} dB", f"PSNR, {what}", f"subject's pixels of {h['views']} {kind}"))
    if h.get("psnr_registered") is not None:
        meaning = (
            "as the first, after each held-out photo alone was registered to the model (six numbers of its camera)"
        )
        out.append((f"{h['psnr_registered']:.1f} dB", "PSNR, model, registered", meaning))
    if own_colours(metrics["model"]) and h.get("asset_psnr_matched") is not None:
        meaning = "as before, after a 3 x 3 matrix per photo, because photos differ in exposure or white balance"
        out.append((f"{h['asset_psnr_matched']:.1f} dB", "PSNR in the photos' colours, exported asset", meaning))
    for key, what, meaning in (
        ("asset_ssim", "SSIM, exported asset", "1 is equal"),
        ("asset_flip", "FLIP, exported asset", "0 is equal; models human perception"),
    ):
        if h.get(key) is not None:
            out.append((f"{h[key]:.3f}", what, meaning))
    if h.get("features_px") is not None:
        most = f"{h['features_px_most']:.1f} px at most"
        meaning = f"median distance from where {kind} of 512 px show eyes, brows, nose, mouth, chin; {most}"
        out.append((f"{h['features_px']:.1f} px", "features of the face, exported asset", meaning))
    out.append(_faces(metrics["uv"]))
    maps = metrics["maps"]
    times = f"{maps['tiles']} × " if maps["tiles"] > 1 else ""
    out.append((f"{times}{maps['size']}²", "texels", f"{100 * maps['covered_share']:.0f} % of them used"))
    return out


def _faces(uv: Mapping[str, Any]) -> tuple[str, str, str]:
    """The row with the number of faces, and of quads how far they are from the dense mesh."""
    if not uv["quads"]:
        return f"{uv['faces']:,}", "triangles", f"{uv['charts']} charts"
    apart = uv["faces"] - 2 * uv["quads"]
    besides = f"{apart:,} triangles, " if apart else ""
    return f"{uv['quads']:,}", "quads", f"{besides}{uv['charts']} charts, {uv['deviation_rms_mm']:.2g} mm off (RMS)"


def sections(metrics: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Tables of figures: (title, rows of name and value)."""
    out = []
    for key, title in (
        ("fit", "Fit"),
        ("cameras", "Cameras"),
        ("surface", "Surface"),
        ("uv", "Mesh and charts"),
        ("asset", "Asset"),
    ):
        out.append((title, [(_words(k), _value(v)) for k, v in metrics[key].items()]))
    if metrics["colour_chart"]["found"]:
        out.append(("Colour checker", [(_words(k), _value(v)) for k, v in metrics["colour_chart"].items()]))
    if metrics["regions"]:
        shares = [(_words(k), f"{100 * v:.1f} %") for k, v in metrics["regions"].items()]
        out.append(("Regions: share of the surface", shares))
    figures = [(_words(n), _value(v)) for n, v in metrics["maps"].items() if not isinstance(v, Mapping)]
    out.append(("Texture", figures))
    rows = [
        (n, f"{_value(m['mean'])}  ({_value(m['minimum'])} to {_value(m['maximum'])}), {m['channels']} channel(s)")
        for n, m in metrics["maps"].items()
        if isinstance(m, Mapping)
    ]
    return [*out, ("Maps: mean (range)", rows)]


def with_timing(html: str, timing: Mapping[str, float]) -> str:
    """The page with the seconds of each stage, as a table and as JSON. It may be called again."""
    island = json.dumps(dict(timing)).replace("<", "\\u003c")
    rows = "".join(f"<tr><th>{escape(_words(k))}</th><td>{v:.1f} s</td></tr>" for k, v in timing.items())
    table = f"<h3>Time</h3><table>{rows}</table>" if rows else ""
    html = ISLAND.sub(lambda m: m[1] + island + m[2], html, count=1)
    return TABLE.sub(lambda m: m[1] + table + m[2], html, count=1)


@lru_cache(maxsize=1)
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["words"] = _words
    environment.filters["value"] = _value
    environment.filters["sentence"] = lambda text: f"{text.rstrip('.')}."
    environment.filters["island"] = lambda x: Markup(json.dumps(x).replace("<", "\\u003c"))
    folder = files("stages.report").joinpath("templates")
    names = ("page.html.j2", "viewer.html.j2")
    environment.loader = DictLoader({n: folder.joinpath(n).read_text(encoding="utf-8") for n in names})
    return environment.get_template("page.html.j2")


def _words(key: object) -> str:
    return str(key).replace("_", " ")


def _value(value: object) -> str:
    """A figure as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
