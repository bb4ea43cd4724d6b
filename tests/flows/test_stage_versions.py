# ruff: noqa: E501
"""A stage's code does not change without its version: what an archive holds would otherwise pass for the new result.

After a change, either raise the stage's number in ``flows.survey.stages.VERSIONS`` (that of ingest in its command) or,
where the change has no effect on what the stage writes, keep it; then record the code as it is:

    python tests/flows/test_stage_versions.py
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path

import pytest

from flows.archive import ingest_command
from flows.survey import stages

VERSIONS = {**stages.VERSIONS, ingest_command.STAGE: ingest_command.VERSION}

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("stage_digests.json")
GEOMETRY = ("pipeline/geometry/camera.py", "pipeline/geometry/mirror.py", "pipeline/geometry/scan.py", "pipeline/planning/coverage.py", "pipeline/geometry/grid.py",
            "pipeline/geometry/vector_memory.py")  # fmt: skip
RECTIFY = (*GEOMETRY, "pipeline/rectify")
READ = ("models/network/spectral.py", "models/network/sizes.py", "models/network/tokens.py", "models/network/encoder.py", "models/network/pixel_side.py",
        "models/network/segmenter.py", "models/reading/inference.py", "models/reading/regions.py", "models/weights/files.py", "pipeline/geometry/grid.py",
        "flows/survey/region_work.py", "storage/arrays/mosaic_strips.py")  # fmt: skip
PLANNING = ("pipeline/planning/fine_pass.py", "pipeline/planning/scan_runs.py", "pipeline/planning/line_cover.py", "pipeline/planning/budget_search.py",
            "pipeline/planning/strips.py")  # fmt: skip
GATHER = ("pipeline/rectify/resample.py", "pipeline/rectify/kernels.py", "pipeline/rectify/line_table.py",
          "pipeline/rectify/registration/alignment.py")  # fmt: skip
READERS = ("storage/scan_files.py", "storage/envi_header.py", "storage/envi_cubes.py", "storage/headwall_folders.py",
           "storage/frame_index_files.py", "storage/zarr_scenes.py", "storage/raster_files.py", "storage/rasters.py",
           "storage/tiff_files.py", "storage/array_files.py", "storage/mat_files.py", "storage/dataset_layouts.py",
           "storage/wavelengths.py", "storage/scene_toml.py", "pipeline/rig/frame_index.py")  # fmt: skip
SIMULATOR = ("pipeline/simulator", "pipeline/simulator/effects")
SOURCES = {
    "effects": (*GEOMETRY, *GATHER, *SIMULATOR, "flows/survey/effect_choice.py"),
    "capture": (*GEOMETRY, *GATHER, *SIMULATOR, "storage/arrays/cubes.py"),
    "register": (*RECTIFY, "storage/arrays/located_sweeps.py", "flows/survey/pointing.py"),
    "locate": (*RECTIFY, "storage/arrays/located_sweeps.py", "storage/arrays/lookups.py"),
    "rectify": (*RECTIFY, "storage/arrays/located_sweeps.py", "storage/arrays/mosaics.py", "storage/arrays/mosaic_work.py",
                "storage/arrays/tile_work.py"),
    "attend": (*READ, *PLANNING, "flows/survey/field_work.py", "flows/survey/second_round.py", "models/second_look.py",
               "models/policies/policies.py", "models/policies/saliency.py", "models/policies/spacing.py", "models/network/vgg.py",
               "models/policies/vgg_saliency.py", "storage/arrays/attention.py"),
    "patches": (*RECTIFY, "pipeline/planning/strips.py", "storage/arrays/located_sweeps.py", "storage/arrays/patches.py"),
    "segment": (*READ, "flows/survey/field_work.py", "storage/arrays/class_maps.py"),
    "turned": (*PLANNING, "pipeline/planning/orientation.py", "pipeline/planning/crop_rows.py", "storage/arrays/mosaic_strips.py",
               "storage/arrays/attention.py", "flows/survey/orientation.py"),
    "ground": ("pipeline/ground/view.py", "pipeline/ground/map_grid.py", "pipeline/ground/projection.py", *GATHER,
               "storage/arrays/georeference.py", "storage/arrays/ground_maps.py", "flows/survey/ground.py", "flows/publish/panels.py",
               "flows/publish/colour_stretch.py"),
    "evaluate": (*READ, *RECTIFY, *PLANNING, "models/policies/free_seats.py", "models/evaluation/metrics.py", "models/policies/policies.py",
                 "pipeline/planning/savings.py", "pipeline/planning/selection.py", "flows/survey/accuracy.py",
                 "flows/survey/full_look.py"),
    "ingest": (*READERS, "storage/cube_sources.py", "storage/ingested_cubes.py"),
}  # fmt: skip
STAGES_FILE, PLACEMENT = "flows/survey/stages.py", "flows/survey/placement.py"
FUNCTIONS: dict[str, dict[str, tuple[str, ...]]] = {  # of files that several stages share
    "effects": {},
    "capture": {
        STAGES_FILE: ("capture_coarse", "capture_fine", "capture_again", "capture_sweeps", "_capture_sweep"),
        "flows/survey/effect_choice.py": ("chosen_effects", "source_with"),
    },
    "register": {PLACEMENT: ("sighted",), STAGES_FILE: ("captured",)},
    "locate": {PLACEMENT: ("sighted", "locate"), STAGES_FILE: ("captured",)},
    "rectify": {PLACEMENT: ("rectify", "_record")},
    "attend": {STAGES_FILE: ("attend", "_scores", "write_plan", "load_plan")},
    "patches": {
        PLACEMENT: ("sighted", "cut_patches", "cut_again", "_fill", "_Kept", "_along_scan", "seen_shares"),
        STAGES_FILE: ("load_plan", "captured"),
    },
    "segment": {STAGES_FILE: ("draw_map",)},
    "turned": {STAGES_FILE: ("load_plan",)},
    "ground": {},
    "evaluate": {STAGES_FILE: ("glance_at", "patch_columns")},
    "ingest": {"flows/archive/ingest_command.py": ("hash_files", "_opened", "_key")},
}


def digest_of(stage: str) -> str:
    """Hash of the stage's code without comments, docstrings and layout."""
    digest = hashlib.sha256()
    for name in SOURCES[stage]:
        path = ROOT / name
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(ast.dump(_bare_code(file)).encode())
    for shared, names in FUNCTIONS[stage].items():
        nodes = [node for node in _bare_code(ROOT / shared).body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        found = {node.name: node for node in nodes}
        for name in names:
            digest.update(ast.dump(found[name]).encode())
    return digest.hexdigest()[:20]


def _bare_code(file: Path) -> ast.Module:
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        match getattr(node, "body", None):
            case [ast.Expr(value=ast.Constant()), *_] as body:
                body[0] = ast.Pass()
    return tree


def test_every_stage_is_watched() -> None:
    """A stage with a version has its code listed here."""
    assert set(SOURCES) == set(FUNCTIONS) == set(VERSIONS)


@pytest.mark.parametrize("stage", sorted(VERSIONS))
def test_code_changed_means_version_raised(stage: str) -> None:
    """The code behind each stage is the code that its version was recorded for."""
    recorded = json.loads(RECORD.read_text())[stage]
    now = {"version": VERSIONS[stage], "digest": digest_of(stage)}
    assert now == recorded, f"raise VERSIONS[{stage!r}] or keep it, then run: python tests/flows/{Path(__file__).name}"


if __name__ == "__main__":
    RECORD.write_text(
        json.dumps({s: {"version": VERSIONS[s], "digest": digest_of(s)} for s in sorted(VERSIONS)}, indent=1) + "\n"
    )
