"""A stage's code does not change without its version: what an archive holds would otherwise pass for the new result.

After a change, either raise the stage's number in ``flows.stages.VERSIONS`` (that of ingest in its command) or, where
the change has no effect on what the stage writes, keep it; then record the code as it is:

    python tests/flows/test_stage_versions.py
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path

import pytest

from flows import ingest_command, stages

VERSIONS = {**stages.VERSIONS, ingest_command.STAGE: ingest_command.VERSION}

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("stage_digests.json")
GEOMETRY = ("pipeline/camera.py", "pipeline/mirror.py", "pipeline/scan.py", "pipeline/coverage.py", "pipeline/grid.py",
            "pipeline/vector_memory.py")  # fmt: skip
RECTIFY = (*GEOMETRY, "pipeline/rectify")
READ = ("models/spectral.py", "models/sizes.py", "models/tokens.py", "models/encoder.py", "models/patches.py",
        "models/segmenter.py", "models/inference.py", "models/regions.py", "models/weights.py", "pipeline/grid.py",
        "flows/region_work.py", "storage/mosaic_strips.py")  # fmt: skip
PLANNING = ("pipeline/planning.py", "pipeline/runs.py", "pipeline/covering.py", "pipeline/spending.py",
            "pipeline/strips.py")  # fmt: skip
GATHER = ("pipeline/rectify/resample.py", "pipeline/rectify/kernels.py", "pipeline/rectify/line_table.py",
          "pipeline/rectify/alignment.py")  # fmt: skip
READERS = ("storage/scan_files.py", "storage/envi_header.py", "storage/envi_cubes.py", "storage/headwall_folders.py",
           "storage/frame_index_files.py", "storage/zarr_scenes.py", "storage/raster_files.py", "storage/rasters.py",
           "storage/tiff_files.py", "storage/array_files.py", "storage/mat_files.py", "storage/dataset_layouts.py",
           "storage/wavelengths.py", "storage/scene_toml.py", "pipeline/rig/frame_index.py")  # fmt: skip
SIMULATOR = ("pipeline/simulator",)
SOURCES = {
    "effects": (*GEOMETRY, *GATHER, *SIMULATOR, "flows/effect_choice.py"),
    "capture": (*GEOMETRY, *GATHER, *SIMULATOR, "storage/cubes.py"),
    "register": (*RECTIFY, "storage/sightings.py", "flows/pointing_stage.py"),
    "locate": (*RECTIFY, "storage/sightings.py", "storage/lookups.py"),
    "rectify": (*RECTIFY, "storage/sightings.py", "storage/mosaics.py", "storage/mosaic_work.py",
                "storage/tile_work.py"),
    "attend": (*READ, *PLANNING, "flows/field_work.py", "flows/second_round.py", "models/second_look.py",
               "models/policies.py", "models/saliency.py", "models/spacing.py", "models/vgg.py",
               "models/vgg_saliency.py", "storage/attention.py"),
    "patches": (*RECTIFY, "pipeline/strips.py", "storage/sightings.py", "storage/patches.py"),
    "segment": (*READ, "flows/field_work.py", "storage/class_maps.py"),
    "turned": (*PLANNING, "pipeline/orientation.py", "pipeline/crop_rows.py", "storage/mosaic_strips.py",
               "storage/attention.py", "flows/orientation_stage.py"),
    "ground": ("pipeline/ground.py", "pipeline/ground_grid.py", "pipeline/projection.py", *GATHER,
               "storage/georeference.py", "storage/ground_maps.py", "flows/ground_stage.py", "flows/panels.py",
               "flows/tones.py"),
    "evaluate": (*READ, *RECTIFY, *PLANNING, "models/controls.py", "models/metrics.py", "models/policies.py",
                 "pipeline/savings.py", "pipeline/selection.py", "flows/evaluation.py", "flows/full_look.py"),
    "ingest": (*READERS, "storage/cube_sources.py", "storage/ingested_cubes.py"),
}  # fmt: skip
STAGES_FILE, PLACEMENT = "flows/stages.py", "flows/placement.py"
FUNCTIONS: dict[str, dict[str, tuple[str, ...]]] = {  # of files that several stages share
    "effects": {},
    "capture": {
        STAGES_FILE: ("capture_coarse", "capture_fine", "capture_again", "capture_sweeps", "_capture_sweep"),
        "flows/effect_choice.py": ("chosen_effects", "source_with"),
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
    "ingest": {"flows/ingest_command.py": ("hash_files", "_opened", "_key")},
}


def digest_of(stage: str) -> str:
    """Hash of the stage's code without comments, docstrings and layout."""
    digest = hashlib.sha256()
    for name in SOURCES[stage]:
        path = ROOT / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
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
