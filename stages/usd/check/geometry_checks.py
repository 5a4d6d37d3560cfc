"""Checks of one UsdGeomMesh that the USD library does not make."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from stages.usd.check.chart_checks import chart_findings
from stages.usd.check.findings import Finding
from stages.usd.check.reader_checks import moves, reader_findings
from stages.usd.check.tile_checks import coordinate_findings, tiled

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
UNIT_TOLERANCE = 0.01  # float16 normals have an error of 0.001
EXTENT_TOLERANCE = 1e-5  # of the longest side


def mesh_findings(mesh: UsdGeom.Mesh) -> list[Finding]:
    """All findings on a mesh. If its topology is broken, only that is reported."""
    where = str(mesh.GetPath())
    points = np.array(mesh.GetPointsAttr().Get() or [], np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], np.int64)
    index = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], np.int64)
    fault = _topology(points, counts, index)
    if fault:
        return [Finding("error", "points" if "finite" in fault else "topology", fault, where)]
    sizes = {
        "vertex": len(points),
        "varying": len(points),
        "faceVarying": len(index),
        "uniform": len(counts),
        "constant": 1,
    }
    out = [*_extent(mesh, points), *_subdivision(mesh, counts), *_primvars(mesh, sizes)]
    normals, interpolation = _normals(mesh)
    if normals is None and _scheme(mesh) == UsdGeom.Tokens.catmullClark:
        return out  # its normals are those of the limit surface
    if normals is None:
        return [*out, Finding("warning", "normals", "no normals: programs will shade the mesh differently", where)]
    if len(normals) != sizes.get(interpolation):
        found = f"{len(normals)} {interpolation} normals, {sizes.get(interpolation)} expected"
        return [*out, Finding("error", "normals", found, where)]
    return [*out, *_against_winding(mesh, points, counts, index, normals, interpolation)]


def _topology(points: F64, counts: I64, index: I64) -> str:
    if not len(points) or not len(counts):
        return f"{len(points)} points, {len(counts)} faces"
    if not np.isfinite(points).all():
        return f"{int((~np.isfinite(points)).any(1).sum())} points are not finite"
    if counts.sum() != len(index):
        return f"{len(index)} face indices, {counts.sum()} expected from the counts"
    if index.min() < 0 or index.max() >= len(points):
        return f"face indices from {index.min()} to {index.max()}, {len(points)} points"
    if counts.min() < 3:
        return f"faces with {counts.min()} vertices"
    return ""


def _extent(mesh: UsdGeom.Mesh, points: F64) -> list[Finding]:
    where, attribute = str(mesh.GetPath()), mesh.GetExtentAttr()
    if not attribute.HasAuthoredValue():
        return [Finding("error", "extent", "not authored", where)]
    found, true = np.array(attribute.Get(), np.float64), np.stack([points.min(0), points.max(0)])
    if found.shape != true.shape or np.abs(found - true).max() > EXTENT_TOLERANCE * np.ptp(true, axis=0).max():
        return [Finding("error", "extent", f"{found.round(5).tolist()}, points span {true.round(5).tolist()}", where)]
    return []


def skeleton_findings(root: UsdSkel.Root) -> list[Finding]:
    """Findings on the extent of a SkelRoot: without one, USD computes a box from the joints alone; one that is authored
    must contain the meshes below."""
    where, extent = str(root.GetPath()), UsdGeom.Boundable(root).GetExtentAttr().Get()
    if not extent:
        return [Finding("error", "extent", "a SkelRoot has none, so that its box is that of the joints", where)]
    below = [UsdGeom.Mesh(p) for p in Usd.PrimRange(root.GetPrim()) if p.IsA(UsdGeom.Mesh)]
    low, high = np.array(extent, np.float64)
    room = EXTENT_TOLERANCE * np.ptp(np.array(extent), axis=0).max()
    for mesh in below:
        points = np.array(mesh.GetPointsAttr().Get() or [], np.float64).reshape(-1, 3)
        if len(points) and ((points.min(0) < low - room).any() or (points.max(0) > high + room).any()):
            return [Finding("error", "extent", f"the SkelRoot's box does not contain {mesh.GetPath().name}", where)]
    return []


def _scheme(mesh: UsdGeom.Mesh) -> str | None:
    attribute = mesh.GetSubdivisionSchemeAttr()
    return str(attribute.Get()) if attribute.HasAuthoredValue() else None


def _subdivision(mesh: UsdGeom.Mesh, counts: I64) -> list[Finding]:
    """Triangles are not subdivided. A cage has quads, no normals (programs would have to choose between them and those
    of the limit surface), and says what happens at its borders."""
    scheme, where = _scheme(mesh), str(mesh.GetPath())
    if scheme == UsdGeom.Tokens.none:
        return []
    if scheme != UsdGeom.Tokens.catmullClark:
        found = scheme or "not authored: clients smooth by default"
        return [Finding("error", "subdivisionScheme", f"{found}, expected none or catmullClark", where)]
    out = []
    if (counts != 4).any():
        text = f"{int((counts != 4).sum())} of {len(counts)} faces of a cage are not quads"
        out.append(Finding("error", "subdivisionScheme", text, where))
    if _normals(mesh)[0] is not None:
        out.append(Finding("error", "normals", "a cage has normals", where))
    for attribute in (mesh.GetInterpolateBoundaryAttr(), mesh.GetFaceVaryingLinearInterpolationAttr()):
        if not attribute.HasAuthoredValue():
            out.append(Finding("error", "subdivisionScheme", f"{attribute.GetName()} is not authored", where))
    return out


def _normals(mesh: UsdGeom.Mesh) -> tuple[F64 | None, str]:
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasAuthoredValue():
        return np.array(primvar.ComputeFlattened(), np.float64), str(primvar.GetInterpolation())
    if mesh.GetNormalsAttr().HasAuthoredValue():
        return np.array(mesh.GetNormalsAttr().Get(), np.float64), str(mesh.GetNormalsInterpolation())
    return None, ""


def _against_winding(
    mesh: UsdGeom.Mesh, points: F64, counts: I64, index: I64, normals: F64, interpolation: str
) -> list[Finding]:
    """Findings on normals: unit length, and direction towards the front side of the faces (by their winding)."""
    where, out = str(mesh.GetPath()), []
    length = np.linalg.norm(normals, axis=1)
    off = ~(np.abs(length - 1) <= UNIT_TOLERANCE)
    if off.any():
        out.append(Finding("error", "normals", f"{int(off.sum())} of {len(off)} are not of unit length", where))
    if interpolation in ("vertex", "varying", "faceVarying"):
        start = np.cumsum(counts) - counts
        corner = start[:, None] + np.arange(3)
        x = points[index[corner]]
        front = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        front *= -1 if mesh.GetOrientationAttr().Get() == "leftHanded" else 1
        mean = normals[index[corner] if interpolation != "faceVarying" else corner].sum(1)
        against = float(((mean * front).sum(1) < 0).mean())
        if against > 0.02:
            out.append(Finding("error", "winding", f"{against:.1%} of the faces point against their normals", where))
    return out


def _primvars(mesh: UsdGeom.Mesh, sizes: dict[str, int]) -> list[Finding]:
    """Findings on counts and indices of every primvar, and on texture coordinates: present, of the right type, finite,
    inside the unit square or with every face inside one UDIM tile."""
    out = []
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues():
        where = str(primvar.GetAttr().GetPath())
        values, indices = primvar.Get(), np.array(primvar.GetIndices() or [], np.int64)
        if not primvar.GetTypeName().isArray or values is None:
            continue
        if primvar.IsIndexed() and len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
            out.append(Finding("error", "primvar", f"index {indices.max()} of {len(values)} values", where))
            continue
        size = len(indices) if primvar.IsIndexed() else len(values) // max(primvar.GetElementSize(), 1)
        wanted = sizes.get(str(primvar.GetInterpolation()))
        if size != wanted:
            found = f"{size} values, {wanted} expected for {primvar.GetInterpolation()}"
            out.append(Finding("error", "primvar", found, where))
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    if not st or not st.HasAuthoredValue():
        return [*out, Finding("error", "st", "no texture coordinates", str(mesh.GetPath()))]
    if st.GetTypeName() != Sdf.ValueTypeNames.TexCoord2fArray:
        out.append(Finding("error", "st", f"type {st.GetTypeName()}, expected texCoord2f[]", str(mesh.GetPath())))
    values = np.array(st.Get(Usd.TimeCode.Default()), np.float64)
    if not out and np.isfinite(values).all() and st.GetInterpolation() == "faceVarying":
        corners = np.array(st.ComputeFlattened(), np.float64)
        in_row = tiled(mesh) or moves(mesh)
        placed = coordinate_findings(mesh, corners) if in_row else _in_square(mesh, values)
        return placed or [*reader_findings(mesh, corners), *chart_findings(mesh, corners)]
    return [*out, *_in_square(mesh, values)]


def _in_square(mesh: UsdGeom.Mesh, values: F64) -> list[Finding]:
    if np.isfinite(values).all() and values.min() >= -1e-5 and values.max() <= 1 + 1e-5:
        return []
    found = f"from {values.min():.4f} to {values.max():.4f}, expected 0 to 1"
    return [Finding("error", "st", found, str(mesh.GetPath()))]
