"""Manifests: what they refuse, and that equal content has equal digests."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from pydantic import ValidationError

from pipeline.artifacts import FileRef, MaskSet, TextureMap, ViewMask, sha256_of
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.store import file_refs


def ref(path: str = "a.png") -> FileRef:
    return FileRef(path=path, sha256="0" * 64, size=1)


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../a", "a/../../b", "a/..", "..", ".", "", "a\\b", "C:\\x", "//server/x"]
)
def test_paths_that_leave_the_artifact_are_refused(path: str) -> None:
    with pytest.raises(ValidationError, match="relative path"):
        ref(path)


def test_a_manifest_from_outside_can_not_point_outside() -> None:
    text = Capture(kind="photos", views=(CaptureView(index=0, name="a", image=ref(), width=1, height=1),))
    bad = text.model_dump_json().replace('"a.png"', '"../../secret.png"')
    with pytest.raises(ValidationError, match="relative path"):
        Capture.model_validate_json(bad)


@pytest.mark.parametrize("path", ["a.png", "views/1.exr", "a b/ü.png", "..a", "a..b"])
def test_plain_paths_are_taken(path: str) -> None:
    assert ref(path).path == path


def test_file_ref_hashes_content(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/a.bin").write_bytes(b"abc" * 1_000_000)
    found = FileRef.of(tmp_path, "sub/a.bin")
    assert found == FileRef.of(tmp_path, tmp_path / "sub/a.bin")
    assert found.sha256 == hashlib.sha256(b"abc" * 1_000_000).hexdigest() == sha256_of(tmp_path / "sub/a.bin")
    assert (found.path, found.size) == ("sub/a.bin", 3_000_000)
    with pytest.raises(ValueError, match="subpath"):
        FileRef.of(tmp_path / "sub", tmp_path / "other")


def test_frozen_and_closed() -> None:
    with pytest.raises(ValidationError):
        ref().size = 2  # type: ignore[misc]
    with pytest.raises(ValidationError, match="extra"):
        FileRef(path="a", sha256="0", size=1, mtime=3)  # type: ignore[call-arg]


def test_digest_is_of_content_and_not_of_order_in_a_dict() -> None:
    def texture(files: dict[str, FileRef]) -> TextureMap:
        return TextureMap(name="albedo", channels=3, files=files, space="srgb_png", minimum=0, mean=0, maximum=1)

    a, b = ref("a.exr"), ref("a.png")
    assert texture({"exr": a, "png": b}).digest() == texture({"png": b, "exr": a}).digest()
    assert texture({"exr": a, "png": b}).digest() != texture({"exr": b, "png": a}).digest()


def test_json_round_trip_keeps_the_digest() -> None:
    masks = MaskSet(masks=(ViewMask(index=3, mask=ref(), source="net", coverage=1 / 3, hull_iou=0.1 + 0.2),))
    assert MaskSet.model_validate_json(masks.model_dump_json()).digest() == masks.digest()


def test_every_file_ref_is_found() -> None:
    view = CaptureView(index=0, name="a", image=ref("i"), width=1, height=1, mask=ref("m"))
    assert {r.path for r in file_refs(Capture(kind="photos", views=(view, view)))} == {"i", "m"}
    texture = TextureMap(name="x", channels=1, files={"exr": ref("e"), "png": ref("p")}, space="raw", minimum=0, mean=0,
                         maximum=0)  # fmt: skip
    assert [r.path for r in file_refs(texture)] == ["e", "p"]
