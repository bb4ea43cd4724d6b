"""The stage that chooses the simulated effects, and the record of its choice."""

from __future__ import annotations

from pathlib import Path

import pytest

from spectralzoom.flows.cli.simulate_command import open_simulation, scan
from spectralzoom.flows.opening.open_field import make_source
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages import effects as effect_choice
from spectralzoom.flows.stages.effects import chosen_effects, load_manifest
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.storage.store import Archive, Ref

ASKED = "rotation,vignetting,shot,read-noise"


@pytest.fixture(scope="module")
def settings(scene_files: Path) -> Settings:
    """Return settings of a simulation of the small picture, by a camera that is as wide as it."""
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "effects": ASKED, "camera.samples": 160}
    return load_settings(None, given)


@pytest.fixture(scope="module")
def decided(settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Ref:
    """Return the store of the choice for a scan of two lines."""
    stores = Stores(Archive.open(tmp_path_factory.mktemp("decided")))
    return scan(stores, settings, open_simulation(settings)[0], [Sweep("s", "fine", "x", 0.0, 0.0, 2)])[0]


def test_manifest_and_source_have_the_chosen_effects(decided: Ref, settings: Settings) -> None:
    """The manifest lists every effect in order, with its bound; the source gets variants and clock."""
    manifest = load_manifest(decided)
    rows = {row["name"]: row for row in manifest["effects"]}
    assert list(rows) == [effect.name for effect in EFFECTS]
    on = {name: row["variant"] for name, row in rows.items() if row["state"] == "on"}
    assert on.keys() == {*ASKED.split(","), "quantisation", "saturation"}
    assert rows["diffraction"]["bound"] > 0
    assert (manifest["total"]["asked"], manifest["total"]["tolerance"]) == (ASKED, 0.1)
    source = make_source(open_simulation(settings)[0], settings).with_effects(chosen_effects(decided), {"a": 3.0})
    assert {effect.name: variant for effect, variant in source.active.items()} == on
    assert source.clock == {"a": 3.0}
    assert list(chosen_effects(decided)) == list(source.active)


def test_effects_unknown_to_this_version_are_refused(monkeypatch: pytest.MonkeyPatch, decided: Ref) -> None:
    """The message names the effect."""
    row = {"name": "glare", "state": "on", "variant": "exact"}
    monkeypatch.setattr(effect_choice, "load_manifest", lambda effects: {"effects": [row]})
    with pytest.raises(IncompleteStoreError, match="the effect glare, exact, which this version does not know"):
        chosen_effects(decided)
