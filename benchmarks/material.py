"""The exported material of a run against its truth: F0, roughness, level of the albedo, relit views.

    python -m benchmarks.material OUT CAPTURE [--maps FOLDER] [--melanin M] [--other OUT2] [--relit FOLDER:ALPHA]

OUT        a run, or a folder with asset/ and run.json; its exported files are read, as an artist's program reads them
CAPTURE    its photos: the demo's (demo.json), or a folder with truth/maps and truth/mesh_gt.ply (`head_a`)
--maps     truth of another capture of the same head in the same world (`head_b`: that of `head_a`)
--melanin  of a demo with another skin tone (benchmarks/skin_tones.py)
--other    another run of the same head: how far the two albedos agree, after one gain
--relit    pictures of `neuface render OUT --env` and, after a comma, the folder of true ones; their PSNR

Points are spread evenly over the asset where photos show it well (coverage 1, confidence CONFIDENT); skin: the label
face of the photos; lips: inside the outer lip's landmarks. Correlations are over points, errors medians.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.transforms import apply, matrix

F64 = npt.NDArray[np.float64]
POINTS = 60_000
CONFIDENT = 0.75  # of the map: as two photos that look straight at the place
SKIN_RANGE = (0.02, 0.045)
LIP = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)  # the outer outline
LIP_DEPTH = 0.015  # metres in front of or behind the outline's plane


@dataclass(frozen=True)
class Spots:
    """Points of an asset: world (N, 3) of the capture, asset (N, 3); albedo (N, 3), f0, roughness (N,); skin (N,)."""

    world: F64
    asset: F64
    albedo: F64
    f0: F64
    roughness: F64
    skin: npt.NDArray[np.bool_]


def spots_of(out: Path) -> Spots:
    """Of a run's exported asset, where photos show it well."""
    import trimesh

    from stages.usd.render import exported
    from stages.usd.render.render import Renderer

    record = json.loads((out / "run.json").read_text())
    root = out / record["asset"]
    asset = exported.load_exported(root)
    assert asset.f0 is not None and asset.roughness is not None, "the standard material was not fitted"
    renderer, mesh = Renderer(asset), asset.mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    x, face = trimesh.sample.sample_surface(solid, POINTS, seed=0)
    weights = trimesh.triangles.points_to_barycentric(solid.triangles[face], x)
    uv = (mesh.uvs[mesh.uv_faces[face]] * weights[:, :, None]).sum(1).astype(np.float32)

    def at(name: str) -> F64:
        image = exported._map(root.parent, root.stem, name, asset.tiles)[..., :1]
        return renderer.at(image, uv)[:, 0].astype(np.float64)

    well = (at("coverage") > 0.99) & (at("confidence") > CONFIDENT)
    code = record_code(out, record)
    skin = np.abs(at("region") - code) < 0.1 if code > 0 else np.zeros(len(x), np.bool_)
    values = [renderer.at(m, uv).astype(np.float64)[well] for m in (asset.albedo, asset.f0, asset.roughness)]
    world = apply(matrix(record["capture_from_asset"]), x.astype(np.float64))
    return Spots(world[well], x[well], values[0], values[1][:, 0], values[2][:, 0], skin[well])


def record_code(out: Path, record: dict[str, Any]) -> int:
    """The label of the face in the region map; -1 without one."""
    names = manifest(record, "masks").get("label_names", [])
    return names.index("face") if "face" in names else -1


def manifest(record: dict[str, Any], stage: str) -> dict[str, Any]:
    """Of a stage of a run, from its store."""
    path = Path(record["store"]) / stage / record["stages"][stage]["key"] / "manifest.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return found


# ------------------------------------------------------------------ truth
def truth_of(capture: Path, maps: Path | None, melanin: float, world: F64) -> tuple[F64, F64, F64] | None:
    """Albedo (N, 3), F0 and roughness (N,) at points of the capture's world."""
    if (capture / "demo.json").is_file():
        from benchmarks.skin_tones import toned

        with toned(melanin) as skin:
            true = skin.material(world, int(json.loads((capture / "demo.json").read_text())["seed"]))
        return true.albedo, true.f0, true.roughness
    folder = maps or capture / "truth"
    return _painted(folder, world) if (folder / "maps/specular_gt.png").is_file() else None


