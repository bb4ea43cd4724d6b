"""Effects: what the stage that decides on them keeps, and a scan beside everything on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.settings.load import load_settings
from flows.simulate import effect_comparison
from flows.simulate.command import open_simulation
from flows.simulate.effect_comparison import Comparison, View, compare_with_everything, everything
from flows.simulate.effect_picture import Words, draw_comparison
from flows.tasks.run import CaptureRun
from flows.tasks.stages import effects as effect_choice
from flows.tasks.stages.effects import choose_effects, chosen_effects, load_manifest, source_with
from pipeline.errors import BoundError, IncompleteStoreError
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.registry import BY_NAME, EFFECTS
from pipeline.simulator.scenes.scene import SceneRaster
from storage.archive.keys import StageRef

ASKED = "rotation,vignetting,shot,read-noise"
CAMERA = {"camera.samples": 160}  # as wide as the small picture: all of what else it sees takes its time


@pytest.fixture(scope="module")
def scan(scene_files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[CaptureRun, list[Sweep], StageRef]:
    """A coarse scan of the small picture, decided and not taken."""
    out = tmp_path_factory.mktemp("compared")
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "out": str(out), "effects": ASKED, **CAMERA}
    run, sweeps, _ = open_simulation(load_settings(None, given), coarse=True)
    return run, sweeps, choose(run)


@pytest.fixture(scope="module")
def found(scan: tuple[CaptureRun, list[Sweep], StageRef]) -> Comparison:
    """That scan beside everything on."""
    said: list[str] = []
    return compare_with_everything(*scan, said.append)


def width_of(path: Path) -> int:
    """Of a picture [px]."""
    with Image.open(path) as picture:
        return picture.width


def made_up(measured: float = 0.02, tolerance: float | None = 0.1) -> Comparison:
    """Figures and a view of noise."""
    rng = np.random.default_rng(0)
    lines, samples = range(40, 200), range(100, 260)
    image = rng.uniform(0.1, 0.6, (160, 160, 3)).astype(np.float32)
    change = rng.uniform(-measured, measured, (160, 160))
    sweep = Sweep("full-0", "fine", "x", 0.0, 0.0, 1000)
    return Comparison(
        lines=1000,
        of_lines=2000,
        exact_cpu_s=21.0,
        cpu_s=7.0,
        effects_exact=19,
        effects_on=18,
        unit="sigma",
        tolerance=tolerance,
        bound=tolerance,
        measured=measured,
        rms=measured / 2,
        place=effect_comparison.ViewPlace("full-0", 120, 180, 7),
        raw_unequal=0.05,
        raw_most_dn=1,
        left_out=("polarisation",),
        cheaper=("slit as 1x1",),
        view=View(image, image, change, "true colour, 640 / 550 / 460 nm", lines, samples, sweep),
    )


def test_figures_are_beside_all_that_the_rig_has(
    scan: tuple[CaptureRun, list[Sweep], StageRef], found: Comparison
) -> None:
    """What was not asked for is there exactly; all lines are compared and the greatest change keeps its bound."""
    names = {effect.name: variant for effect, variant in everything(scan[2]).items()}
    assert {"rotation", "slit", "smear", "diffraction", "shot", "quantisation"} <= set(names)
    assert {"wind", "cloud", "defects"}.isdisjoint(names)
    assert all(variant == BY_NAME[name].variants[0] for name, variant in names.items())
    assert found.lines == found.of_lines
    assert found.bound is not None
    assert 0 < found.rms < found.measured <= found.bound
    assert np.abs(found.view.change).max() == pytest.approx(found.measured)
    assert found.place.line in found.view.lines
    assert found.place.sample in found.view.samples
    assert found.effects_exact > found.effects_on == 6
    assert "slit" in found.left_out
    record = json.loads(json.dumps(found.record(), allow_nan=False))
    assert record["ratio"] == pytest.approx(found.exact_cpu_s / found.cpu_s)
    assert record["place"]["sweep"] == "coarse-0"


def test_what_is_exact_differs_by_nothing(scene_files: Path, tmp_path: Path) -> None:
    """Neither in light nor in raw numbers."""
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "out": str(tmp_path), "effects": "all", **CAMERA}
    run, sweeps, _ = open_simulation(load_settings(None, given), coarse=True)
    same = compare_with_everything(run, sweeps, choose(run), lambda words: None)
    assert (same.measured, same.raw_unequal, same.raw_most_dn) == (0, 0, 0)
    assert (same.left_out, same.cheaper) == ((), ())


def test_a_scan_is_compared_in_part_and_a_broken_bound_has_its_place(
    scan: tuple[CaptureRun, list[Sweep], StageRef], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks evenly out of all, which is said; a bound that does not hold is told where."""
    said: list[str] = []
    monkeypatch.setattr(effect_comparison, "MOST_S", 1e-9)
    monkeypatch.setattr(effect_comparison, "BLOCK_LINES", 4)
    part = compare_with_everything(*scan, said.append)
    assert part.lines == 4 < part.of_lines
    assert said[0].startswith(f"4 of {part.of_lines} lines are taken both ways: ")
    assert "all would take about" in said[0]
    monkeypatch.undo()

    def believing(effects: StageRef) -> dict[str, Any]:
        manifest = load_manifest(effects)
        return manifest | {"total": manifest["total"] | {"bound": 1e-6}}

    monkeypatch.setattr(effect_comparison, "load_manifest", believing)
    with pytest.raises(BoundError, match=r"sweep coarse-0, line \d+, sample \d+, band \d, above the bound of 1e-06"):
        compare_with_everything(*scan, lambda words: None)


