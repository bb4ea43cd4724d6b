"""The command for the paper's tables: pooling and choice of patches, costs of rows, and a run on a toy data set."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from spectralzoom.models.network.sizes import multiply_adds
from spectralzoom.models.network.spectral import LineSpec, patches_of
from spectralzoom.models.policies.policies import PIXEL_SCORES, score_multiply_adds, score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, segment
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import select_patches
from spectralzoom.pipeline.simulator.scenes.scene import raster_from_values
from tests.conftest import CLASSES, patchy_scene, random_weights

BENCHMARKS = Path(__file__).parent / "benchmarks"
BANDS_NM = (450.0, 550.0, 650.0, 850.0)
SCENE_TOML = """
bands = [0, 1, 2]
wavelengths_nm = [450.0, 550.0, 650.0]
labels = "labels/{number}.png"
[classes]
soil = 0
crop = 1
"""


@pytest.fixture
def paper(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the module of the command."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("bench_paper")


def test_one_sharp_edge_wins_by_maximum_and_fine_texture_by_mean(paper: ModuleType) -> None:
    """The paper pools edges by maximum, the project by mean; they choose different patches of the same image."""
    grid, image = SceneGrid(16, 16, 8), np.zeros((16, 16, 1), np.float32)
    image[4, 4] = 5.0  # one bright pixel in patch 0
    image[8:, 8:] = np.indices((8, 8)).sum(axis=0)[..., None] // 2 % 2  # texture in all of patch 3
    seen = CoarsePrediction(grid, image, np.full((16, 16, 2), 0.5, np.float32))
    by_maximum = paper.patch_maxima(PIXEL_SCORES["sobel"].of(seen), grid)
    assert by_maximum[0] == pytest.approx(10.0)
    assert select_patches(by_maximum, 1).tolist() == [0]
    assert select_patches(score_patches("sobel", seen), 1).tolist() == [3]


def test_rows_have_the_counts_and_multiply_adds_of_their_patches(paper: ModuleType) -> None:
    """Counts equal those of `segment`, each ideal patch removes its errors, and multiply-adds equal the closed form."""
    values, labels = patchy_scene((64, 64), len(BANDS_NM), 0)
    scene = raster_from_values(
        values, paper.CAMERA, name="a", wavelength_nm=np.array(BANDS_NM), labels=labels, class_names=CLASSES
    )
    weights = random_weights(BANDS_NM)
    config = weights.config
    grid = SceneGrid(64, 64, config.patch)
    columns = np.random.default_rng(0).standard_normal((64, 64, config.columns)).astype(np.float32)
    read, chosen = paper.read_scene(weights, columns, labels, grid, 2), np.array([1, 6, 10])
    fine = patches_of(columns, grid.patch)[chosen]
    drawn = segment(weights, read.seen, fine, chosen, capture=LineSpec()).classes
    assert (read.counts(chosen) == paper.confusion(labels, drawn, config.classes)).all()
    wrong = [n.sum() - np.trace(n) for n in (read.counts(chosen[:0]), read.counts(chosen))]
    assert wrong[0] - wrong[1] == read.scores("ideal", "mean", 0)[chosen].sum()

    found = paper.judge(paper.DataSet("toy", weights, {"a": lambda: scene}), (4,), lambda text: None)
    patches = (64 // config.patch) ** 2
    for factor in (4, 2):
        row = found[factor, "ED, maximum", "4"]
        assert row.patches == [patches // factor**2 + 4]
        score, bands = score_multiply_adds("sobel", config, grid), len(BANDS_NM)
        again = 4 * config.patch**2 * bands * config.columns  # columns of patches that are captured apart
        assert row.multiply_adds == [multiply_adds(config, grid, 4, bands, score=score).total + again]
    fine_row = found[1, "random", "all"]
    assert fine_row.patches == [patches]
    assert fine_row.multiply_adds == [multiply_adds(config, grid, patches, len(BANDS_NM)).total]


def test_the_command_trains_and_evaluates_on_a_folder(
    paper: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames have 64 x 64 px; the claim has a row for each of three image sizes."""
    data, rng = tmp_path / "toy", np.random.default_rng(0)
    for name in ("images", "labels"):
        (data / name).mkdir(parents=True)
    (data / "scene.toml").write_text(SCENE_TOML)
    for number in range(3):
        labels = np.kron(rng.integers(0, 2, (8, 8)), np.ones((8, 8), int)).astype(np.uint8)
        values = 60 + 120 * labels[..., None] + rng.integers(0, 20, (64, 64, 3))
        Image.fromarray(values.astype(np.uint8)).save(data / "images" / f"00{number}.png")
        Image.fromarray(labels).save(data / "labels" / f"00{number}.png")
    arguments = ["--data", str(data), "--steps", "2", "--patch", "8", "--patches", "4,16"]
    checked, printed = paper.rows(arguments), capsys.readouterr().out
    assert [row.what.rpartition(" ")[2] for row in checked] == ["256", "512", "1024"]
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    for start in ("Baseline 256", "Baseline 1024", "ED, maximum 4", "ED, mean 16", "TA (here gain) 4", "ideal* 16"):
        assert any(line.startswith(start) for line in lines), start
