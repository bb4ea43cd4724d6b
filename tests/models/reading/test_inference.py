"""A segmenter on one scene: sizes, positions, captures, row blocks, and pixels without a value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from spectralzoom.models.network.sizes import TOKEN_PX
from spectralzoom.models.network.spectral import LineSpec, with_planes
from spectralzoom.models.reading import inference
from spectralzoom.models.weights.files import Weights, with_record
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import make_weights, noise, plain_weights, read_both, scene_columns

NM = np.linspace(400, 1000, 9)
NONE = np.empty(0, np.int64)
DARK = LineSpec(0.1, 4)


def _values(height: int, width: int, bands: int = len(NM)) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.5, (height, width, bands)).astype(np.float32)


def _seen(height: int = 32, width: int = 48) -> tuple[Weights, inference.CoarsePrediction, np.ndarray]:
    """Return weights, their overview of a scene of noise, and other noise for every patch."""
    weights = make_weights()
    coarse_pass, fine = scene_columns(weights, height, width)
    return weights, inference.read_coarse_prediction(weights, coarse_pass), fine


def test_a_map_without_patches_equals_the_overview():
    """Confidence and classes are those of its probabilities, softened by the weights' temperature."""
    weights, seen, fine = _seen(37, 53)
    expected = seen.probability[:37, :53]
    drawn = inference.segment(weights, seen, fine[:0], NONE, every_class=True)
    assert drawn.confidence == pytest.approx(expected.max(axis=-1), abs=1e-6)
    assert (drawn.classes == expected.argmax(axis=-1)).all()
    assert drawn.log_probability is not None
    assert np.exp(drawn.log_probability) == pytest.approx(expected, abs=1e-6)
    softer = inference.segment(with_record(weights, calibration={"temperature": 2.0}), seen, fine[:0], NONE)
    rooted = np.sqrt(expected)
    assert softer.confidence == pytest.approx((rooted / rooted.sum(axis=-1, keepdims=True)).max(axis=-1), abs=1e-6)
    assert (softer.classes == drawn.classes).all()


def test_a_patch_changes_only_its_own_pixels():
    """All others are the overview's, bit by bit; exchanged patches both change, and their order does not matter."""
    weights, seen, fine = _seen()
    patch_index = np.array([15, 3])
    without, drawn, moved, again = (
        inference.segment(weights, seen, fine[which], numbers).confidence
        for which, numbers in (([], NONE), ([0, 1], patch_index), ([1, 0], patch_index), ([1, 0], patch_index[::-1]))
    )
    for one, other in ((without, drawn), (drawn, moved)):
        assert np.flatnonzero((one != other).reshape(4, 8, 6, 8).any(axis=(1, 3))).tolist() == [3, 15]
    assert again == pytest.approx(drawn, abs=1e-6)


@pytest.mark.parametrize("most", [1, 7])
def test_patches_read_at_a_time_do_not_change_the_map(most: int, monkeypatch: pytest.MonkeyPatch):
    """Classes are the same, and confidence differs by 1e-6 at most."""
    weights, seen, fine = _seen()
    patch_index = np.random.default_rng(1).permutation(24)[:15]
    whole = inference.segment(weights, seen, fine[patch_index], patch_index)
    monkeypatch.setattr(inference, "PATCHES_AT_ONCE", most)
    monkeypatch.setattr(inference, "ROWS_DRAWN", most)
    drawn = inference.segment(weights, seen, fine[patch_index], patch_index)
    assert (drawn.classes == whole.classes).all()
    assert np.abs(drawn.confidence - whole.confidence).max() <= 1e-6


@pytest.mark.parametrize("patch", [8, 32, 64])
@pytest.mark.parametrize("origin", [(0, 0), (8, 40)])
def test_a_region_is_segmented_like_a_training_crop(patch: int, origin: tuple[int, int]):
    """The map is the composite that the training loss uses, at the same places, with both captures.

    Only exposures are stated as fainter.
    """
    weights = make_weights(patch=patch)
    coarse_pass, fine = scene_columns(weights, 64, 128)
    moved = replace(coarse_pass, origin=origin, capture=DARK)
    patch_index = np.array([1, 0])
    other = LineSpec(0.5)
    drawn = inference.segment(weights, moved, fine[patch_index], patch_index, capture=other)
    detail = np.zeros((64, 128, 4), np.float32)
    for (y, x), own in zip(coarse_pass.grid.patch_origin(patch_index), fine[patch_index], strict=True):
        detail[y : y + patch, x : x + patch] = own
    images = (
        torch.from_numpy(with_planes(*one, fainter=inference.FAINTER)).permute(2, 0, 1)[None]
        for one in ((coarse_pass.columns, DARK), (detail, other))
    )
    model = weights.segmenter
    numbers = torch.from_numpy(patch_index)[None]
    with torch.inference_mode():
        places = torch.tensor([origin]).double() * patch / TOKEN_PX
        logits = model.composite(*read_both(model, *images, numbers, places), numbers)
    assert np.abs(drawn.confidence - logits[0].softmax(dim=0).amax(dim=0).numpy()).max() <= 1e-5
    here = inference.segment(weights, replace(moved, origin=(0, 0)), fine[patch_index], patch_index, capture=other)
    assert (drawn.confidence == here.confidence).all() == (origin == (0, 0))