@pytest.mark.parametrize("found", [made_up(), made_up(3.0, None), made_up(0.0, 0.0)], ids=["usual", "any", "exact"])
def test_the_picture_is_as_wide_as_a_page_and_light(found: Comparison, tmp_path: Path) -> None:
    """1600 px and less than 300 kB, also where nothing differs and where anything may."""
    path = tmp_path / "made.png"
    draw_comparison(path, found, Words("farm, seed 0", "auto"))
    assert width_of(path) == 1600
    assert path.stat().st_size < 300_000


def test_views_of_small_scenes_are_flat_or_narrow(tmp_path: Path) -> None:
    """A few lines, and a single band in grey."""
    usual = made_up()
    for lines, samples in ((range(3), range(160)), (range(160), range(20, 28))):
        shape = (len(lines), len(samples))
        grey = np.full((*shape, 3), 0.3, np.float32)
        view = replace(usual.view, exact=grey, chosen=grey, change=np.zeros(shape), lines=lines, samples=samples)
        draw_comparison(tmp_path / "x.png", replace(usual, view=replace(view, bands="grey, 650 nm")), Words("x", "all"))
        assert width_of(tmp_path / "x.png") == 1600


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("made.jpg", 2, "--compare writes a PNG"),
        ("folder.png", 2, "is a folder; name a file in it, such as"),
        ("file/made.png", 1, "choose another --compare"),
    ],
)
def test_pictures_that_cannot_be_written_are_refused_first(
    command_line: Any, scene_files: Path, tmp_path: Path, name: str, code: int, message: str
) -> None:
    """One message, before anything is simulated."""
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    scene, out = scene_files / "scene.png", tmp_path / "none"
    command_line("simulate", scene, "-o", out, "--compare", tmp_path / name).refused(code, message)
    assert not out.exists()


def test_the_command_writes_the_picture_and_tells_its_figures(
    command_line: Any, scene_files: Path, tmp_path: Path
) -> None:
    """In words and in the record."""
    picture = tmp_path / "new" / "made.png"
    scene = scene_files / "scene.png"
    settings = tmp_path / "camera.toml"
    settings.write_text(f"[camera]\nsamples = {CAMERA['camera.samples']}\n")
    words = ["simulate", scene, "--settings", settings, "-o", tmp_path / "scan", "--coarse", "--effects", ASKED]
    ended = command_line(*words, "--compare", picture, "--json")
    record = json.loads(ended.out)["comparison"]
    assert record["picture"] == str(picture)
    assert width_of(picture) == 1600
    assert "Everything on, exact, takes" in " ".join(ended.err.split())