def _painted(folder: Path, world: F64) -> tuple[F64, F64, F64]:
    """Of the scanned head: F0 = 0.08 (0.15 + 0.45 s), roughness = 0.50 - 0.15 s of its specular map s."""
    import cv2
    import trimesh
    from scipy.spatial import cKDTree

    from pipeline.colour import linear_from_srgb

    mesh: Any = trimesh.load(folder / "mesh_gt.ply", process=False)
    points, face = trimesh.sample.sample_surface(mesh, 400_000, seed=1)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    uv = (mesh.visual.uv[mesh.faces[face]] * weights[:, :, None]).sum(1)[cKDTree(points).query(world)[1]]

    def looked_up(name: str, blur: float) -> F64:
        image = cv2.GaussianBlur(
            cv2.imread(str(folder / "maps" / name), cv2.IMREAD_UNCHANGED)[::-1] / 255.0, (0, 0), blur
        )
        side = image.shape[0]
        column, row = (uv * side).astype(int).clip(0, side - 1).T
        return np.asarray(image[row, column], np.float64)

    shine = looked_up("specular_gt.png", 2.0)
    albedo = linear_from_srgb(looked_up("albedo_gt.jpg", 0.5)[:, ::-1])
    return np.asarray(albedo, np.float64), 0.08 * (0.15 + 0.45 * shine), 0.5 - 0.15 * shine


def lips(record: dict[str, Any], x: F64) -> npt.NDArray[np.bool_]:
    """(N,) whether points, asset coordinates, are on the lips."""
    import cv2

    from pipeline.faces.landmarks3d import load_landmarks

    found = manifest(record, "masks").get("landmarks")
    if found is None:
        return np.zeros(len(x), np.bool_)
    folder = Path(record["store"]) / "masks" / record["stages"]["masks"]["key"]
    outline = load_landmarks(folder / found["path"])[list(LIP)]
    centre = outline.mean(0)
    axes = np.linalg.svd(outline - centre)[2]
    flat, at = ((p - centre) @ axes.T for p in (outline, x))
    line = (1e4 * flat[:, :2]).astype(np.float32)
    near = np.flatnonzero(np.abs(at[:, 2]) < LIP_DEPTH)
    out = np.zeros(len(x), np.bool_)
    out[near] = [cv2.pointPolygonTest(line, (float(a), float(b)), False) > 0 for a, b in 1e4 * at[near, :2]]
    return out


# ------------------------------------------------------------------ figures
def agreement(name: str, got: F64, true: F64) -> str:
    """One line."""
    vary = got.std() > 0 and true.std() > 0
    r = f"{np.corrcoef(got, true)[0, 1]:.3f}" if vary else "-"
    off = 100 * (got.mean() / true.mean() - 1)
    ends = [f"{np.quantile(v, 0.05):.4f} to {np.quantile(v, 0.95):.4f}" for v in (got, true)]
    return (
        f"{name}: correlation {r}, median error {np.median(np.abs(got - true)):.4f}, mean {got.mean():.4f} (true "
        f"{true.mean():.4f}, {off:+.0f} %), 5 to 95 %: {ends[0]} (true {ends[1]})"
    )


