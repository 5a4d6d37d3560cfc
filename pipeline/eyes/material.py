"""The surface of an eye for standard shaders: the wet cornea over sclera and iris."""

from __future__ import annotations

IOR = 1.376  # of the cornea (Gullstrand's schematic eye)
F0 = ((IOR - 1) / (IOR + 1)) ** 2  # 0.025
ROUGHNESS = 0.1  # a film of tears: nearly a mirror; less, and small lamps alias in a picture