def choose(run: CaptureRun) -> StageRef:
    """The stage's store, made in the run's archive."""
    return choose_effects.produce(run.archive, choose_effects.wants(run))[0]


def key_of(run: CaptureRun) -> str:
    """The key that the stage asks for, without making anything."""
    return choose_effects.key(choose_effects.wants(run))


def opened(scene_files: Path, out: Path, **flags: Any) -> CaptureRun:
    """A simulation of the small picture."""
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "out": str(out), "effects": ASKED}
    return open_simulation(load_settings(None, given | CAMERA | flags))[0]


@pytest.fixture(scope="module")
def decided(scene_files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StageRef]:
    """An archive with a decision, and its store."""
    out = tmp_path_factory.mktemp("decided")
    return out, choose(opened(scene_files, out))


def test_the_manifest_and_the_source_have_what_was_decided(decided: tuple[Path, StageRef], scene_files: Path) -> None:
    """Every effect in the chain's order, those left out within their bounds; the source has variants and clock."""
    manifest = load_manifest(decided[1])
    rows = {row["name"]: row for row in manifest["effects"]}
    assert list(rows) == [effect.name for effect in EFFECTS]
    assert {name for name, row in rows.items() if row["state"] == "on"} == {
        *ASKED.split(","),
        "quantisation",
        "saturation",
    }
    assert rows["diffraction"]["bound"] >= rows["diffraction"]["measured"] > 0
    assert (manifest["total"]["asked"], manifest["total"]["tolerance"]) == (ASKED, 0.1)
    source = source_with(opened(scene_files, decided[0]).simulated, decided[1], {"a": 3.0})
    on = {row["name"]: row["variant"] for row in load_manifest(decided[1])["effects"] if row["state"] == "on"}
    assert {effect.name: variant for effect, variant in source.choice.effects} == on
    assert (source.clock, list(chosen_effects(decided[1]))) == (
        {"a": 3.0},
        [effect for effect, _ in source.choice.effects],
    )


def test_a_decision_that_is_there_draws_nothing(
    scene_files: Path, decided: tuple[Path, StageRef], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither probe nor chips; not one point of the scene is asked for."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the scene was looked at")

    run = opened(scene_files, decided[0], budget="0.9", policy="random")
    monkeypatch.setattr(SceneRaster, "thinned", refuse)
    monkeypatch.setattr(effect_choice, "probe_survey", refuse)
    assert choose(run) == decided[1]


@pytest.mark.parametrize(
    "flags",
    [
        {"tol": "0.2"},
        {"tol": "0.1dn"},
        {"effects": "auto"},
        {"seed": "1"},
        {"camera.exposure_ms": "50"},
        {"optics.smile_nm": 0.5},
        {"sky.started": "2026-06-01T12:00:00Z"},
    ],
    ids=str,
)
def test_what_the_decision_depends_on_is_its_key(
    scene_files: Path, decided: tuple[Path, StageRef], flags: dict[str, Any]
) -> None:
    """Tolerance with its unit, what was asked, seed, camera and rig."""
    assert key_of(opened(scene_files, decided[0])) == decided[1].key
    assert key_of(opened(scene_files, decided[0], **flags)) != decided[1].key


def test_broken_bounds_and_unknown_effects_are_refused(
    scene_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decided: tuple[Path, StageRef]
) -> None:
    """What cannot be trusted is not kept; an effect that this version does not know is named."""

    def broken(*_: object) -> None:
        raise BoundError("smile: what was left out changes light by 3")

    monkeypatch.setattr(effect_choice, "_verified", broken)
    with pytest.raises(BoundError, match="smile"):
        choose(opened(scene_files, tmp_path))
    assert not list((tmp_path / "stages").glob("effects/*"))
    row = {"name": "glare", "state": "on", "variant": "exact"}
    monkeypatch.setattr(effect_choice, "load_manifest", lambda effects: {"effects": [row]})
    with pytest.raises(IncompleteStoreError, match="the effect glare, exact, which this version does not know"):
        chosen_effects(decided[1])