def test_a_prediction_keeps_its_overview(monkeypatch: pytest.MonkeyPatch):
    """Segmenting a prediction does not read the scene again."""
    weights, seen, fine = _seen()
    monkeypatch.setattr(weights.segmenter, "read_overview", lambda *given: pytest.fail("read"))
    inference.segment(weights, seen, fine[:1], np.array([0]))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([0, 24], r"patch 24 is none of the 24 patches of the scene, 0\.\.23"),
        ([-1], "patch -1 is none"),
        ([4, 1, 4], "patch 4 is given more"),
    ],
)
def test_invalid_patches_are_refused_before_reading(numbers: list[int], words: str, monkeypatch: pytest.MonkeyPatch):
    """The error names a patch outside of the scene, or one that is given twice."""
    weights = make_weights()
    coarse_pass, fine = scene_columns(weights, 32, 48)
    monkeypatch.setattr(weights.segmenter, "read_overview", lambda *given: pytest.fail("read"))
    with pytest.raises(ShapeError, match=words):
        inference.segment(weights, coarse_pass, fine[: len(numbers)], np.array(numbers))


@pytest.mark.parametrize("bands", [NM, NM[:3]])
def test_a_pass_in_row_blocks_equals_the_whole(bands: np.ndarray):
    """Rows of the mosaic in several blocks give the very same columns, whether bands reach all of them or not."""
    weights = make_weights()
    grid = SceneGrid(37, 53, 8)
    values = _values(37, 53, len(bands))
    whole = inference.read_coarse_pass(weights, [values], bands, grid)
    assert (inference.read_coarse_pass(weights, np.split(values, [1, 9]), bands, grid).columns == whole.columns).all()
    assert whole.columns[:37, :53] == pytest.approx(weights.columns(values, bands), abs=1e-6)
    added = len(whole.columns) - 37
    assert (whole.columns[37:] == whole.columns[35 : 35 - added : -1]).all()  # the pad is a mirror image


def test_map_of_columns_reads_every_patch():
    """The map equals a segmentation with all patches; a capture of other light gives another map."""
    weights = make_weights()
    coarse_pass, _ = scene_columns(weights, 32, 48)
    every = coarse_pass.grid.every_patch()
    image = inference.coarse_prediction_of_columns(weights, coarse_pass.columns, coarse_pass.grid, DARK)
    drawn, log_probability = inference.map_of_columns(weights, coarse_pass.columns, coarse_pass.grid, DARK)
    own = inference.segment(weights, image, image.patches(every), every)
    assert (drawn.confidence == own.confidence).all()
    assert np.exp(log_probability).max(axis=-1) == pytest.approx(own.confidence, abs=1e-6)
    brighter, _ = inference.map_of_columns(weights, coarse_pass.columns, coarse_pass.grid)
    assert np.abs(brighter.confidence - drawn.confidence).max() > 1e-4


@pytest.mark.parametrize("more", [0, 1])
def test_a_token_dead_in_most_of_its_pixels_is_left_out(more: int):
    """A token with half of its pixels dead is read, with one more it is not; dead pixels take their patch's mean."""
    weights = plain_weights()
    grid = SceneGrid(60, 64, 8)
    values = _values(60, 64)
    whole = inference.read_coarse_pass(weights, [values], NM, grid).columns
    values[:16, :32], values[16, :more], values[41:43, 50:53] = np.nan, np.inf, -np.inf
    seen = inference.read_coarse_pass(weights, [values], NM, grid)
    assert seen.valid_tokens.tolist() == [not more, True, True, True]
    hole = np.zeros((64, 64), bool)
    hole[:16, :32], hole[16, :more], hole[41:43, 50:53] = True, True, True
    assert (seen.columns[~hole] == whole[~hole]).all()
    assert not seen.columns[:16, :32].any()  # every pixel of these patches is dead
    beside = whole[40:48, 48:56][~hole[40:48, 48:56]].mean(axis=0)
    assert seen.columns[41:43, 50:53] == pytest.approx(np.broadcast_to(beside, (2, 3, 4)), abs=1e-5)
    assert (np.isnan(seen.seen_columns).all(axis=-1) == hole).all()
    assert seen.out_of_range is not None
    assert np.count_nonzero(seen.out_of_range) == more + 6  # captured, but no readings


@pytest.mark.parametrize(("dead", "counts"), [(32, True), (33, False), (64, False)])
def test_a_patch_dead_in_most_of_its_pixels_counts_as_not_captured(dead: int, counts: bool):
    """The map is then that without the patch; a patch with half of its pixels dead is read."""
    weights, seen, fine = _seen()
    fine[5].reshape(64, 4)[:dead] = np.nan
    drawn, without = (
        inference.segment(weights, seen, fine[which], np.array(which)).confidence for which in ([4, 5, 6], [4, 6])
    )
    assert np.flatnonzero((drawn != without).reshape(4, 8, 6, 8).any(axis=(1, 3))).tolist() == [5] * counts


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_logits_that_are_not_finite_give_no_class(value: float):
    """The pixel gets class 255 and confidence NaN; all other pixels stay the same."""
    logits = noise(0, 3, 70, 5)
    whole = inference.draw(logits.clone())
    logits[1, 66, 2] = value
    drawn = inference.draw(logits)
    assert (drawn.classes[66, 2], np.isnan(drawn.confidence[66, 2])) == (255, True)
    beside = np.ones((70, 5), bool)
    beside[66, 2] = False
    assert (drawn.classes[beside] == whole.classes[beside]).all()
    assert (drawn.confidence[beside] == whole.confidence[beside]).all()


def test_a_pass_without_dead_pixels_has_no_mask():
    """No token is left out, and no pixel is filled."""
    seen = inference.read_coarse_pass(make_weights(), [_values(30, 31)], NM, SceneGrid(30, 31, 8))
    assert (seen.valid_tokens, seen.filled, seen.out_of_range) == (None, None, None)
    assert seen.seen_columns is seen.columns
    assert inference.CoarsePass(seen.grid, seen.columns).capture == LineSpec()
