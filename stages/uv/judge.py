"""The checks of the charts and the decimated mesh: measured figures are compared with limits.

Source of the limits: heads from clean rigs have 8 to 16 charts, at most one fragment, no overlap, and no stretched
surface; people photographed by hand have 9 to 32 charts and 0.1 to 0.6 % stretched surface; a badly broken torso has 64
charts and 2.5 %. Unusable surfaces had 583 to 3,945 charts, nine in ten of them fragments.
"""

from __future__ import annotations

from pipeline.verdict import Finding, Limits, judged
from stages.uv.chart_quality import Quality
from stages.uv.decimate import Deviation
from stages.uv.stretch import STRETCHED

# more than 40: the surface can't be cut into a few discs (stages.uv.charts)
CHARTS = Limits(40, 400, lower=False)
FACE = Limits(0.40, 0.0)  # of the area under charts: .416 to .420 if the face is in the mesh, .07 on a wrong mesh
FRAGMENTS = Limits(10, 200, lower=False)
OVERLAP = Limits(0.002, 0.01, lower=False)  # of the covered texels; warning and error limits of the USD check
EMPTY = Limits(1e-3, 5e-3, lower=False)  # of the surface; 0.5 % is the error limit of the USD check
MIRRORED = Limits(1e-3, 0.02, lower=False)  # of the surface
STRETCH = Limits(0.01, 0.1, lower=False)  # of the surface; L2 and Linf depend too much on a few slivers
DEVIATION = Limits(5e-4, 3e-3, lower=False)  # of the longest side; 0.3 and 1.8 mm for a head in a box of 0.6 m
AGAINST = Limits(2e-3, 0.02, lower=False)  # of the surface
OPEN = Limits(0, 0.01, lower=False)  # of the edges
CRUMPLED = Limits(5e-3, 0.02, lower=False)  # of the faces; 2 % is the error limit of the USD check

SHAPE = "look at the surface in the report; better masks and cameras make it smoother"


def judge(
    quality: Quality, deviation: Deviation, span: float, against: float, opened: float, crumpled: float
) -> tuple[Finding, ...]:
    """All findings, including the good ones. span: longest side of the mesh (m); against: share of the decimated
    surface that faces against the dense one; opened: share of its edges that the decimation left open; crumpled: share
    of its faces that point against the normals at their own corners."""
    q, off = quality, deviation.rms / max(span, 1e-30)
    return (
        *_face(q.face_share),
        judged("charts", q.charts, CHARTS, f"the surface needs {q.charts} charts", SHAPE),
        judged(
            "fragments",
            q.fragments,
            FRAGMENTS,
            f"{q.fragments} of {q.charts} charts are fragments, each with less than 0.05 % of the surface",
            SHAPE,
        ),
        judged(
            "overlap",
            q.overlap,
            OVERLAP,
            f"{q.overlap:.2%} of the covered texels belong to two places on the surface",
            "change uv.target_faces a little; " + SHAPE,
        ),
        judged(
            "texels_missing",
            q.empty,
            EMPTY,
            f"{q.empty:.2%} of the surface has no area in the texture",
            "change uv.target_faces a little; " + SHAPE,
        ),
        judged("mirrored", q.flipped, MIRRORED, f"{q.flipped:.2%} of the surface is mirrored in the texture", SHAPE),
        judged(
            "stretch",
            q.stretched,
            STRETCH,
            f"on {q.stretched:.1%} of the surface the texture is stretched by more than {STRETCHED:g} times",
            "raise uv.target_faces; " + SHAPE,
        ),
        judged(
            "deviation",
            off,
            DEVIATION,
            f"the textured mesh deviates {1000 * deviation.rms:.2g} mm (RMS) from the dense one, {off:.2%} of its size",
            "raise uv.target_faces",
        ),
        judged(
            "against_dense",
            against,
            AGAINST,
            f"{against:.2%} of the textured mesh faces against the dense mesh",
            "raise uv.target_faces",
        ),
        judged(
            "opened",
            opened,
            OPEN,
            f"the decimation left {opened:.2%} of the textured mesh's edges open",
            "change uv.target_faces or surface.resolution a little",
        ),
        judged(
            "crumpled",
            crumpled,
            CRUMPLED,
            f"{crumpled:.2%} of the faces point against the normals at their corners: the surface is crumpled there",
            SHAPE,
        ),
    )


def _face(share: float | None) -> tuple[Finding, ...]:
    """The finding on the face's texels; none if there are no landmarks, or uv.face is off."""
    if share is None:
        return ()
    message = f"the face has {share:.1%} of the area under charts"
    remedy = "the face is missing in the mesh (see face_shape_mm), or it is a small part of the mesh: check the masks"
    return (judged("face_share", share, FACE, message, remedy),)
