"""Check that a stage's code changes with its version alone; else an archive would pass off old stores as new results.

After a change, raise the version of the stage's product, beside the stage.
If the change has no effect on the output of the stage, keep the version. Then record the current code:

    python tests/flows/tasks/test_stage_versions.py
"""

from __future__ import annotations

import gc
import inspect
import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT)] if __name__ == "__main__" else []

from flows.settings.survey_settings import Settings  # noqa: E402
from flows.tasks.open_survey import STAGES, versions  # noqa: E402
from flows.tasks.run import SurveyRun  # noqa: E402
from storage.archive.keys import StageRef  # noqa: E402
from tests.flows.tasks.stage_closure import Sources, Target, read_packages  # noqa: E402

VERSIONS = versions()
RECORD = Path(__file__).with_name("stage_digests.json")
# sources of the lines: runs bring them, no stage names them
LIGHT = ("farm_scene", "scouting_scene", "raster_from_values", "make_source")
BESIDES = {"effects": LIGHT, "capture": (*LIGHT, "_open_source"), "evaluate": ("judged_labels",)}
ROOTS: dict[str, tuple[str, ...]] = {}
for _one in STAGES.values():
    _function = f"{_one.wants.__module__}.{_one.wants.__name__}"
    ROOTS[_one.product.name] = (*ROOTS.get(_one.product.name, BESIDES.get(_one.product.name, ())), _function)
OF_RUNS = ("LineCamera", "SceneGrid", "AngularGrid", "CapturePlan")  # roots of every stage that gets a run
BARRIERS = {
    "Product": "the numbers that this test compares with",
    "Settings": "values, which stand in the keys; what acts on them is reached where it does",
    "Archive": "where stores are kept, and under which key; not what is in them",
    "StageRef": "where a store lies",
    "WorkerPool": "who does the work: blocks are the same by threads, by processes and on a cluster",
    "run_blocks": "as WorkerPool",
    "free_tiles": "gives memory back",
    "read_manifest": "whether a store is whole",
    "visible": "words of refusals",
}


@cache
def sources() -> Sources:
    """Return the current code."""
    return Sources(read_packages(ROOT))


@pytest.fixture(scope="module", autouse=True)
def _code_is_no_garbage() -> Iterator[None]:
    """Keep the collector off the half million nodes of the code, and drop them before the next tests."""
    gc.disable()
    yield
    sources.cache_clear()
    gc.enable()


def digest_of(stage: str, code: Sources) -> str:
    """Return a hash of all code that the stage reaches."""
    return code.digest(closure_of(stage, code))


def closure_of(stage: str, code: Sources) -> set[Target]:
    """Return every definition that affects the output of the stage."""
    return code.closure([*ROOTS[stage], *OF_RUNS], BARRIERS)


def record() -> dict[str, dict[str, int | str]]:
    """Return version and digest of every stage for the current code."""
    return {stage: {"version": VERSIONS[stage], "digest": digest_of(stage, sources())} for stage in sorted(VERSIONS)}


def test_an_edited_constant_changes_the_stages_that_reach_it() -> None:
    """MOST_INVALID, for the filling of invalid pixels, changes the stages that run the model and no others."""
    assert set(ROOTS) == set(VERSIONS)
    module, name = sources().named("MOST_INVALID")
    texts = read_packages(ROOT)
    edited = re.sub(rf"^{name} = ", f"{name} = 0.5 * ", texts[module], flags=re.M)
    assert edited != texts[module]
    changed = sources().edited(module, edited)
    concerned = {stage for stage in ROOTS if digest_of(stage, changed) != digest_of(stage, sources())}
    assert concerned == {"score", "segment", "evaluate"}


@pytest.mark.parametrize("stage", sorted(VERSIONS))
def test_stage_code_matches_its_recorded_version(stage: str) -> None:
    """Changed code needs a raised version or a new record."""
    recorded = json.loads(RECORD.read_text())[stage]
    now = {"version": VERSIONS[stage], "digest": digest_of(stage, sources())}
    assert now == recorded, (
        f"raise the version of the product of {stage} or keep it, then run: python {Path(__file__).relative_to(ROOT)}"
    )


def test_every_barrier_is_reached() -> None:
    """Barriers that no stage reaches must be removed."""
    named = {to for stage in ROOTS for target in closure_of(stage, sources()) for to in sources().names(target)}
    assert {sources().named(barrier) for barrier in BARRIERS} <= named


@pytest.mark.parametrize(
    ("stage", "names"),
    {
        "score": ("PixelScore", "Encoder", "fill_invalid", "SceneGrid"),
        "segment": ("Encoder", "fill_invalid", "MOST_INVALID", "Segmenter", "write_class_tile"),
        "capture": ("RigSource", "CaptureRunner", "open_mirror", "HeadwallCamera", "lines_by_time", "EFFECTS"),
        "condense": ("find_components", "find_rare", "calibrate", "SignalCubeWriter"),
        "rectify": ("mosaic_tile", "LineCache", "MosaicWriter"),
    }.items(),
)
def test_indirectly_called_code_belongs_to_a_stage(stage: str, names: tuple[str, ...]) -> None:
    """The inside of the model and the drivers of the rig are examples."""
    assert {sources().named(name) for name in names} <= closure_of(stage, sources())


def test_comments_and_docstrings_change_no_digest() -> None:
    """Other docstrings and a new comment leave the digest of segment as it was."""
    module, _ = sources().named("Segmenter")
    text = read_packages(ROOT)[module]
    reworded = sources().edited(module, "# A comment.\n" + re.sub(r'"""\w+ ', '"""Hand over ', text))
    assert digest_of("segment", reworded) == digest_of("segment", sources())


@pytest.mark.parametrize("absent", [("condense_raster", "rectify"), ("rectify", "rectify_fine")])
def test_store_names_in_receipts_are_unique(absent: tuple[str, ...]) -> None:
    """The exception is the mosaic of the first pass and that of both passes, so each case leaves out one of them."""
    ran = [one for name, one in STAGES.items() if name not in absent]
    named = [one.addresses(StageRef(one.product.name, "abc", Path())) for one in ran]
    assert all(named)
    assert len({name for one in named for name in one}) == sum(map(len, named))


@pytest.mark.parametrize("name", STAGES)
def test_a_survey_has_the_arguments_of_its_stages(name: str) -> None:
    """Each keyword argument of a stage is an attribute of a run or a setting."""
    run, settings = ({*dir(kind), *kind.__dataclass_fields__} for kind in (SurveyRun, Settings))
    assert {*inspect.getfullargspec(inspect.unwrap(STAGES[name].wants)).kwonlyargs} <= run | settings


if __name__ == "__main__":
    RECORD.write_text(json.dumps(record(), indent=1) + "\n")
