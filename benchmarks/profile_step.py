"""Where the time of a training step goes: python benchmarks/profile_step.py [STEPS]

The draft's settings on the ball of `neuface bench speed`. Times are of functions themselves, without what they call; a
backward pass runs inside torch's engine and counts as `run_backward`, except for the project's own backward kernels.
"""

from __future__ import annotations

import cProfile
import pstats
import sys

import pipeline.threads  # noqa: F401  (before torch)
from stages.inverse_rendering.config import Config
from workflows.run.calibration_scene import WHOLE, ball_trainer
from workflows.run.host_info import describe, machine

SHOWN = 16


def main(steps: int) -> None:
    """Print the table."""
    settings = Config(**WHOLE)
    trainer = ball_trainer(24, 256, settings.grid_cells, settings, "cpu")
    for _ in range(3):
        trainer.advance()
    profile = cProfile.Profile()
    profile.enable()
    for _ in range(steps):
        trainer.advance()
    profile.disable()
    rows = pstats.Stats(profile).get_stats_profile()
    ordered = sorted(rows.func_profiles.items(), key=lambda item: -item[1].tottime)
    total = rows.total_tt
    print(f"{describe(machine())}; {steps} steps of {settings.batch} rays, {1e3 * total / steps:.1f} ms each")
    for name, row in ordered[:SHOWN]:
        print(f"{row.tottime / total:6.1%}  {1e3 * row.tottime / steps:7.2f} ms  {name}  ({row.file_name})")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
