"""The checks of a reflectance field."""

from __future__ import annotations

from pipeline.verdict import Finding, Limits, judged

# dB over left-out lights: a scanned head with 72 lights has 26 in a draft; blending of pictures 19
LEFT_OUT = Limits(24.0, 16.0)
# dB above blending the three nearest pictures: below 0 the pictures themselves are the better asset
AGAINST_BLEND = Limits(1.0, -3.0)
# millimetres between rest and any tracking picture: beyond, the face itself has moved as well
MOTION = Limits(3.0, 20.0, lower=False)
# share of the map's texels that cameras see: eight cameras around a head see .75
SEEN = Limits(0.5, 0.2)


def judge(figures: dict[str, float]) -> tuple[Finding, ...]:
    """All findings, from the stage's figures; those of left-out lights only if there are any."""
    out = []
    if "left_out_psnr" in figures:
        psnr, more = figures["left_out_psnr"], figures["left_out_psnr"] - figures["blend_psnr"]
        out += [
            judged("left_out_lights", psnr, LEFT_OUT, f"lights that were left out of the fit are predicted to "
                   f"{psnr:.1f} dB", "look at masks and surface; use more lights, and a head that keeps still",
                   unit="dB"),
            judged("against_blend", more, AGAINST_BLEND, f"that is {more:.1f} dB better than blending the pictures of "
                   "the three nearest lights", "look at the surface: shadows fall where it is wrong", unit="dB"),
        ]  # fmt: skip
    moved, seen = figures["motion_mm"], figures["seen"]
    out += [
        judged("head_motion", moved, MOTION, f"the head moved by up to {moved:.1f} mm during the sequence",
               "use a headrest, and a shorter sequence", unit="mm"),
        judged("texels_seen", seen, SEEN, f"cameras see {seen:.0%} of the surface; the rest is continued from there",
               "use more cameras"),
    ]  # fmt: skip
    return tuple(out)
