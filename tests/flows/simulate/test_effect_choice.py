"""The stage that chooses the simulated effects, and the record of its choice."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from spectralzoom.flows.cli.simulate_command import open_simulation, scan
from spectralzoom.flows.field import make_source
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.survey_settings import Settings
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages import effects as effect_choice
from spectralzoom.flows.stages.effects import chosen_effects, load_manifest
from spectralzoom.flows.tasks.scene import SimulatedField
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.scenes.scene import SceneRaster
from spectralzoom.storage.store import Archive, Ref

Decided = tuple[Path, Ref]  # an archive, and the decision in it
ASKED = "rotation,vignetting,shot,read-noise"
CAMERA = {"camera.samples": 160}  # as wide as the small picture: every further sample takes time


def settings_of(scene_files: Path, **flags: Any) -> Settings:
    """Return settings of a simulation of the small picture."""
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "effects": ASKED}
    return load_settings(None, given | CAMERA | flags)


def choose(out: Path, settings: Settings, *, dry: bool = False) -> Ref:
    """Return the store of the choice for a scan of two lines; in a dry run its address."""
    scene, _ = open_simulation(settings)
    sweeps = [Sweep("s", "fine", "x", 0.0, 0.0, 2)]
    return scan(Stores(Archive.open(out), dry=dry), settings, scene, sweeps)[0]


@pytest.fixture(scope="module")
def decided(scene_files: Path, tmp_path_factory: pytest.TempPathFactory) -> Decided:
    """Return an archive with the stage's store, and that store."""
    out = tmp_path_factory.mktemp("decided")
    return out, choose(out, settings_of(scene_files))


def test_manifest_and_source_have_the_chosen_effects(decided: Decided, scene_files: Path) -> None:
    """The manifest lists every effect in order, with its bound; the source gets variants and clock."""
    manifest = load_manifest(decided[1])
    rows = {row["name"]: row for row in manifest["effects"]}
    assert list(rows) == [effect.name for effect in EFFECTS]
    on = {name for name, row in rows.items() if row["state"] == "on"}
    assert on == {*ASKED.split(","), "quantisation", "saturation"}
    assert rows["diffraction"]["bound"] > 0
    assert (manifest["total"]["asked"], manifest["total"]["tolerance"]) == (ASKED, 0.1)
    settings = settings_of(scene_files)
    source = (
        SimulatedField(make_source(open_simulation(settings)[0], settings))
        .lit(chosen_effects(decided[1]), {"a": 3.0})
        .source
    )
    on = {row["name"]: row["variant"] for row in load_manifest(decided[1])["effects"] if row["state"] == "on"}
    assert {effect.name: variant for effect, variant in source.choice.effects} == on
    assert source.clock == {"a": 3.0}
    assert list(chosen_effects(decided[1])) == [effect for effect, _ in source.choice.effects]


def test_a_stored_choice_reads_no_scene(scene_files: Path, decided: Decided, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no probe, and no pixel of the scene is read."""
    refuse = Mock(side_effect=AssertionError("the scene was looked at"))
    monkeypatch.setattr(SceneRaster, "thinned", refuse)
    monkeypatch.setattr(effect_choice, "probe_survey", refuse)
    assert choose(decided[0], settings_of(scene_files, budget="0.9", policy="random")) == decided[1]


@pytest.mark.parametrize(
    "flags",
    [
        {"tol": "0.2"},
        {"tol": "0.1dn"},
        {"effects": "auto"},
        {"camera.exposure_ms": "50"},
        {"optics.smile_nm": 0.5},
        {"sky.started": "2026-06-01T12:00:00Z"},
    ],
    ids=str,
)
def test_the_key_follows_the_inputs_of_the_choice(scene_files: Path, decided: Decided, flags: dict[str, Any]) -> None:
    """Inputs are the tolerance with its unit, the requested effects, camera, optics and sky."""
    same, other = (choose(decided[0], settings_of(scene_files, **given), dry=True) for given in ({}, flags))
    assert same == decided[1] != other


def test_effects_unknown_to_this_version_are_refused(monkeypatch: pytest.MonkeyPatch, decided: Decided) -> None:
    """The message names the effect."""
    row = {"name": "glare", "state": "on", "variant": "exact"}
    monkeypatch.setattr(effect_choice, "load_manifest", lambda effects: {"effects": [row]})
    with pytest.raises(IncompleteStoreError, match="the effect glare, exact, which this version does not know"):
        chosen_effects(decided[1])
