"""Simulated scenes and the simulated source that looks at them."""

from typing import TYPE_CHECKING

from pipeline.lazy import deferred

if not TYPE_CHECKING:  # numba takes half a second to import: a plan of a survey never needs it
    compiled_loops = deferred("pipeline.simulator.compiled_loops")
