"""Single wrong changes to the product, and the tests that must notice each.

    python -m benchmarks.mutations                 # all of them: a table; exit code 1 if one survives
    python -m benchmarks.mutations --only hull     # those whose file or tests have "hull" in their name

Each change is made in a copy of the tree, where its tests then run; nothing here is touched. Before that the tests run
once on the unchanged copy: a test that fails there proves nothing. tests/docs/test_mutations.py keeps the list in step
with the code.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("benchmarks", "docker", "docs", "pipeline", "stages", "tests", "workflows")
LIMIT, PATIENCE = 900.0, 5.0  # seconds, and times all tests' own time: what hangs on a change has noticed it
FAILED = 1  # pytest's exit code where tests failed; 2 to 5 say that they did not run


@dataclass(frozen=True)
class Mutation:
    """A text that stands once in a file, what stands there instead, and the tests (files, or FILE::TEST) that fail."""

    file: str
    before: str
    after: str
    tests: str

    @property
    def change(self) -> str:
        """In one line."""
        return f"{self.file}: {' '.join(self.before.split())} -> {' '.join(self.after.split()) or 'nothing'}"


MUTATIONS = (
    # ---------------------------------------------------------------- equations
    Mutation("pipeline/maths/vmf.py", "-0.5 * l * (l + 1) * inv_kappa", "-0.5 * l * l * inv_kappa",
             "tests/maths/test_vmf.py"),
    Mutation("pipeline/maths/brdf.py", "return 2 * (n * wo)", "return (n * wo)", "tests/maths/test_brdf.py"),
    Mutation("pipeline/maths/sh.py", "v = (-1) ** (l // 2 + 1)", "v = (-1) ** (l // 2)", "tests/maths/test_sh.py"),
    Mutation("pipeline/maths/density.py", "torch.exp(-before) * -torch.expm1(-depth)", "torch.exp(-before) * depth",
             "tests/maths/test_density.py"),
    Mutation("pipeline/fields/paper/material.py", "positional_encoding(u, OCTAVES), angles(wo, n)]",
             "positional_encoding(u, OCTAVES), angles(n, wo)]",
             "tests/fields/test_reflectance.py::test_the_direct_integral_by_hand"),
    Mutation("pipeline/fields/appearance.py", "(c * self(wo, n)).sum(-1)", "(c * self(wo, n)).mean(-1)",
             "tests/fields/test_reflectance.py::test_the_integral_of_a_sum_of_lobes_is_c_times_b"),
    Mutation("pipeline/fields/calibration.py", "+ m - m.mean(0)", "+ m",
             "tests/fields/test_face.py::test_calibration_is_the_identity_plus_what_differs_by_hand"),
    Mutation("stages/inverse_rendering/objective.py", '"nij,nj->ni"', '"nji,nj->ni"',
             "tests/inverse_rendering/test_objective.py::test_calibration_applies_each_views_matrix"),
    Mutation("stages/inverse_rendering/objective.py", "settings.white * losses", "settings.rgb * losses",
             "tests/inverse_rendering/test_objective.py::test_the_objective_is_eq_20_by_hand"),
    Mutation("stages/inverse_rendering/paper/trainer.py", "settings.displacement * moved.mean()",
             "settings.eikonal * moved.mean()",
             "tests/inverse_rendering/paper/test_paper.py::test_the_terms_are_eq_20_by_hand"),
    Mutation("stages/inverse_rendering/ray_sampling.py", "self.at(i, share / share.mean())", "self.at(i)",
             "tests/inverse_rendering/test_fit.py::test_a_ray_stands_for_as_many_as_it_was_drawn_from"),
    Mutation("pipeline/colour.py", "v <= 0.04045, v / 12.92", "v <= 0.04045, v / 12.0", "tests/core/test_colour.py"),
    # ---------------------------------------------------------------- cameras and poses
    Mutation("pipeline/transforms.py", "out[:2, 2] += 0.5", "out[:2, 2] += 0.0", "tests/core/test_transforms.py"),
    Mutation("pipeline/transforms.py", "to_from_world[:3, :3] / scale @", "to_from_world[:3, :3] @",
             "tests/core/test_transforms.py"),
    Mutation("pipeline/transforms.py", "np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])", "np.ones(3)",
             "tests/core/test_transforms.py::test_the_nearest_similarity_is_found_and_never_mirrors"),
    Mutation("stages/poses/normalise.py", "weights = 1.0 / np.maximum(distance,",
             "weights = 1.0 + 0 * np.maximum(distance,", "tests/poses/test_poses_normalise.py"),
    Mutation("stages/poses/scale.py", "<= MET * max(", "<= 100 * MET * max(", "tests/poses/test_poses_scale.py"),
    # ---------------------------------------------------------------- masks and hull
    Mutation("stages/masks/refine_contour.py", "UNIT * (behind - own)", "UNIT * (own - behind)",
             "tests/masks/test_masks_refine_contour.py::test_a_contour_that_is_nearly_right_becomes_right"),
    Mutation("stages/masks/face_labels.py", "(out > 0) & (out != EYES)", "(out > 0)",
             "tests/masks/test_masks_faces.py"),
    Mutation("pipeline/hull.py", "1.2 * np.sqrt(3) / 2 * cell * factor", "0.2 * cell * factor",
             "tests/pipeline/test_hull.py::test_coarse_to_fine_equals_every_voxel_asked"),
    # ---------------------------------------------------------------- UVs and maps
    Mutation("stages/uv/pack.py", "reach = OVERLOOKED + 0.5 * padding * G", "reach = OVERLOOKED",
             "tests/uv/test_uv_build.py::test_packing_keeps_shapes_and_distance"),
    Mutation("stages/uv/pack.py", "[[s, c], [-c, s]]", "[[s, c], [c, -s]]",
             "tests/uv/test_uv_build.py::test_packing_turns_without_mirroring"),
    Mutation("stages/bake/texels.py", "np.where(landed[:, None], gradient, n)", "np.where(landed[:, None], n, n)",
             "tests/bake/test_bake_maps.py::test_normal_map_gives_back_the_gradient"),
    Mutation("pipeline/ray_casting.py", 'found["primID"] >= 0', 'found["primID"] > 0',
             "tests/bake/test_bake_sight.py::test_distances_to_a_mesh_by_hand"),
    # ---------------------------------------------------------------- USD and report
    Mutation("pipeline/maths/latlong.py", "np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)",
             "np.pi * (2 * (np.arange(width) + 0.5) / width - 1)", "tests/usd/test_usd_light.py"),
    Mutation("stages/usd/write/ggx_conversion.py", "REFERENCE_F0 * a + b", "REFERENCE_F0 * a",
             "tests/usd/test_usd_ggx_conversion.py"),
    Mutation("pipeline/lighting/median_cut.py", "np.minimum(image[..., :3], HALF_MAX)",
             "np.minimum(image[..., :3], 1e3)",
             "tests/usd/test_usd_relight.py::test_infinite_suns_are_bounded"),
    Mutation("stages/report/metrics.py", "-10 * float(np.log10(", "-20 * float(np.log10(",
             "tests/report/test_report_metrics.py"),
    # ---------------------------------------------------------------- verdict
    Mutation("pipeline/verdict.py", 'if not np.isfinite(value):\n            return "unusable"',
             'if not np.isfinite(value):\n            return "good"', "tests/pipeline/test_verdict.py"),
    Mutation("pipeline/verdict.py", "return max(levels, key=LEVELS.index", "return min(levels, key=LEVELS.index",
             "tests/pipeline/test_verdict.py"),
    # ---------------------------------------------------------------- store and workflows
    Mutation("pipeline/store.py", "None if sha256_of(path) == ref.sha256 else", "None if True else",
             "tests/core/test_contract.py::test_a_damaged_artifact_is_found_and_made_anew"),
    Mutation("pipeline/contract.py", '"version": stage.version', '"version": 0',
             "tests/core/test_contract.py::test_key_is_the_digest_of_what_it_names"),
    Mutation("workflows/store/gc.py", "elif (stage, key) not in needed:", "else:",
             "tests/workflows/test_store_care.py::test_what_a_published_folder_names_stays_and_the_rest_goes"),
    Mutation("workflows/batch/schedule.py", "if resource.free == 0:", "if resource.free < -1000:",
             "tests/workflows/test_schedule.py"),
    Mutation("workflows/run/budget.py", "stage = left - slower * rung.after", "stage = left",
             "tests/workflows/test_budget.py"),
)  # fmt: skip


def copied(to: Path) -> Path:
    """The tree without its history. With what was compiled, which is used again: times of files are kept."""
    for part in PARTS:
        shutil.copytree(ROOT / part, to / part, symlinks=True)
    for file in ROOT.iterdir():
        if file.is_file() and file.name != ".git":
            shutil.copy2(file, to)
    return to


def outcome(tree: Path, tests: list[str], limit: float | None = None) -> tuple[int | None, str]:
    """pytest's exit code (None: it did not end) and the last line that says something."""
    # no bytecode is written: a file that is changed twice within a second would else be run as it was
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    try:
        ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return None, f"not over after {limit:.0f} s"
    lines = [x for x in ended.stdout.splitlines() if x.strip()]
    said = next((x for x in lines if x.startswith("FAILED")), lines[-1] if lines else ended.stderr[-200:])
    return ended.returncode, said


