"""The manifests of the asset and of the report. As in pipeline/artifacts.py."""

from __future__ import annotations

from pipeline.artifacts import Artifact, FileRef, HeldOutView, RelativePath
from pipeline.verdict import Finding


class UsdAsset(Artifact):
    """The exported component. `root`: the file to open; `files`: all files, with relative paths.

    figures: measurements of the export, by name. stated: author, licence and consent, as given by the user.
    """

    name: str
    root: RelativePath
    files: tuple[FileRef, ...]
    views: tuple[HeldOutView, ...] = ()
    figures: dict[str, float] = {}
    stated: dict[str, str] = {}
    checks: int
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


class Report(Artifact):
    """One self-contained page and its figures."""

    files: tuple[FileRef, ...]
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
