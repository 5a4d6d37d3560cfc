"""What the table of captures shows: its figures in narrow tables, each column explained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, Any]
NOTHING = "-"
# The three endings that are distinguished; everything else is a failure.
ENDINGS = {0: "0", 3: "3 (unusable)"}


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a row. better: +1 if more is better, -1 if less, 0 if neither. absolute, relative: what a change must
    exceed, both of it, to be more than noise. scale: of what is shown."""

    name: str
    title: str
    means: str
    better: int = 0
    absolute: float = 0.0
    relative: float = 0.0
    form: str = "{:.2f}"
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Table:
    """A heading and its columns."""

    title: str
    figures: tuple[Figure, ...]


# .1 dB and 2 %: two runs of one commit differ by less on one machine; other work on it changes seconds by far more.
DB, MM, SHARE = 0.1, 0.01, 0.01
TABLES = (
    Table(
        "What came out",
        (
            Figure("psnr", "model (dB)", "PSNR of the fitted model over the subject in held-out views", 1, DB),
            Figure("psnr_matched", "matched (dB)", "the same in each photo's own colours (`psnr_matched`)", 1, DB),
            Figure(
                "psnr_registered",
                "registered (dB)",
                "of the model, after each held-out photo alone was registered to it (`psnr_registered`)",
                1,
                DB,
            ),
            Figure("asset_psnr", "asset (dB)", "PSNR of the exported asset over the same pixels", 1, DB),
            Figure("asset_psnr_matched", "matched (dB)", "the same in each photo's own colours", 1, DB),
            Figure(
                "features_px",
                "features (px)",
                "of 512: median distance of the face's features in the asset from where held-out photos show them",
                -1,
                0.1,
                0.0,
                "{:.1f}",
            ),
            Figure("features_px_most", "at most", "the largest of these", -1, 0.5, 0.0, "{:.1f}"),
            Figure(
                "mask_median",
                "masks",
                "median over photos of each mask's IoU with the hull of the others",
                1,
                0.005,
                0.0,
                "{:.3f}",
            ),
            Figure("mask_worst", "worst", "the lowest of these", 1, 0.02, 0.0, "{:.3f}"),
            Figure("unseen", "unseen (%)", "share of the texels that no photo saw", -1, SHARE, 0.02, "{:.0f}", 100),
            Figure("charts", "charts", "charts of the texture", -1, 5, 0.1, "{:.0f}"),
            Figure("fragments", "fragments", "charts with less than 0.05 % of the surface", -1, 5, 0.1, "{:.0f}"),
            Figure(
                "face_share",
                "face (%)",
                "share of the covered texels of its tile with the label face or eyes",
                1,
                SHARE,
                0.02,
                "{:.1f}",
                100,
            ),
        ),
    ),
    Table(
        "Against the truth",
        (
            Figure(
                "accuracy_mm",
                "accuracy (mm)",
                "mean distance, asset to true surface, where three fitted views see it",
                -1,
                MM,
                0.02,
            ),
            Figure("completeness_mm", "completeness (mm)", "the same from the true surface to the asset", -1, MM, 0.02),
            Figure("chamfer_mm", "chamfer (mm)", "the mean of both", -1, MM, 0.02),
            Figure(
                "skin_median_mm",
                "skin (mm)",
                "rendered persons: median distance from visible skin to the asset",
                -1,
                MM,
                0.02,
            ),
            Figure(
                "depth_median_mm",
                "face depth (mm)",
                "rendered persons: median error of the face's depth along rays",
                -1,
                MM,
                0.02,
            ),
            Figure("depth_p95_mm", "95 % (mm)", "95 % of these errors are smaller", -1, 0.05, 0.02),
            Figure(
                "face_missed",
                "face missed (%)",
                "share of these rays that miss the asset",
                -1,
                0.005,
                0.0,
                "{:.1f}",
                100,
            ),
            Figure("albedo_db", "albedo (dB)", "PSNR of the albedo seen from cameras with a true one", 1, DB),
            Figure("albedo_gain_db", "one gain (dB)", "the same after the one factor that fits best", 1, DB),
            Figure("albedo_gain", "gain", "that factor", 0, 0.02, 0.0, "{:.3f}"),
        ),
    ),
)
PLACED = Figure("placed", "placed", "photos that have a camera, of those that were read", 1, 0, 0.0, "{:.0f}")
SECONDS = Figure(
    "seconds", "in all", "of all stages; those from an earlier run with their time then", -1, 5, 0.05, "{:.0f}"
)
MEMORY = Figure("memory_mb", "MB", "peak memory of the process", -1, 100, 0.1, "{:.0f}")
FIGURES = (PLACED, *(f for t in TABLES for f in t.figures), SECONDS, MEMORY)
LABELS = ("skin", "hair", "eyes", "cloth", "outline")


def ending(row: Row) -> str:
    """How a run ended, in a word or two."""
    ended = row["ended"]
    if ended["how"] != "by itself":
        return str(ended["how"])
    return ENDINGS.get(ended["exit_code"], f"{ended['exit_code']} (failed)")


def shown(figure: Figure, row: Row) -> str:
    """A figure of a row, or a dash."""
    value = row.get("figures", {}).get(figure.name)
    return NOTHING if value is None else figure.form.format(figure.scale * value)


# ------------------------------------------------------------------ Markdown
def markdown(rows: Mapping[str, Row]) -> str:
    """The whole page."""
    parts = [_head(rows), _endings(rows)]
    parts += [_plain(t, rows) for t in TABLES]
    parts += [_stages(rows), _labels(rows), _materials(rows), _made(rows)]
    return "\n\n".join(p for p in parts if p) + "\n"


