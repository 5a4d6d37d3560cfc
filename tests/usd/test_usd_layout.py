"""textures/ holds what an artist imports, internal/ the rest; an asset of an older version is read as it is."""

from __future__ import annotations

import re
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
from pxr import Sdf

from pipeline.asset_artifacts import UsdAsset
from stages.usd.layout import FOR_ARTISTS, existing, folder_of, is_read_by_the_asset, light_file
from stages.usd.render.exported import load_exported


def opened(asset: Path) -> set[str]:
    """Every file that a layer of the asset names, as a path below its folder: from the layers as text."""
    layers = [Sdf.Layer.FindOrOpen(str(f)) for f in sorted(asset.glob("*.usd*")) if f.suffix != ".usdz"]
    return {Path(found).as_posix() for layer in layers for found in re.findall("@([^@]+)@", layer.ExportToString())}


def test_an_artist_finds_maps_of_standard_shaders_and_nothing_else(exported: tuple[Path, UsdAsset]) -> None:
    asset = exported[0] / "asset"
    maps = {p.name.split(".")[0].removeprefix("head_") for p in (asset / "textures").iterdir()}
    assert maps <= FOR_ARTISTS and {"albedo", "normal", "roughness", "f0"} <= maps
    assert {p.name for p in asset.iterdir() if p.is_dir()} == {"textures", "internal", "thumbnails"}
    assert not list(asset.glob("*.json"))


def test_of_internal_the_asset_opens_what_is_said(exported: tuple[Path, UsdAsset]) -> None:
    asset = exported[0] / "asset"
    read = {f for f in opened(asset) if f.startswith("internal/")}
    assert read and all(is_read_by_the_asset(f) for f in read)
    there = {f"internal/{p.name}" for p in (asset / "internal").iterdir()}
    unread = {f for f in there - read if f.endswith(".exr") and is_read_by_the_asset(f)}
    assert unread <= {"internal/head_neuface_albedo.exr"}  # the layer reads its PNG
    for name in ("light.json", "head_confidence.exr", "head_basis_lut.exr", "head_shininess.exr"):
        assert not is_read_by_the_asset(f"internal/{name}")
    assert is_read_by_the_asset("internal/head_scan_coefficients_rgb12.1003.exr")


def test_an_asset_with_all_maps_in_textures_is_rendered_too(exported: tuple[Path, UsdAsset], tmp_path: Path) -> None:
    asset = Path(shutil.copytree(exported[0] / "asset", tmp_path / "asset"))
    now = load_exported(asset / "head.usd")
    for file in (asset / "internal").iterdir():
        file.rename(asset / (file.name if file.name == "light.json" else f"textures/{file.name}"))
    (asset / "internal").rmdir()
    assert light_file(asset) == asset / "light.json"
    assert existing(asset, "head", "basis_lut", "exr") == asset / "textures/head_basis_lut.exr"
    before = load_exported(asset / "head.usd")
    for field in fields(now):
        a, b = getattr(now, field.name), getattr(before, field.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)


def test_unknown_maps_are_internal() -> None:
    assert (folder_of("albedo"), folder_of("basis_rgb3"), folder_of("of_tomorrow")) == (
        "textures", "internal", "internal")  # fmt: skip
