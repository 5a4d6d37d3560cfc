"""Writes the verdict into the asset's metadata, after the asset was written, checked and rendered.

In `assetInfo` of the component's prim, and in `customLayerData` of its layer:

    neuface:verdict         "good", "usable" or "unusable"
    neuface:verdictReasons  a sentence for each check that is not good, the worst first

The checks of the report stage, which compare the finished asset with the photos, come later and are not included.
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
    """Write the verdict into NAME.usd, and into NAME.usdz beside it if there is one.

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
    """Write the verdict into the first member of a package, which is its layer; the pictures do not change."""
    (name, content), *pictures = read_package(path)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / name
        file.write_bytes(content)
        layer = Sdf.Layer.OpenAsAnonymous(str(file))
        _note(layer, verdict)
        write_layer(layer, file, "usdc")
        write_package(path, [(name, file.read_bytes()), *pictures])
