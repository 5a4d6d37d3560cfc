"""What a finished run had to do, counted from its settings and its manifests. No picture is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import StageError
from workflows.compare.runs import read_side

NEEDED = ("capture", "poses", "masks")  # without these nothing can be counted
DRAWN = (".jpg", ".jpeg")  # photos that are decoded as JPEG; the others count as PNG


@dataclass(frozen=True, slots=True)
class Counts:
    """A run. settings: stage.name -> value. seconds: of each of its stages. bytes: of each stage's files.

    photos, fitted, held: numbers of views. jpeg, png: pixels of the photos by the kind of file; sources: their bytes.
    subject: mean share of a photo that is subject. solved: whether cameras were solved; person: whether masks are of
    the network for people, with refined contours. order, rank: results of the fit. faces, cell: of the dense
    surface (metres). template: whether the asset is made from it. render: faces
    of the textured mesh; texels: under charts; exr_maps, png_maps: texels of one channel in all maps' files of a kind.
    """

    settings: Mapping[str, Any]
    seconds: Mapping[str, float]
    bytes: Mapping[str, int]
    photos: int
    fitted: int
    held: int
    jpeg: float
    png: float
    sources: float
    subject: float
    solved: bool
    person: bool
    order: int = 0
    rank: int = 0
    faces: int = 0
    cell: float = 0.0
    template: bool = False
    render: int = 0
    texels: float = 0.0
    exr_maps: float = 0.0
    png_maps: float = 0.0

    def setting(self, name: str) -> float:
        """A setting that is a number."""
        return float(self.choice(name))

    def choice(self, name: str) -> Any:
        """A setting. Raises StageError if the run's record does not have it."""
        if name not in self.settings:
            raise StageError(
                "this run can't be counted",
                where=name,
                value="a setting that its record in the store lacks",
                limit="a run of this version, whose store is complete",
                remedy="run the capture again with the same --out and --store, then repeat this command",
            )
        return self.settings[name]

    def written(self, stage: str) -> float:
        """Bytes of a stage's files; 0 for one that the run has not."""
        return float(self.bytes.get(stage, 0))

    @property
    def pixels(self) -> float:
        """Of all photos."""
        return self.jpeg + self.png

    @property
    def area(self) -> float:
        """Of the dense surface, square metres. A surface of area A crosses A (|nx| + |ny| + |nz|) / h^2 cells of edge
        h, 1.5 A / h^2 over all directions, and marching cubes makes two triangles in each."""
        return self.faces * self.cell**2 / 3


def counts_of(out: Path) -> Counts:
    """Of the run in a folder.

    Raises:
        StageError: it holds no run, or its store no longer has the manifests.
    """
    side = read_side("RUN", out)
    stages = side.record["stages"]
    manifests = {name: side.run.manifest(name) for name in stages}
    gone = [name for name in NEEDED if not manifests.get(name)]
    if gone:
        raise StageError(
            "this run can't be counted",
            where=out / "run.json",
            value=f"no manifest of {', '.join(gone)} in the store {side.record['store'] or '(unknown)'}",
            limit=f"the stored results of at least {', '.join(NEEDED)}",
            remedy="run the capture again with the same --out and --store, then repeat this command",
        )
    views = {v["index"]: v for v in manifests["capture"]["views"]}
    masks = manifests["masks"]["masks"]
    fit, surface = manifests.get("inverse_rendering", {}), manifests.get("surface", {})
    uv, bake = manifests.get("uv", {}), manifests.get("bake", {})
    sides = bake.get("sides") or [bake.get("size", 0)] * bake.get("tiles", 0)
    shares = uv.get("tile_utilisation") or [uv.get("utilisation", 0.0)] * len(sides)
    drawn = [v for v in views.values() if v["image"]["path"].lower().endswith(DRAWN)]
    jpeg = sum(v["width"] * v["height"] for v in drawn)
    return Counts(
        settings=side.settings(),
        seconds={name: float(s.get("seconds") or 0.0) for name, s in stages.items()},
        bytes={name: sum(sizes(m)) for name, m in manifests.items()},
        photos=len(views),
        fitted=len(fit.get("fitted_views") or [v for v in views.values() if not v["holdout"]]),
        held=sum(v["holdout"] for v in views.values()),
        jpeg=jpeg,
        png=sum(v["width"] * v["height"] for v in views.values()) - jpeg,
        sources=sum(v["image"]["size"] for v in views.values()),
        subject=sum(m["coverage"] for m in masks) / max(len(masks), 1),
        solved=manifests["poses"]["source"] != "given",
        person=any(m["source"].startswith("person") for m in masks),
        order=int(fit.get("light_order", 0)),
        rank=int(fit.get("rank", 0)),
        faces=int(surface.get("faces", 0)),
        cell=float(surface.get("cell", 0.0)),
        template=bool(uv.get("of_template")),
        render=int(uv.get("faces", 0)),
        texels=sum(n * n * share for n, share in zip(sides, shares, strict=False)),
        exr_maps=_maps(bake, sides, "exr"),
        png_maps=_maps(bake, sides, "png"),
    )


def sizes(manifest: object) -> Iterator[int]:
    """Bytes of each file that a manifest names."""
    if isinstance(manifest, dict):
        if isinstance(manifest.get("path"), str) and isinstance(manifest.get("size"), int):
            yield manifest["size"]
        for value in manifest.values():
            yield from sizes(value)
    elif isinstance(manifest, list):
        for value in manifest:
            yield from sizes(value)


def _maps(bake: Mapping[str, Any], sides: list[int], kind: str) -> float:
    """Texels of one channel in the maps' files of a kind."""
    total = 0.0
    for one in bake.get("maps", {}).values():
        names = [n for n in one["files"] if n.endswith(kind)]
        total += one["channels"] * sum(n * n for n in sides[: len(names)])
    return total
