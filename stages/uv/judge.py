"""How good the charts and the decimated mesh are: measured figures against limits.

Where the limits are from: heads in clean rigs have 8 to 16 charts, at most one fragment, no overlap, and none of their
surface is stretched; people photographed by hand have 9 to 32 charts and 1 to 6 thousandths, a torso in shreds 64 and
25. Surfaces that could not be used had 583 to 3,945 charts, nine in ten of them fragments.
"""

from __future__ import annotations

from pipeline.verdict import Finding, Limits, judged
from stages.uv.chart_quality import STRETCHED, Quality
from stages.uv.decimate import Deviation

# more than 40: the surface does not come apart into a few discs (stages.uv.charts)
CHARTS = Limits(40, 400, lower=False)
FACE = Limits(0.40, 0.0)  # of the area under charts: .416 to .420 on people whose face is in the mesh, .07 in a blob
FRAGMENTS = Limits(10, 200, lower=False)
OVERLAP = Limits(0.002, 0.01, lower=False)  # of the covered texels; what the check of the USD file warns of and refuses
EMPTY = Limits(1e-3, 5e-3, lower=False)  # of the surface; half a per cent is what the check of the USD file refuses
MIRRORED = Limits(1e-3, 0.02, lower=False)  # of the surface
STRETCH = Limits(0.01, 0.1, lower=False)  # of the surface; L2 and Linf are ruled by a few slivers
DEVIATION = Limits(5e-4, 3e-3, lower=False)  # of the longest side; of a head in a box of 0.6 m 0.3 and 1.8 mm
AGAINST = Limits(2e-3, 0.02, lower=False)  # of the surface
OPEN = Limits(0, 0.01, lower=False)  # of the edges
CRUMPLED = Limits(5e-3, 0.02, lower=False)  # of the faces; 2 % is what the check of the USD file refuses

SHAPE = "look at the surface in the report: masks and cameras decide how smooth it is"


def judge(
    quality: Quality, deviation: Deviation, span: float, against: float, opened: float, crumpled: float
) -> tuple[Finding, ...]:
    """All findings, good ones too. span: longest side of the mesh (m); against: share of the decimated surface that
    looks against the dense one; opened: share of its edges that the decimation left open; crumpled: share of its faces
    that look against the normals at their own corners."""
    q, off = quality, deviation.rms / max(span, 1e-30)
    return (
        *_face(q.face_share),
        judged("charts", q.charts, CHARTS, f"the surface comes apart into {q.charts} charts", SHAPE),
        judged(
            "fragments",
            q.fragments,
            FRAGMENTS,
            f"{q.fragments} of {q.charts} charts are fragments with less than half a thousandth of the surface",
            SHAPE,
        ),
        judged(
            "overlap",
            q.overlap,
            OVERLAP,
            f"{q.overlap:.2%} of the covered texels belong to two places of the surface",
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
            f"the texture is stretched more than {STRETCHED:g} times on {q.stretched:.1%} of the surface",
            "raise uv.target_faces; " + SHAPE,
        ),
        judged(
            "deviation",
            off,
            DEVIATION,
            f"the textured mesh is {1000 * deviation.rms:.2g} mm from the dense one, {off:.2%} of its longest side",
            "raise uv.target_faces",
        ),
        judged(
            "against_dense",
            against,
            AGAINST,
            f"{against:.2%} of the textured mesh looks against the dense one",
            "raise uv.target_faces",
        ),
        judged(
            "opened",
            opened,
            OPEN,
            f"{opened:.2%} of the textured mesh's edges were left open by the decimation",
            "change uv.target_faces or surface.resolution a little",
        ),
        judged(
            "crumpled",
            crumpled,
            CRUMPLED,
            f"{crumpled:.2%} of the faces look against the normals at their corners: the surface is crumpled there",
            SHAPE,
        ),
    )


def _face(share: float | None) -> tuple[Finding, ...]:
    """Of the texels; nothing where no landmarks say what the face is, or uv.face is off."""
    if share is None:
        return ()
    message = f"the face has {share:.1%} of the area under charts"
    remedy = (
        "the mesh does not have the face where the photos show it (look at face_shape_mm), or the face is a small part "
        "of it: check the masks"
    )
    return (judged("face_share", share, FACE, message, remedy),)