def lines(out: Path, capture: Path, maps: Path | None, melanin: float) -> list[str]:
    """Everything about one run."""
    record = json.loads((out / "run.json").read_text())
    s = spots_of(out)
    inside = (s.f0 >= SKIN_RANGE[0]) & (s.f0 <= SKIN_RANGE[1])
    share = f"{100 * inside[s.skin].mean():.1f} %" if s.skin.any() else "-"
    found = [
        f"{len(s.f0)} points, {s.skin.sum()} of skin; skin with F0 in {SKIN_RANGE}: {share}",
        f"F0 of all: mean {s.f0.mean():.4f}, 5 to 95 % {np.quantile(s.f0, 0.05):.4f} to {np.quantile(s.f0, 0.95):.4f}",
        f"F0 against the albedo of skin: r = {np.corrcoef(s.f0[s.skin], s.albedo[s.skin].mean(1))[0, 1]:.3f}"
        if s.skin.any() and s.f0[s.skin].std() > 0
        else "F0 does not vary over skin",
    ]
    truth = truth_of(capture, maps, melanin, s.world)
    if truth is None:
        return found
    albedo, f0, roughness = truth
    for name, own in (("all", np.ones(len(s.f0), np.bool_)), ("skin", s.skin), ("lips", lips(record, s.asset))):
        if own.sum() < 20:
            continue
        found.append(agreement(f"{name}, F0", s.f0[own], f0[own]))
        found.append(agreement(f"{name}, roughness", s.roughness[own], roughness[own]))
        ratio = s.albedo[own].mean(0) / albedo[own].mean(0)
        found.append(
            f"{name}, mean albedo over the true one: {ratio.mean():.3f}; R, G, B {np.round(ratio, 3).tolist()}"
        )
    return found


def alike(one: Spots, other: Spots) -> str:
    """How far the albedos of two runs of one head agree."""
    from scipy.spatial import cKDTree

    from workflows.evaluation.geometry import as_seen, best_gain, psnr

    gap, nearest = cKDTree(other.world).query(one.world)
    both = gap < 0.003
    a, b = one.albedo[both], other.albedo[nearest[both]]
    on_skin = one.skin[both]
    gain = best_gain(b, a)
    whole, skin = (psnr(as_seen(gain * b[m]), as_seen(a[m])) for m in (np.ones(len(a), np.bool_), on_skin))
    return f"albedo against the other run, after one gain {gain:.3f}: {whole:.2f} dB, on skin {skin:.2f} dB"


def relit(pictures: Path, true: Path, alphas: Path | None) -> str:
    """PSNR of pictures I.exr against those of the same name."""
    from benchmarks.compare_views import compare
    from pipeline.images import read_alpha, read_exr, shrink

    rows = []
    for path in sorted(pictures.glob("*.exr")):
        wanted = true / path.name
        if not wanted.is_file():
            continue
        a, b = read_exr(path)[0], read_exr(wanted)[0]
        side = min(len(a), len(b))
        a, b = (shrink(v, len(v) // side) for v in (a, b))
        alpha = b[..., 3] if alphas is None else shrink(read_alpha(alphas / f"{path.stem}.png"), 1)
        alpha = shrink(alpha, len(alpha) // side)
        scores = compare(a[..., :3], b[..., :3], alpha)
        rows.append([scores["raw"], scores["gain"], scores["matrix"], scores["exposure"]])
    mean = np.mean(rows, 0)
    return (
        f"{len(rows)} relit views: {mean[0]:.2f} dB, one gain {mean[1]:.2f}, matrix {mean[2]:.2f}; gain {mean[3]:.3f}"
    )


def main() -> None:
    """See the module."""
    p = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    p.add_argument("out", type=Path)
    p.add_argument("capture", type=Path)
    p.add_argument("--maps", type=Path)
    p.add_argument("--melanin", type=float, default=0.0)
    p.add_argument("--other", type=Path)
    p.add_argument("--relit", action="append", default=[], metavar="PICTURES,TRUE[,ALPHAS]")
    options = p.parse_args()
    print("\n".join(lines(options.out, options.capture, options.maps, options.melanin)))
    if options.other:
        print(alike(spots_of(options.out), spots_of(options.other)))
    for pair in options.relit:
        pictures, true, *alphas = map(Path, pair.split(","))
        print(f"{pictures}: {relit(pictures, true, alphas[0] if alphas else None)}")


if __name__ == "__main__":
    main()
