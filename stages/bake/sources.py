"""Where base colour, F0 and roughness come from photos, and where they are assumed: the map `measured`.

At the mesh's vertices, each in [0, 1]:

    base colour  1 - share that was replaced by its region's colour (unseen.py); 0 where no photo sees the place
    F0           share of the photos in the mean F0 of the place's material (standard_fit.drawn, at_least), 0 where the
                 layer is a prior's; 0 where fewer than MIN_VIEWS photos see the place, which follows its neighbours
    roughness    share of the photos in the precision of the material's roughness, likewise

Without fitted standard shaders F0 and roughness are those of NeuFace's lobe: 1 where a photo sees the place. Under a
light stage all three are 1 where a camera saw the texel (texels.py). Fitted eyes have the cornea's F0 and roughness,
which are assumed.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F32
from stages.bake.standard_fit import Fitted


def sources(unseen: F32, replaced: F32, standard: Fitted | None) -> F32:
    """(V, 3) base colour, F0, roughness. unseen, replaced (V,): see texels.Known."""
    seen = 1 - unseen
    base = seen * (1 - replaced)
    layer = np.stack([seen, seen], 1) if standard is None else standard.measured * seen[:, None]
    return np.concatenate([base[:, None], layer], 1).clip(0, 1).astype(np.float32)
