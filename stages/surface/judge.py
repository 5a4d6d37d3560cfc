"""The checks of the surface: measured figures are compared with limits.

Source of the limits: heads from clean rigs have one component, no handle, and less than 0.1 % thin surface; people
photographed by hand have 6 to 19 handles and 0.9 %; a badly broken torso has 44 and 1.9 %.
"""

from __future__ import annotations

from typing import Protocol

from pipeline.meshes import Topology
from pipeline.verdict import Finding, Limits, judged

UNSHOWN = Limits(0.01, 0.1, lower=False)  # of the visible surface: 0.01 is a collar's edge, 0.1 a shoulder
CUT_HANDLES = Limits(10, 100, lower=False)  # ears and hair of a head cause a few, a broken surface dozens
LEFT_HANDLES = Limits(0, 20, lower=False)  # each needs a seam around it; a skull has arches of its own (found: 5)
CAPPED = Limits(0.25, 0.5, lower=False)  # of the area: the cut of a neck is a tenth
TRIMMED = Limits(0.6, 0.9, lower=False)  # of the area: the user chose trimming; the back of the head is a half
THIN = Limits(0.015, 0.1, lower=False)  # of the area; see above
OPEN = Limits(0, 0, lower=False)


class Measured(Protocol):
    """The figures of the mesh (stages.surface.build.Built)."""

    @property
    def topology(self) -> Topology: ...
    @property
    def removed(self) -> int: ...
    @property
    def unshown(self) -> float: ...
    @property
    def cap(self) -> float: ...
    @property
    def trimmed(self) -> float: ...
    @property
    def thin(self) -> float: ...
    @property
    def handles(self) -> tuple[int, int]: ...
    @property
    def must_close(self) -> bool: ...


def judge(found: Measured) -> tuple[Finding, ...]:
    """All findings, including the good ones."""
    cut, left = found.handles
    opened = found.topology.boundary_edges + found.topology.crowded_edges + found.topology.pinched_vertices
    out = [
        judged(
            "pieces_dropped",
            found.unshown,
            UNSHOWN,
            f"{found.removed} disconnected components were removed; {found.unshown:.1%} of the surface that the photos "
            "show was on them",
            "check the masks: they may split the subject, or include something beside it",
        ),
        judged(
            "cap",
            found.cap,
            CAPPED,
            f"{found.cap:.0%} of the surface is a flat cut at the border of the region of interest",
            "check the masks (is the background black?), the cameras and the region of interest",
        ),
        judged(
            "handles_cut",
            cut,
            CUT_HANDLES,
            f"{cut} handles (tunnels) of the surface were cut and closed",
            "take more photos, from more sides, of the places where the surface is broken (the report shows them)",
        ),
        judged(
            "handles_left",
            left,
            LEFT_HANDLES,
            f"{left} handles (tunnels) are wider than surface.handle and were kept",
            "where the subject has none: raise surface.handle, or check the masks (an arm that touches the head)",
        ),
        judged(
            "thin",
            found.thin,
            THIN,
            f"{found.thin:.1%} of the surface belongs to flakes and needles thinner than two lattice cells",
            "check the borders of the masks; photograph hair and collar from more sides",
        ),
        judged(
            "trimmed",
            found.trimmed,
            TRIMMED,
            f"{found.trimmed:.0%} of the surface is visible in no photo and was cut off",
            "photograph the subject from more sides, or set surface.unseen=closed",
        ),
    ]
    if found.must_close:
        out.append(
            judged(
                "closed",
                opened,
                OPEN,
                f"{opened} edges or vertices of the surface are open or non-manifold",
                "change surface.resolution a little, fit longer, or install pymeshlab if it is missing",
            )
        )
    return tuple(out)