def fate(tree: Path, mutation: Mutation, limit: float = LIMIT) -> tuple[str, str]:
    """killed, survived or unclear, and why."""
    path = tree / mutation.file
    text, kept = path.read_text(), path.stat()
    if text.count(mutation.before) != 1:
        return "unclear", f"the text stands there {text.count(mutation.before)} times"
    path.write_text(text.replace(mutation.before, mutation.after))
    try:
        code, said = outcome(tree, [mutation.tests], limit)
    finally:
        path.write_text(text)
        os.utime(path, ns=(kept.st_atime_ns, kept.st_mtime_ns))
    if code in (None, FAILED):
        return "killed", said
    return ("survived" if code == 0 else "unclear"), said


def main(arguments: list[str]) -> int:
    """Run them, print a line each; 1 if one is not killed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", default="", help="text in the name of the file or of the tests")
    only = parser.parse_args(arguments).only
    chosen = [m for m in MUTATIONS if only in m.file or only in m.tests]
    with tempfile.TemporaryDirectory(prefix="mutations") as folder:
        tree = copied(Path(folder) / "tree")
        begun = time.monotonic()
        code, said = outcome(tree, sorted({m.tests for m in chosen}))
        limit = max(LIMIT, PATIENCE * (time.monotonic() - begun))
        if code != 0:
            print(f"the tests fail without any change: {said}")
            return 2
        fates = []
        for m in chosen:
            begun = time.monotonic()
            what, said = fate(tree, m, limit)
            fates.append(what)
            print(f"{what:9} {time.monotonic() - begun:4.0f} s  {m.change}\n{'':17}{said}", flush=True)
    print(f"{fates.count('killed')} of {len(fates)} killed")
    return 0 if set(fates) <= {"killed"} else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
