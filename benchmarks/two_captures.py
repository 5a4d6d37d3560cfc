"""What a second capture under another light brings: the fitted field against photos and the true albedo.

    python -m benchmarks.two_captures OUT [OUT ...]

Each OUT is a run that went to inverse_rendering at least, with `--holdout` and with or without `--also`, whose store is
still there. Printed are the PSNR of the held-out photos of each capture (dB, sRGB, the subject's pixels; as they are,
and after one 3 x 3 matrix a photo), and that of the fitted albedo seen from the cameras of the first capture's
truth/albedo (mean over views; as it is, and after one gain for all).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.artifacts import HeldOutView, Located
from pipeline.fields.face import load_face
from pipeline.images import read_alpha, read_exr, read_linear, shrink_whole
from pipeline.store import Store
from stages import registry
from stages.inverse_rendering.load_views import camera_only
from stages.inverse_rendering.observations import surface_hits
from stages.inverse_rendering.ray_sampling import image_rays
from stages.report.metrics import matched, psnr_fg
from workflows.evaluation import geometry

WHOLE = 0.99  # alpha of compared pixels of the albedo


def found_in(run: Path) -> dict[str, Located[Any]]:
    """The artifacts of a run up to the fit, and of its second capture."""
    record = json.loads((run / "run.json").read_text())
    store = Store(Path(record["store"]))
    outputs = {s.name: s.output for s in registry.with_second()}
    wanted = [
        n for n in record["stages"] if n.removeprefix(registry.ALSO) in ("capture", "poses", "masks", registry.FIT)
    ]
    out = {n: store.load(n, record["stages"][n]["key"], outputs[n]) for n in wanted}
    gone = [n for n, found in out.items() if found is None]
    if gone:
        raise SystemExit(f"{run}: {', '.join(gone)} no longer in the store {store.root}; run it again")
    return {n: found for n, found in out.items() if found is not None}


def held_out(
    fit: Located[Any], views: Sequence[HeldOutView], capture: Located[Any], masks: Located[Any]
) -> tuple[float, float]:
    """Mean PSNR of predicted views, as they are and in each photo's own colours."""
    photos, alphas = ({x.index: x for x in many} for many in (capture.artifact.views, masks.artifact.masks))
    scores = []
    for v in views:
        rendered, _ = read_exr(fit.path(v.exr))
        photo = shrink_whole(read_linear(capture.path(photos[v.index].image)), v.scale)
        mask = shrink_whole(read_alpha(masks.path(alphas[v.index].mask)), v.scale)
        scores.append([psnr_fg(r[..., :3], photo, mask) for r in (rendered, matched(rendered, photo, mask))])
    raw, own = np.mean(scores, 0)
    return float(raw), float(own)


def albedo(found: dict[str, Located[Any]], truth: Path) -> tuple[float, float, float] | None:
    """PSNR of the field's albedo, as it is and after one gain, and that gain; None without a truth."""
    fit = found[registry.FIT]
    field = load_face(fit.path(fit.artifact.field))
    cameras = {c.index: c for c in found["poses"].artifact.cameras}
    pairs = []
    for path in sorted((truth / "albedo").glob("*.exr")):
        if int(path.stem) not in cameras:
            continue
        camera, (true, _) = cameras[int(path.stem)], read_exr(path)
        alpha = read_alpha(truth / "alpha" / f"{path.stem}.png")
        alpha = shrink_whole(alpha, alpha.shape[0] // true.shape[0])
        rays = image_rays(camera_only(camera), camera.height // true.shape[0], "cpu")
        x, _, pixel = surface_hits(field.model.geometry, rays, torch.arange(len(rays.d)))
        keep = alpha.reshape(-1)[pixel.numpy()] > WHOLE
        want = true[..., :3].reshape(-1, 3)[pixel.numpy()][keep]
        pairs.append((field.material(x.numpy()[keep]).albedo.astype(np.float64), want.astype(np.float64)))
    if not pairs:
        return None
    gain = geometry.best_gain(*(np.concatenate(part) for part in zip(*pairs, strict=True)))
    raw, gained = (
        float(np.mean([geometry.psnr(geometry.as_seen(k * a), geometry.as_seen(b)) for a, b in pairs]))
        for k in (1.0, gain)
    )
    return raw, gained, gain


def row(run: Path) -> str:
    """One line of a run."""
    found = found_in(run)
    fit, record = found[registry.FIT], json.loads((run / "run.json").read_text())
    parts = [
        f"held out {x:.2f} / {y:.2f}"
        for x, y in [held_out(fit, fit.artifact.held_out, found["capture"], found["masks"])]
    ]
    if fit.artifact.second is not None:
        other = [found[registry.ALSO + n] for n in ("capture", "masks")]
        parts += [f"second {x:.2f} / {y:.2f}" for x, y in [held_out(fit, fit.artifact.second.held_out, *other)]]
    known = albedo(found, Path(record["request"]["capture"]) / "truth")
    if known is not None:
        parts.append(f"albedo {known[0]:.2f} / {known[1]:.2f} (gain {known[2]:.3f})")
    return f"{run}: " + "; ".join(parts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    for one in parser.parse_args().runs:
        print(row(one), flush=True)
