"""Mixtures fitted to few labels: folds, stored classifiers, and odd scenes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.models.network.mixture import Part
from spectralzoom.models.network.sizes import AROUND, RELATIVE, VALUES, SegmenterConfig
from spectralzoom.models.network.spectral import LineSpec, SpectralBasis, project
from spectralzoom.models.reading.inference import map_of_columns
from spectralzoom.models.training.examples import Example, measured_normalisation, normalised, untaught_classes
from spectralzoom.models.training.mixture import (
    BLOCK_PX,
    CANDIDATES,
    FOLDS,
    Candidate,
    Fit,
    Mixed,
    fit_mixture,
    folds_of,
    pixel_weights,
)
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid

KINDS = {one.name: one for one in CANDIDATES}
Labels = NDArray[np.uint8]
SEEDS = st.integers(0, 2**16)


@pytest.mark.parametrize("candidate", CANDIDATES, ids=KINDS)
@pytest.mark.parametrize("known", [(0, 1), (1, 3), (0, 2, 4), tuple(range(12))], ids=str)
def test_stored_classifiers_equal_those_of_scikit_learn(candidate: Candidate, known: tuple[int, ...]) -> None:
    """The standardisation is in the first layer; a class that was not taught has no probability."""
    rng = np.random.default_rng(len(known))
    labels = rng.permutation(np.resize(known, 120)).astype(np.uint8)
    features = (rng.normal(0, 1, (120, 6)) + 0.4 * labels[:, None] + 3) * np.geomspace(0.01, 100, 6)
    fit = Fit.of(candidate, features, labels)
    part = Part(6, candidate.hidden, 12)
    fit.store(part, 12)
    with torch.inference_mode():
        found = part(torch.from_numpy(features.astype(np.float32))).softmax(dim=-1).numpy()
    expected = fit.predict(features, 12)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(
        expected[:, known], fit.fitted.predict_proba((features - features.mean(axis=0)) / features.std(axis=0))
    )
    assert not found[:, np.setdiff1d(range(12), known)].any()


def _blocks(seed: int, shape: tuple[int, int], side: int, classes: int) -> Labels:
    """Return random classes in blocks, a third of them unlabelled."""
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, classes, shape).astype(np.uint8)
    cells[rng.random(shape) < 1 / 3] = UNLABELLED
    return np.kron(cells, np.ones((side, side), np.uint8))


@given(seed=SEEDS, side=st.integers(1, 9), classes=st.integers(2, 5))
def test_patches_of_a_single_scene_stay_in_one_fold(seed: int, side: int, classes: int) -> None:
    """Only patches of more than four usual ones are cut; a class with four patches is in every fold."""
    labels = _blocks(seed, (9, 12), side, classes)
    (fold,) = folds_of([labels], np.random.default_rng(seed))
    sizes, counts = [], {}
    for one in range(classes):
        own, counts[one] = scipy.ndimage.label(labels == one)
        sizes.append((own, np.bincount(own.ravel())))
    usual = np.median(np.concatenate([size[1:] for _, size in sizes])) if any(counts.values()) else 0
    most = 4 * int(np.clip(np.sqrt(usual), *BLOCK_PX)) ** 2
    for own, size in sizes:
        for number in np.flatnonzero(size <= most):
            assert number == 0 or len(np.unique(fold[own == number])) == 1
    for one, count in counts.items():
        assert count < FOLDS or len(np.unique(fold[labels == one])) == FOLDS
    assert ((fold >= 0) & (fold < FOLDS)).all()


@pytest.mark.parametrize("scenes", [4, 5, 13])
def test_whole_scenes_are_folds(scenes: int) -> None:
    """No scene is divided, and no fold has two scenes more than another."""
    folds = folds_of([_blocks(one, (2, 3), 4, 3) for one in range(scenes)], np.random.default_rng(0))
    numbers = [int(one.flat[0]) for one in folds]
    assert all((one == number).all() for one, number in zip(folds, numbers, strict=True))
    assert np.ptp(np.bincount(numbers, minlength=FOLDS)) <= 1


def _scenes(count: int, classes: int, bands: int = 4, size: int = 24) -> list[tuple[NDArray[np.float64], Labels]]:
    """Return scenes of values (y, x, band) and classes in blocks of 4 px, of distinct spectra."""
    rng = np.random.default_rng(7)
    spectra = np.random.default_rng(3).random((classes, bands)) + 0.2
    found = []
    for _ in range(count):
        cells = rng.permutation(np.resize(np.arange(classes), (size // 4) ** 2)).reshape(size // 4, -1)
        labels = np.kron(cells, np.ones((4, 4))).astype(np.uint8)
        found.append((spectra[labels] + rng.normal(0, 0.01, (size, size, bands)), labels))
    return found


def _nm(bands: int) -> NDArray[np.float64]:
    return np.linspace(400, 800, bands)


def _fitted(scenes: list[tuple[NDArray[np.float64], Labels]], classes: int) -> tuple[Mixed, Weights]:
    """Fit as training does; return the mixture, and weights of it."""
    bands = scenes[0][0].shape[-1]
    basis = SpectralBasis(400, 800, bands)
    matrix, reached = basis.matrix(_nm(bands))
    observed = [Example("e", project(value, matrix), label, label.shape) for value, label in scenes]
    normalisation = measured_normalisation(observed)
    examples = [normalised(one, normalisation, reached) for one in observed]
    config = SegmenterConfig(classes, bands, patch=8, untaught=untaught_classes(examples, classes))
    mixed = fit_mixture(examples, normalisation, config, 0, lambda what, done, figure: None)
    names, colours = tuple(map(str, range(classes))), np.zeros((classes, 3), np.uint8)
    return mixed, Weights(mixed.segmenter, basis, normalisation, names, colours)


def _few(labels: Labels, count: int) -> Labels:
    """Return some labelled pixels of each class."""
    found = np.full_like(labels, UNLABELLED)
    for one in np.unique(labels):
        places = np.random.default_rng(one).permutation(np.flatnonzero(labels == one))[:count]
        found.flat[places] = one
    return found


def _only(labels: Labels, one: int) -> Labels:
    """Return the labels of one class."""
    return np.where(labels == one, labels, np.uint8(UNLABELLED))


def _edit(change: Callable[[NDArray[np.float64], Labels], None], count: int = 1, classes: int = 3) -> list:
    scenes = _scenes(count, classes)
    change(*scenes[0])
    return scenes


def _one_pixel(values: NDArray[np.float64], labels: Labels) -> None:
    labels[labels == 2] = UNLABELLED
    labels[5, 5] = 2


ODD: dict[str, tuple[Callable[[], list], int, float]] = {  # scenes, classes, least accuracy on the first one
    "a class a scene": (lambda: [(v, _only(y, n % 3)) for n, (v, y) in enumerate(_scenes(4, 3))], 3, 0.99),
    "one pixel of a class": (lambda: _edit(_one_pixel), 3, 0.6),
    "two classes": (lambda: _scenes(1, 2), 2, 0.99),
    "three pixels each of 16": (lambda: [(v, _few(y, 3)) for v, y in _scenes(1, 16, 8)], 16, 0.9),
    "a constant band": (lambda: _edit(lambda v, y: v[..., 1].fill(5)), 3, 0.95),
    "a band of zeros": (lambda: _edit(lambda v, y: v[..., 1].fill(0)), 3, 0.95),
    "duplicate bands": (lambda: _edit(lambda v, y: v.__setitem__((..., 2), v[..., 1])), 3, 0.9),
    "one scene of equal pixels": (lambda: _edit(lambda v, y: v.fill(1), 4), 3, 0.0),
    "all pixels equal": (lambda: _edit(lambda v, y: v.fill(1)), 3, 0.0),
    "one band": (lambda: _scenes(2, 2, 1), 2, 0.9),
    "an untaught class": (lambda: _scenes(2, 3), 4, 0.99),
    "values of 1e8": (lambda: [(1e8 * v, y) for v, y in _scenes(2, 3)], 3, 0.99),
    "values of 1e-8": (lambda: [(1e-8 * v, y) for v, y in _scenes(2, 3)], 3, 0.99),
    "negative values": (lambda: [(v - 5, y) for v, y in _scenes(2, 3)], 3, 0.99),
}


@pytest.mark.parametrize("case", ODD)
def test_odd_scenes_give_maps_of_taught_classes(case: str) -> None:
    """Probabilities are numbers that sum to 1, and separate classes are told apart."""
    make, classes, least = ODD[case]
    scenes = make()
    mixed, weights = _fitted(scenes, classes)
    assert abs(sum(one.weight for one in mixed.judged) - 1) < 1e-9
    assert mixed.segmenter.config.parts[mixed.plain][0] == VALUES
    values, labels = scenes[0]
    columns = weights.columns(values, _nm(values.shape[-1]))
    drawn, every = map_of_columns(weights, columns, SceneGrid(*labels.shape, 8), LineSpec())
    chance = np.exp(every.astype(np.float64))
    np.testing.assert_allclose(chance.sum(axis=-1), 1, atol=1e-4)
    assert not chance[..., mixed.segmenter.config.untaught].any()
    known = (labels != UNLABELLED) & np.isfinite(values).all(axis=-1)
    assert (drawn.classes == labels)[known].mean() >= least


def test_as_few_pixels_as_classes_are_refused() -> None:
    """A classifier needs more."""
    values, labels = _scenes(1, 3)[0]
    with pytest.raises(SceneError, match="3 labelled pixels of 3 classes are too few"):
        _fitted([(values, _few(labels, 1))], 3)


@given(counts=st.lists(st.integers(1, 400), min_size=1, max_size=6), seed=SEEDS)
def test_a_class_counts_by_the_root_of_its_pixels(counts: list[int], seed: int) -> None:
    """The weights of a class sum in proportion to the root of its count; equal counts change nothing."""
    labels = np.random.default_rng(seed).permutation(np.repeat(2 * np.arange(len(counts)), counts)).astype(np.uint8)
    weights = pixel_weights(labels)
    assert weights.mean() == pytest.approx(1)
    shares = np.bincount(labels, weights)[::2] / len(labels)
    np.testing.assert_allclose(shares, np.sqrt(counts) / np.sqrt(counts).sum())


@pytest.mark.parametrize("name", [one for one in KINDS if "LR" in one])
def test_a_class_of_four_pixels_is_found(name: str) -> None:
    """Weights by roots find most of a class of four pixels beside one of 400; equal pixels lose most of it."""
    rng = np.random.default_rng(5)
    labels, truth = np.repeat(np.uint8([0, 1]), [400, 4]), np.repeat(np.uint8([0, 1]), 1000)
    features, seen = (rng.normal(0, 1, (len(one), 4)) + 1.3 * one[:, None] for one in (labels, truth))
    right = Fit.of(KINDS[name], features, labels).predict(seen, 2).argmax(axis=1) == truth
    plain = KINDS[name].make().fit(features, labels).predict(seen) == truth
    assert plain[truth == 1].mean() < 0.5 < right[truth == 1].mean()
    assert right[truth == 0].mean() > 0.9


def test_textures_are_told_by_their_surroundings() -> None:
    """Textures of equal mean spectra differ in their spread alone."""
    rng = np.random.default_rng(0)
    labels = np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.ones((16, 16))).astype(np.uint8)
    values = 1 + rng.normal(0, 1, (64, 64, 2)) * np.where(labels, 0.3, 0.03)[..., None]
    mixed, _ = _fitted([(values, labels)], 2)
    used = {kind for kind, _, weight in mixed.segmenter.config.parts if weight}
    assert AROUND in used
    scores = {one.name: one.miou for one in mixed.judged}
    assert scores["mixture"] > 0.85 > 0.6 > scores[f"{RELATIVE}, LDA"]
