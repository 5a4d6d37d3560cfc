"""Slits in assets: pixels of the captured cameras in which one sees the inside of the asset's surface.

    python -m benchmarks.seen_through OUT...

OUT: the --out of a run. In every camera one ray for each pixel of a picture of about 512 pixels; its first face must
look at the camera. A slit between two parts shows the inside of the surface behind it, lit from the other side.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pipeline import meshes
from pipeline.camera import PinholeCamera
from pipeline.meshes import F64
from pipeline.ray_casting import RayCaster
from pipeline.transforms import pixel_centres
from stages.usd.render.exported import load_exported, read_cameras

SIDE = 512  # pixels, about


def counted(caster: RayCaster, facing: F64, view: PinholeCamera) -> tuple[int, int]:
    """Pixels that the asset covers, and those of them in which it shows its inside. facing (F, 3): normals of faces,
    of any length."""
    small = view.scaled(view.width // max(1, round(max(view.width, view.height) / SIDE)))
    origin, directions = small.rays(pixel_centres(small.width, small.height))
    face = caster.first_faces(np.broadcast_to(origin, directions.shape), directions)
    hit = face >= 0
    return int(hit.sum()), int(((facing[face[hit]] * directions[hit]).sum(1) > 0).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="+", type=Path)
    for out in parser.parse_args().out:
        mesh = load_exported(out / "asset" / "head.usd").mesh
        caster, facing = RayCaster(mesh.vertices, mesh.faces), meshes.area_vectors(mesh.vertices, mesh.faces)
        cameras = read_cameras(out / "asset" / "lookdev.usda")
        found = np.array([counted(caster, facing, view) for view, _ in cameras.values()])
        covered, inside = found.sum(0)
        print(f"{out.name}: {inside} of {covered} pixels, {1e4 * inside / covered:.2f} in ten thousand")


if __name__ == "__main__":
    main()
