"""How good the surface is: measured figures against limits.

Where the limits are from: heads in clean rigs have one piece, no handle, and less than a thousandth of their surface
is thin; people photographed by hand have 6 to 19 handles and 9 thousandths, a torso in shreds 44 and 19.
"""

from __future__ import annotations

from typing import Protocol

from pipeline.meshes import Topology
from pipeline.verdict import Finding, Limits, judged

UNSHOWN = Limits(0.01, 0.1, lower=False)  # of what the photos show: a collar's edge, against a shoulder
CUT_HANDLES = Limits(10, 100, lower=False)  # a head's ears and hair make a few, shreds dozens
LEFT_HANDLES = Limits(0, 4, lower=False)  # each costs a seam all round it
CAPPED = Limits(0.25, 0.5, lower=False)  # of the area: the cut of a neck is a tenth; a box is all cap
TRIMMED = Limits(0.6, 0.9, lower=False)  # of the area: asked for by the user, the back of the head is a half
THIN = Limits(0.015, 0.1, lower=False)  # of the area; see above
OPEN = Limits(0, 0, lower=False)


class Measured(Protocol):
    """What the mesher found (stages.surface.build.Built)."""

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
    """All findings, good ones too."""
    cut, left = found.handles
    opened = found.topology.boundary_edges + found.topology.crowded_edges + found.topology.pinched_vertices
    out = [
        judged(
            "pieces_dropped",
            found.unshown,
            UNSHOWN,
            f"{found.removed} loose pieces were dropped; {found.unshown:.1%} of the surface that the photos show is "
            "theirs",
            "look at the masks: the subject is in several pieces, or something beside it is masked too",
        ),
        judged(
            "cap",
            found.cap,
            CAPPED,
            f"{found.cap:.0%} of the surface is where the region of interest cuts the fitted solid",
            "check the masks (is the background black?), the cameras and the region of interest",
        ),
        judged(
            "handles_cut",
            cut,
            CUT_HANDLES,
            f"{cut} handles and tunnels of the surface were cut and closed",
            "photograph the places where the surface is torn (the report shows them) from more sides",
        ),
        judged(
            "handles_left",
            left,
            LEFT_HANDLES,
            f"handles wider than surface.handle, which were left: {left}",
            "raise surface.handle, or look at the masks: an arm or a strap that touches the head makes one",
        ),
        judged(
            "thin",
            found.thin,
            THIN,
            f"{found.thin:.1%} of the surface belongs to flakes and needles, thinner than two cells of its lattice",
            "look at the masks' borders and photograph hair and collar from more sides",
        ),
        judged(
            "trimmed",
            found.trimmed,
            TRIMMED,
            f"{found.trimmed:.0%} of the surface was seen by no photo and was cut off",
            "photograph the subject from more sides, or set surface.unseen=closed",
        ),
    ]
    if found.must_close:
        out.append(
            judged(
                "closed",
                opened,
                OPEN,
                f"{opened} edges or vertices of the surface are open, crowded or pinched",
                "change surface.resolution a little, fit for longer, or install pymeshlab where it is missing",
            )
        )
    return tuple(out)
