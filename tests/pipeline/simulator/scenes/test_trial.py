"""The trial: plots on a sixteenth of a meadow or stubble, the same land on all days, with the farm's classes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.simulator.scenes.built_in import built_in_scene
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.trial import CROPS, trial_plan, trial_scene

SIZE = (512, 640)
SEEDS = (0, 1, 2, 3)


def _shares(labels: NDArray[np.uint8]) -> dict[str, float]:
    return {name: float((labels == number).mean()) for number, name in enumerate(CLASSES)}


def test_equal_arguments_give_equal_trials() -> None:
    """One seed and day give one scene, bit for bit, by name and by law."""
    scenes = [built_in_scene(name, 7, SIZE, 5, day=165) for name in ("trial", "trial@1")]
    assert scenes[0].key == scenes[1].key == trial_scene(7, SIZE, 5, day=165).key
    np.testing.assert_array_equal(scenes[0].planes, scenes[1].planes)
    np.testing.assert_array_equal(scenes[0].labels, scenes[1].labels)
    np.testing.assert_allclose(scenes[0].planes.sum(axis=2), 1.0, atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_plots_cover_a_sixteenth_of_the_scene(seed: int) -> None:
    """All plots, with their alleys, lie in a rectangle of that area within the scene."""
    plots = [field.parcel.corners for field in trial_plan(seed, SIZE, day=172, hour=11.0).fields[4:]]
    corners = np.concatenate(plots)
    area = sum(abs(np.prod(np.ptp(one, axis=0))) for one in plots)
    assert area == pytest.approx(SIZE[0] * SIZE[1] / 16)
    assert np.prod(np.ptp(corners, axis=0)) == pytest.approx(area)
    assert (np.abs(corners) <= np.array(SIZE) / 2).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_crops_and_weeds_are_within_the_trial(seed: int) -> None:
    """All crops of the plots are there; most weeds grow among them, and the land around is one class."""
    shares = _shares(trial_scene(seed, SIZE, 2).labels)
    assert all(shares[crop] > 0.002 for crop in CROPS)
    assert max(shares["grass"], shares["stubble"]) > 0.9
    plan = trial_plan(seed, SIZE, day=172, hour=11.0)
    inside = np.concatenate([field.parcel.corners for field in plan.fields[4:]])
    (top, left), (bottom, right) = (end(inside, axis=0) + np.array(SIZE) / 2 for end in (np.min, np.max))
    weeds = np.argwhere(trial_scene(seed, SIZE, 2).labels == CLASSES.index("weed"))
    within = (weeds >= (top - 3, left - 3)).all(axis=1) & (weeds <= (bottom + 3, right + 3)).all(axis=1)
    assert within.mean() > 0.5


def test_the_land_is_the_same_a_week_later() -> None:
    """Plots keep their place and crop; most pixels keep their class."""
    one, other = (trial_plan(5, SIZE, day=day, hour=11.0) for day in (172, 179))
    assert [field.use for field in one.fields] == [field.use for field in other.fields]
    labels = [trial_scene(5, SIZE, 2, day=day).labels for day in (172, 179)]
    assert (labels[0] == labels[1]).mean() > 0.98


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (64, 64)])
def test_tiny_trials_have_labels_everywhere(size: tuple[int, int]) -> None:
    """A scene of any size is drawn."""
    scene = trial_scene(3, size, 2)
    assert scene.labels.shape == size
    assert (scene.labels < len(CLASSES)).all()


def test_an_empty_shape_is_refused() -> None:
    """The message is that of the farm."""
    with pytest.raises(SceneError, match="at least 1 x 1 px"):
        trial_scene(3, (0, 5), 2)
