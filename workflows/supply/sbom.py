"""A bill of materials (CycloneDX 1.5, JSON) from the locks, and the page of licences.

    python -m workflows.supply.sbom --out FILE      the bill
    python -m workflows.supply.sbom --write         docs/licences.md

Licences are those that the installed distributions state. What the project ships with itself is in BUNDLED.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflows.supply.lock import ROOT, Pinned, locked

PAGE = ROOT / "docs/licences.md"
UNKNOWN = "not stated"
# Packages that name no licence outside of their licence file: what that file is.
READ = {"embreex": "BSD-2-Clause", "openexr": "BSD-3-Clause", "xatlas": "MIT"}
CLASSIFIER = "License :: OSI Approved :: "


@dataclass(frozen=True, slots=True)
class Bundled:
    """A part that is in this repository: name, version, SPDX licence, package URL, and its files."""

    name: str
    version: str
    licence: str
    purl: str
    files: tuple[str, ...]


BUNDLED = (
    Bundled(
        "three.js",
        "0.187.0",
        "MIT",
        "pkg:npm/three@0.187.0",
        tuple(
            f"stages/report/three/{n}.js"
            for n in (
                "BufferGeometryUtils",
                "GLTFLoader",
                "OrbitControls",
                "SkeletonUtils",
                "three.core",
                "three.module",
            )
        ),
    ),
    Bundled(
        "MediaPipe face networks",
        "0.10.21",
        "Apache-2.0",
        "pkg:pypi/mediapipe@0.10.21",
        ("pipeline/faces/models/face_detection_short_range.tflite", "pipeline/faces/models/face_landmark.tflite"),
    ),
    Bundled(
        "MediaPipe selfie segmentation network",
        "0.10.21",
        "Apache-2.0",
        "pkg:pypi/mediapipe@0.10.21",
        ("stages/masks/models/selfie_segmentation.tflite",),
    ),
    Bundled(
        "hm08 head template",
        "1",
        "CC0-1.0",
        "pkg:generic/hm08@1",
        ("pipeline/template/hm08/head.npz", "pipeline/template/hm08/manifest.json"),
    ),
)


def licence_of(name: str) -> str:
    """What the installed distribution states: its SPDX expression, else its field, its classifiers, its file."""
    try:
        said = importlib.metadata.metadata(name).json
    except importlib.metadata.PackageNotFoundError:
        return UNKNOWN
    expression = str(said.get("license_expression", ""))
    field = " ".join(str(said.get("license", "")).split())
    classified = [c.removeprefix(CLASSIFIER) for c in said.get("classifier", ()) if c.startswith(CLASSIFIER)]
    short = field if 0 < len(field) <= 60 and field.upper() != "UNKNOWN" else ""  # some put the whole text there
    return expression or short or " / ".join(classified) or READ.get(name, UNKNOWN)


def bill(pins: Sequence[Pinned], root: Path = ROOT) -> dict[str, Any]:
    """The document. The same locks give the same bytes: it has no date, and its number is a hash of its content."""
    components = [
        {
            "type": "library",
            "bom-ref": f"pkg:pypi/{p.name}@{p.version}",
            "name": p.name,
            "version": p.version,
            "purl": f"pkg:pypi/{p.name}@{p.version}",
            "licenses": [{"license": {"name": licence_of(p.name)}}],
            "hashes": [{"alg": "SHA-256", "content": h} for h in p.hashes],
        }
        for p in pins
    ]
    for part in BUNDLED:
        components += [
            {
                "type": "file",
                "bom-ref": file,
                "name": file,
                "version": part.version,
                "description": part.name,
                "purl": part.purl,
                "licenses": [{"license": {"id": part.licence}}],
                "hashes": [{"alg": "SHA-256", "content": hashlib.sha256((root / file).read_bytes()).hexdigest()}],
            }
            for file in part.files
        ]
    project = importlib.metadata.metadata("neuface-asset")
    about = {
        "type": "application",
        "bom-ref": "neuface-asset",
        "name": "neuface-asset",
        "version": str(project["Version"]),
        "licenses": [{"license": {"id": "Apache-2.0"}}],
    }
    number = uuid.UUID(hashlib.sha256(json.dumps([about, components], sort_keys=True).encode()).hexdigest()[:32])
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": number.urn,
        "version": 1,
        "metadata": {"component": about},
        "components": components,
    }


def page(pins: Sequence[Pinned]) -> str:
    """The document of licences."""
    lines = [
        "# Licences of all parts",
        "",
        "The project is Apache-2.0. This page lists what it is installed with, from the lock files, and what it ships.",
        "Licences are as the packages state them. `make sbom` writes the same for programs, with hashes",
        "(`out/sbom.cdx.json`, CycloneDX 1.5). Made by `python -m workflows.supply.sbom --write`.",
        "",
        "pymeshlab is GPL-3: README, Licences, says what that means.",
        "Wheels may hold libraries under other terms: pi-heif libheif and libde265 (LGPL-3), rawpy LibRaw (LGPL-2.1 or",
        "CDDL-1.0), as shared libraries that can be exchanged.",
        "",
        "## Shipped in this repository",
        "| part | version | licence | files |",
        "|---|---|---|---|",
    ]
    lines += [f"| {b.name} | {b.version} | {b.licence} | {', '.join(f'`{f}`' for f in b.files)} |" for b in BUNDLED]
    lines += ["", "## Installed", "| package | version | licence |", "|---|---|---|"]
    lines += [f"| {p.name} | {p.version} | {licence_of(p.name)} |" for p in pins]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str]) -> int:
    """Write what was asked for."""
    parser = argparse.ArgumentParser(description="A bill of materials from the lock files")
    parser.add_argument("--out", metavar="FILE", help="write the bill; - for standard output")
    parser.add_argument("--write", action="store_true", help="write docs/licences.md")
    options = parser.parse_args(arguments)
    if not (options.out or options.write):
        parser.error("--out or --write")
    pins = locked()
    if options.write:
        PAGE.write_text(page(pins))
    if options.out:
        text = json.dumps(bill(pins), indent=1) + "\n"
        if options.out == "-":
            sys.stdout.write(text)
        else:
            path = Path(options.out)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
