"""Writes into the asset how good it is. That is known last: when it was written, checked and rendered.

`assetInfo` of the component's prim, and the same as `customLayerData` of its layer:

    neuface:verdict         "good", "usable" or "unusable"
    neuface:verdictReasons  a sentence for each check that is not good, the worst first

The report's own checks, which compare the finished asset with the photos, come later: they are not in it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from pxr import Sdf, Vt

from pipeline.verdict import Verdict
from stages.usd.write.export import write_layer
from stages.usd.write.package import read_package, write_package

NAMESPACE, LEVEL, REASONS = "neuface", "verdict", "verdictReasons"


def mark(root: Path, verdict: Verdict) -> None:
    """Mark NAME.usd, and NAME.usdz if it lies beside it.

    Raises:
        StageError: a layer can't be written.
    """
    layer = Sdf.Layer.OpenAsAnonymous(str(root))
    _note(layer, verdict)
    write_layer(layer, root, "usda")
    package = root.with_suffix(".usdz")
    if package.is_file():
        _mark_package(package, verdict)


def _note(layer: Sdf.Layer, verdict: Verdict) -> None:
    metadata = {LEVEL: verdict.level, REASONS: Vt.StringArray(verdict.reasons())}
    prim = layer.GetPrimAtPath(f"/{layer.defaultPrim}")
    prim.SetInfo("assetInfo", {**dict(prim.assetInfo), NAMESPACE: metadata})
    layer.customLayerData = {**layer.customLayerData, NAMESPACE: metadata}


def _mark_package(path: Path, verdict: Verdict) -> None:
    """A package is opened by its first member: that layer is marked, the pictures are kept as they are."""
    (name, content), *pictures = read_package(path)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / name
        file.write_bytes(content)
        layer = Sdf.Layer.OpenAsAnonymous(str(file))
        _note(layer, verdict)
        write_layer(layer, file, "usdc")
        write_package(path, [(name, file.read_bytes()), *pictures])