def _head(rows: Mapping[str, Row]) -> str:
    presets = sorted({str(r["preset"]) for r in rows.values()})
    commits = {str(r["commit"]) for r in rows.values()}
    mixed = ""
    if len(commits) > 1:
        mixed = " The rows are not all of one commit: the last table shows the commit of each."
    return (
        "# Captures\n\n"
        f"Made by `neuface bench captures`, preset {', '.join(presets)}; {len(rows)} captures, each with the photos of "
        f"its split held out of the fit.{mixed} A dash: not measured, because the run ended before it, or there is no "
        "truth or no label. Truth is only used for scoring."
    )


def _endings(rows: Mapping[str, Row]) -> str:
    lines = []
    for name, row in rows.items():
        figures, verdict = row.get("figures", {}), row["verdict"]
        placed, photos = figures.get("placed"), figures.get("photos")
        of = NOTHING if photos is None else f"{NOTHING if placed is None else placed} of {photos}"
        held = figures.get("held_out")
        why = "; ".join(verdict["reasons"]) or row["ended"]["error"] or row.get("fault") or NOTHING
        lines.append([name, ending(row), verdict["level"], of, NOTHING if held is None else str(held), _cell(why)])
    explained = {
        "exit": "0: good or usable; 3: unusable, the asset is written but where the fit was not made; else: failed",
        "verdict": "the run's own, none where it has none",
        "placed": PLACED.means,
        "held out": "views that were kept from the fit and are scored",
        "worst reasons": "of the verdict, or the last error of a run that failed",
    }
    titles = ["capture", "exit", "verdict", "placed", "held out", "worst reasons"]
    return _section("How it ended", titles, lines, explained)


def _plain(table: Table, rows: Mapping[str, Row]) -> str:
    kept = {n: r for n, r in rows.items() if any(shown(f, r) != NOTHING for f in table.figures)}
    lines = [[name, *(shown(f, row) for f in table.figures)] for name, row in kept.items()]
    explained: dict[str, str] = {}
    before = ""
    for figure in table.figures:  # a title may be there twice: after another column it is of that one
        explained[f"{before}: {figure.title}" if figure.title in explained else figure.title] = figure.means
        before = figure.title
    return _section(table.title, ["capture", *(f.title for f in table.figures)], lines, explained)


def _stages(rows: Mapping[str, Row]) -> str:
    names = list(dict.fromkeys(s for r in rows.values() for s in r["seconds"]))
    lines = [
        [name, *(_number(row["seconds"].get(s), "{:.0f}") for s in names), shown(SECONDS, row), shown(MEMORY, row)]
        for name, row in rows.items()
        if row["seconds"]
    ]
    explained = {SECONDS.title: SECONDS.means, MEMORY.title: MEMORY.means}
    return _section("Seconds", ["capture", *(n.replace("_", " ") for n in names), "in all", "MB"], lines, explained)


def _labels(rows: Mapping[str, Row]) -> str:
    lines = []
    for name, row in rows.items():
        for which, parts in row.get("labels", {}).items():
            cells = [
                f"{parts[k]['psnr']:.1f} ({100 * parts[k]['error']:.0f} %)" if k in parts else NOTHING for k in LABELS
            ]
            lines.append([name, which, *cells])
    explained = {
        "dB": "PSNR over the held-out photos' pixels of each label, and that label's share of the whole squared error",
        "outline": "within 4 pixels of the subject's outline; these pixels count for no label",
    }
    return _section("By label, rendered persons", ["capture", "of the", *LABELS], lines, explained)


def _materials(rows: Mapping[str, Row]) -> str:
    lines = []
    for name, row in rows.items():
        for label, figures in row.get("materials", {}).items():
            ranges = [_range(figures.get(k)) for k in ("f0", "roughness")]
            lines.append([name, label, f"{100 * figures['share'][0]:.1f}", *ranges])
    explained = {
        "label": "of the masks stage, as the photos vote for it; unlabelled: no photo with labels sees the place",
        "texels": "its share of the covered texels",
        "F0, GGX roughness": "least, mean and largest value of the baked maps",
    }
    return _section("Material", ["capture", "label", "texels (%)", "F0", "GGX roughness"], lines, explained)


def _made(rows: Mapping[str, Row]) -> str:
    machines = list(dict.fromkeys(str(r["machine"]) for r in rows.values()))
    lines = [
        [n, str(machines.index(r["machine"]) + 1), r["commit"], r["date"], f"`{r['command']}`"] for n, r in rows.items()
    ]
    explained = {
        "machine": "; ".join(f"{i}: {m}" for i, m in enumerate(machines, 1)),
        "commit": "a + means that files differed from it",
    }
    return _section("How it was made", ["capture", "machine", "commit", "date", "command"], lines, explained)


def _section(title: str, titles: Sequence[str], lines: Sequence[Sequence[str]], explained: Mapping[str, str]) -> str:
    if not lines:
        return ""
    rule = "|" + "---|" * len(titles)
    table = "\n".join(["| " + " | ".join(titles) + " |", rule, *("| " + " | ".join(x) + " |" for x in lines)])
    return f"## {title}\n\n{table}\n\n" + "\n".join(f"- *{k}*: {v}." for k, v in explained.items())


def _range(values: Sequence[float] | None) -> str:
    return NOTHING if values is None else " / ".join(f"{v:.3f}" for v in values)


def _number(value: float | None, form: str) -> str:
    return NOTHING if value is None else form.format(value)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "/")
