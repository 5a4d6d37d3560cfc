"""Builds the project's head template from MakeHuman's files (CC0) into pipeline/template/hm08.

    python -m benchmarks.build_template SOURCE [--out DIR] [--pictures DIR]

SOURCE holds base.obj, hm08.mirror, targets/ and faceunits/. The same files give the same template. About two minutes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.hm08 import figures, identity, landmarks, layout, look, regions
from benchmarks.hm08.arkit import NAMES as ARKIT
from benchmarks.hm08.cut import Cut, cut_head, islands, joint_centres
from benchmarks.hm08.layout_inside import inside_layout
from benchmarks.hm08.source import expressions, read_source, shape_targets
from benchmarks.hm08.write import write_template
from pipeline.meshes import F64, Indices

OWN = Path(__file__).resolve().parents[1] / "pipeline/template/hm08"
HEADS, HEADS_SEED, HEADS_SPREAD = 10, 5, 0.8  # heads that the face network looks at, besides the average one


def middle_of_head(mean: F64, cut: Cut, label: Indices) -> F64:
    """(3,) the middle of the box around the skin without the neck, on the middle plane."""
    skin = np.arange(*cut.parts["skin"])
    head = mean[np.unique(cut.quads[skin[label[skin] != regions.NAMES.index("neck")]])]
    return np.asarray((head.min(0) + head.max(0)) / 2 * [0, 1, 1], np.float64)


def crown(mean: F64, cut: Cut) -> int:
    """The highest vertex of the skin's middle line: there the seam begins."""
    skin = np.unique(cut.part("skin"))
    line = skin[cut.mirror[skin] == skin]
    return int(line[mean[line, 1].argmax()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, default=OWN)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of regions, landmarks and layout")
    options = parser.parse_args()
    source = read_source(options.source)
    cut = cut_head(source)
    targets = shape_targets(source)
    anchor = np.unique(cut.quads[islands(cut)[0]])
    offsets = identity.target_offsets(source, cut, targets, anchor)
    base = np.concatenate([source.vertices[cut.rows], joint_centres(source.vertices, cut)])
    weights = identity.sampled_weights(list(targets), identity.SAMPLES, identity.SEED)
    found = identity.principal(base, offsets, weights, cut.mirror)
    print(f"{len(found.basis)} components, {found.variance:.2%} of the variance")
    label = regions.labels(found.mean, cut, targets)
    uv = inside_layout(found.mean, cut, source.uvs)
    outside = np.isnan(uv[:, 0, 0])
    skin = layout.skin_layout(found.mean, cut, label, crown(found.mean, cut))
    v = np.full(uv.shape[:2], np.nan)
    v[: len(skin)] = skin[..., 1]
    uv[outside] = skin[outside[: len(skin)]]
    random = np.random.default_rng(HEADS_SEED)
    others = random.standard_normal((HEADS, len(found.basis))) * HEADS_SPREAD * found.deviation
    heads = [found.mean, *(found.mean + np.tensordot(w, found.basis, 1) for w in others)]
    points = landmarks.find_landmarks(found.mean, heads, cut, label, v)
    print(f"{len(points.names)} landmarks; left out: {points.left_out}")
    count, names = len(cut.mirror), list(targets)
    error = figures.identity_error(
        found.mean, figures.stored_basis(found, cut), base[:count], offsets[:, :count], names, figures.OTHER_SEED
    )
    worth = {
        "variance": round(found.variance, 5),
        "symmetric_components": int(found.symmetric.sum()),
        "identity_error_mm": figures.summary(error),
        "layout": figures.layout_figures(found.mean, cut, label, uv),
    }
    print(json.dumps(worth, indent=1))
    centre = middle_of_head(found.mean, cut, label)
    write_template(
        options.out, options.source, cut, label, found, centre, uv, expressions(source, ARKIT), points, worth
    )
    if options.pictures:
        look.write_pictures(options.pictures, found, cut, label, uv, points)


if __name__ == "__main__":
    main()
