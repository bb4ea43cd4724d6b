"""Surveys in which the full network reads the patches of sufficient expected gain, and the overview the rest."""

from __future__ import annotations

import io
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

from spectralzoom.flows.archive.estimates import likely_changed
from spectralzoom.flows.archive.plan_command import plan_content, show_plan
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.terminal.figures import format_count
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.weights.files import BY_LAW, CASCADE, save_weights
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES as FARM_CLASSES
from tests.conftest import RGB_NM, Flags, Survey, random_weights
from tests.prior_work import without_effects

RASTER: dict[str, Any] = {"budget": None, "source": "raster"}
TABLE = CascadeTable((0.02, 0.05, 0.15, 0.2), (0.0, 0.001, 0.003, 0.2), (0.9, 0.8, 0.4, 0.1))

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return tiny weights with a table of the loss when a part is read."""
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    tiny = random_weights(RGB_NM)
    save_weights(replace(tiny, record={**tiny.record, CASCADE: asdict(TABLE)}), path)
    return path


@pytest.fixture(scope="module")
def cascade(judged: Path, survey_png: Survey, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return archive and receipt of a survey with these weights and no flag; do not change it."""
    out = tmp_path_factory.mktemp("cascade")
    with without_effects():
        return out, survey_png(out, **RASTER, weights=str(judged)).receipt


def _open(out: Path, receipt: Any, name: str) -> xr.Dataset:
    return xr.open_zarr(out / receipt["products"][name], consolidated=False)


def test_the_allowed_loss_sets_the_smallest_gain(cascade: tuple[Path, Any]) -> None:
    """Without a flag 0.3 points are allowed: patches of 0.15 and more are read in order of gain, and no others."""
    out, receipt = cascade
    attention = _open(out, receipt, "attention")
    gain, rank = attention["score"].values.ravel(), attention["rank"].values.ravel()
    assert receipt["kept"]["asked"] == {"macs": None, "least_gain": pytest.approx(0.15), "expected_loss": 0.3}
    np.testing.assert_array_equal(rank >= 0, gain >= 0.15)
    assert 0 < receipt["kept"]["patches"] == np.count_nonzero(rank >= 0) < receipt["kept"]["of_patches"]
    assert (np.diff(gain[np.argsort(rank)][rank.size - np.count_nonzero(rank >= 0) :]) <= 0).all()


def test_read_patches_equal_a_full_reading(cascade: tuple[Path, Any], survey_png: Survey, tmp_path: Path) -> None:
    """The other patches come from the overview, and some differ."""
    out, receipt = cascade
    everything = survey_png(tmp_path, **RASTER, weights=receipt["settings"]["weights"], expected_loss="0").receipt
    assert "kept" not in everything
    maps = (_open(out, receipt, "class_map"), _open(tmp_path, everything, "class_map"))
    ours, whole = (one["classes"].values for one in maps)
    patches = _open(out, receipt, "attention")["rank"].values >= 0
    read = patches.repeat(8, 0).repeat(8, 1)[: ours.shape[0], : ours.shape[1]]
    np.testing.assert_array_equal(ours[read], whole[read])
    assert (ours[~read] != whole[~read]).any()


@pytest.mark.parametrize(
    ("flags", "least"),
    [
        ({"expected_loss": "0.1"}, 0.05),
        ({"expected_loss": "0"}, None),
        ({"expected_loss": "50"}, 0.2),
        ({"macs": "90%"}, None),
    ],
)
def test_flags_override_the_allowed_loss(
    judged: Path, flags_png: Flags, tmp_path: Path, flags: dict[str, str], least: float | None
) -> None:
    """An expected loss sets another smallest gain; a loss of 0 and multiply-adds set none."""
    content = plan_content(load_settings(None, flags_png(tmp_path, weights=str(judged), scan_step="1", **flags)))
    asked = content.get("kept", {"asked": {"least_gain": None}})["asked"]
    assert asked["least_gain"] == (least if least is None else pytest.approx(least))


def test_a_plan_estimates_the_patches_to_read(judged: Path, flags_png: Flags, tmp_path: Path) -> None:
    """It uses the fraction that scenes kept from training had, 0.4."""
    content = plan_content(load_settings(None, flags_png(tmp_path, weights=str(judged), scan_step="1")))
    kept = content["kept"]
    assert kept["patches"] == round(0.4 * kept["of_patches"])
    assert content["estimate"]["multiply_adds"]["range"] is None  # these weights do not know it


@pytest.mark.parametrize(("scene", "usual"), [("farm", 0.3), ("trial", 0.1), ("trial@1", 0.1), ("scouting", 0.4)])
def test_a_plan_knows_what_scenes_of_a_law_needed(tmp_path: Path, scene: str, usual: float) -> None:
    """A law has its own patches, with their range; another law has those of all scenes."""
    laws = {
        law: {name: [one] * 4 for name, one in zip(("fraction", "fewest", "most"), ends, strict=True)}
        for law, ends in {"farm@2": (0.3, 0.2, 0.5), "trial@1": (0.1, 0.05, 0.15)}.items()
    }
    every = replace(TABLE, fewest=(0.05,) * 4, most=(0.5,) * 4)
    tiny = random_weights(RGB_NM, FARM_CLASSES)
    path = tmp_path / "weights.safetensors"
    save_weights(replace(tiny, record={**tiny.record, CASCADE: {**asdict(every), BY_LAW: laws}}), path)
    asked = {"scene": scene, "size": "160x128", "weights": str(path), "scan_step": "1", "out": str(tmp_path / "a")}
    content = plan_content(load_settings(None, asked))
    assert content["kept"]["patches"] == round(usual * content["kept"]["of_patches"])
    work = content["estimate"]["multiply_adds"]
    assert work["range"][0] < work["value"] < work["range"][1]
    show_plan(content, Console(file=(shown := io.StringIO()), width=160))
    assert f"({format_count(work['range'][0])} to {format_count(work['range'][1])})" in shown.getvalue()


@pytest.mark.parametrize(
    ("flags", "known"),
    [({}, True), ({"name": "other"}, False), ({"seed": 5}, False), ({"expected_loss": "0.1"}, False)],
)
def test_a_plan_knows_what_the_field_itself_needed(
    cascade: tuple[Path, Any], judged: Path, flags_png: Flags, flags: dict[str, Any], known: bool
) -> None:
    """The patches of an earlier run count if it was of the same field, by the same least gain."""
    out, receipt = cascade
    work = plan_content(load_settings(None, flags_png(out, **{**RASTER, "weights": str(judged), **flags})))
    work = work["estimate"]["multiply_adds"]
    assert (Path(receipt["products"]["report.html"]).parent.name in work["known_from"]) == known
    assert (work["value"] == receipt["savings"]["multiply_adds"]["done"]) == known


def test_a_planned_second_pass_reads_again_what_its_time_shows(tmp_path: Path) -> None:
    """More time shows more patches; the overview of the others is read once. All lines show all of them."""
    again = []
    for budget in ("0.4", "0.5", "1"):
        asked = {"scene": "farm", "size": "640x512", "budget": budget, "zoom": "always", "out": str(tmp_path)}
        plan = plan_survey(open_field(load_settings(None, asked), planning=True))
        again.append(len(likely_changed(plan)))
    assert 0 < again[0] < again[1] < again[2] == len(plan.field.grid.every_patch())
