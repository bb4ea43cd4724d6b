"""Distances of a scene from the spectra of a training."""

from __future__ import annotations

import json
from functools import reduce
from operator import add

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.models.evaluation.unlike_scenes import STRIDE, UNLIKE, TrainingSpectra

COLUMNS = 12
Floats = NDArray[np.floating]


def scene(seed: int, side: int = 96) -> Floats:
    """Return normalised columns (y, x, column) of fields of four covers under a light of its own."""
    rng = np.random.default_rng([7, seed])
    covers = np.random.default_rng(1).normal(0, 1, (4, COLUMNS))
    kinds = rng.integers(0, 4, (6, 6)).repeat(16, axis=0).repeat(16, axis=1)[:side, :side]
    return np.asarray((covers[kinds] + rng.normal(0, 0.1, (side, side, COLUMNS))) * rng.normal(1, 0.05))


def trained(scenes: int) -> TrainingSpectra:
    """Measure a training on some scenes."""
    found = TrainingSpectra.measured([scene(seed) for seed in range(scenes)], np.eye(COLUMNS))
    assert found is not None
    return found


def distance(known: TrainingSpectra, seen: Floats) -> float:
    """Return the larger distance of a scene."""
    return max(known.distances(known.of(seen[::STRIDE, ::STRIDE])))


@pytest.mark.parametrize("scenes", [1, 3, 12])
def test_scenes_of_the_same_kind_are_like_the_training(scenes: int) -> None:
    """Fields of the same covers, whether one scene is trained or twelve."""
    assert max(distance(trained(scenes), scene(seed)) for seed in range(100, 110)) < UNLIKE


@pytest.mark.parametrize("shift", ["haze", "gain", "one cover"])
def test_other_spectra_are_unlike_the_training(shift: str) -> None:
    """A spectrum is added, spectra are three times as bright, or the covers are others."""
    seen = scene(100)
    changed = {"haze": seen + 1.5, "gain": 3 * seen, "one cover": np.roll(seen, 5, axis=-1) * 2}[shift]
    assert distance(trained(12), changed) > UNLIKE


@pytest.mark.parametrize("step", [1, 8])
def test_noise_adds_no_distance(step: int) -> None:
    """Noise twice as large as the differences of covers, also where each line fills eight rows."""
    noise = np.random.default_rng(3).normal(0, 2, (96, 96, COLUMNS))[::step].repeat(step, axis=0)
    known = trained(12)
    assert distance(known, scene(100) + noise) < 1.2 * max(1.0, distance(known, scene(100)))


def test_parts_add_up_and_unseen_pixels_do_not_count() -> None:
    """Pixels that were not captured may have any value; no pixel at all has no distance."""
    known, seen = trained(12), scene(100)
    strips = reduce(add, (known.of(some) for some in np.array_split(seen, 3)))
    assert strips.pixels == seen.shape[0] * seen.shape[1]
    assert known.distances(strips) == pytest.approx(known.distances(known.of(seen)), rel=0.1)
    shown = np.ones(seen.shape[:2], np.bool_)
    shown[:40] = False
    other = np.where(shown[..., None], seen, np.nan)
    assert known.distances(known.of(other, shown)) == known.distances(known.of(seen + 99 * ~shown[..., None], shown))
    assert known.distances(known.of(seen, ~shown & shown)) == (0.0, 0.0)


def test_statistics_round_trip_as_plain_numbers() -> None:
    """A reading has the same distances; those of other weights are refused."""
    known = trained(12)
    content = json.loads(json.dumps(known.as_dict()))
    assert distance(TrainingSpectra.read(content, COLUMNS), scene(100)) == pytest.approx(
        distance(known, scene(100)), rel=0.05
    )
    with pytest.raises(ValueError, match="spectra of axes"):
        TrainingSpectra.read(content, COLUMNS + 1)


@pytest.mark.parametrize("shape", [(1, 1), (2, 40), (9, 9), (96, 96)])
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_training_without_limits_has_no_statistics(shape: tuple[int, int], size: float) -> None:
    """Blocks are too few or have no neighbours, or their spectra are all one: weights of limit 0 are refused."""
    columns = size * np.random.default_rng(5).normal(0, 1, (*shape, COLUMNS))
    known = TrainingSpectra.measured([columns], np.eye(COLUMNS))
    assert (known is None) == (size == 0 or shape != (96, 96))
