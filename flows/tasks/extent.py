"""How much there is to do for the map of a survey: multiply-adds of the network."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flows.tasks.reading_costs import ReadingCosts
from flows.tasks.run import SurveyRun
from models.network.sizes import MultiplyAdds


def work_done(run: SurveyRun, patch_index: NDArray[np.integer]) -> MultiplyAdds:
    """Count the scores of the field, and the map drawn with fine patches at these patches.

    Where everything is seen and read nothing is scored.
    """
    costs = reading_costs(run)
    done = costs.with_scores(patch_index, run.settings.policy) if run.chooses else costs.of_map(patch_index)
    if run.prior is not None and run.reader is not None:
        recalled = run.reader.sizes.multiply_adds(run.grid.height * run.grid.width)
        done = replace(done, decode=done.decode + recalled)
    return done


def work_of_map(run: SurveyRun, patch_index: NDArray[np.integer]) -> MultiplyAdds:
    """Count the map drawn with fine patches at these patches of the field."""
    return reading_costs(run).of_map(patch_index)


def reading_costs(run: SurveyRun) -> ReadingCosts:
    """What it takes to read the field of a survey."""
    return ReadingCosts(run.described.config, run.grid, len(run.scene.wavelength_nm))
