"""A stage's code does not change without its version: what an archive holds would otherwise pass for the new result.

After a change, either raise the stage's number in ``flows.stages.VERSIONS`` or, where the change has no effect on what
the stage writes, keep it; then record the code as it is:  python tests/flows/test_stage_versions.py
"""

from __future__ import annotations

import ast
import hashlib
import json
from pathlib import Path

import pytest

from flows.stages import VERSIONS

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("stage_digests.json")
GEOMETRY = ("pipeline/camera.py", "pipeline/mirror.py", "pipeline/scan.py", "pipeline/coverage.py", "pipeline/grid.py")
RECTIFY = (*GEOMETRY, "pipeline/rectify")
READ = ("models/spectral.py", "models/tokens.py", "models/encoder.py", "models/patches.py", "models/segmenter.py",
        "models/inference.py", "models/weights.py", "pipeline/grid.py")  # fmt: skip
SOURCES = {
    "capture": (*GEOMETRY, "pipeline/simulator", "pipeline/rectify/resample.py", "storage/cubes.py"),
    "rectify": (*RECTIFY, "storage/mosaics.py"),
    "attend": (*READ, "models/policies.py", "pipeline/planning.py", "pipeline/runs.py", "storage/attention.py"),
    "patches": (*RECTIFY, "pipeline/planning.py", "storage/patches.py"),
    "segment": (*READ, "storage/class_maps.py"),
    "evaluate": (*READ, *RECTIFY, "models/controls.py", "models/metrics.py", "models/policies.py",
                 "pipeline/planning.py", "pipeline/savings.py", "pipeline/selection.py",
                 "flows/evaluation.py", "flows/full_look.py"),
}  # fmt: skip
STAGES_FILE = ROOT / "flows" / "stages.py"
FUNCTIONS = {  # of flows/stages.py
    "capture": ("_capture", "_capture_sweep"),
    "rectify": ("rectify", "_preview"),
    "attend": ("glance_at", "attend"),
    "patches": ("load_plan", "captured", "cut_patches", "_along_scan"),
    "segment": ("glance_at", "patch_columns", "draw_map"),
    "evaluate": ("glance_at", "patch_columns"),
}


def digest_of(stage: str) -> str:
    """Hash of the stage's code without comments, docstrings and layout."""
    digest = hashlib.sha256()
    for name in SOURCES[stage]:
        path = ROOT / name
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(ast.dump(_bare_code(file)).encode())
    functions = {node.name: node for node in _bare_code(STAGES_FILE).body if isinstance(node, ast.FunctionDef)}
    for name in FUNCTIONS[stage]:
        digest.update(ast.dump(functions[name]).encode())
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
