"""The stores of a survey, and their names in receipts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages.effects import RECORD as EFFECTS
from spectralzoom.flows.stages.evaluate import RECORD as ACCURACY
from spectralzoom.flows.stages.ground import STORE as GROUND_MAP
from spectralzoom.flows.stages.locate import TIE_POINTS
from spectralzoom.flows.stages.register import REGISTRATION
from spectralzoom.flows.stages.score import SCORES
from spectralzoom.storage.arrays.class_maps import MAP, PROBABILITIES
from spectralzoom.storage.store import Ref


@dataclass(frozen=True)
class Pass:
    """Stores of one pass; signal and mosaic of a second one are those of both."""

    raw: Ref
    signal: Ref
    mosaic: Ref
    seams: Ref | None  # registration
    places: Ref | None = None  # geolocation grid; None of a second pass


@dataclass(frozen=True, kw_only=True)
class Products:
    """Stores of a survey; a raster has no passes."""

    mosaic: Ref  # of all passes
    attention: Ref  # scores of the patches, and plan of the second pass
    class_map: Ref
    overview: Ref | None = None  # by which patches were scored
    effects: Ref | None = None  # of a simulated source
    first: Pass | None = None
    second: Pass | None = None
    ground: Ref | None = None
    accuracy: Ref | None = None

    @property
    def passes(self) -> list[Pass]:
        """Return the second pass and the first one, in the order in which they are condensed."""
        return [one for one in (self.second, self.first) if one is not None]

    def addresses(self) -> dict[str, str]:
        """Return the addresses of the stores, or of files in them, by their names in receipts."""
        return {name: ref.uri + (f"/{file}" if file else "") for name, ref, file in self._named() if ref is not None}

    def _named(self) -> Iterator[tuple[str, Ref | None, str]]:
        yield "effects", self.effects, EFFECTS
        if self.first is not None:
            yield "raw_coarse", self.first.raw, ""
            yield "signal_coarse", self.first.signal, ""
            yield "coarse_pointing", self.first.seams, REGISTRATION
            yield "geolocation", self.first.places, TIE_POINTS
            yield "mosaic", self.first.mosaic, "mosaic.zarr"
        if self.second is not None:
            yield "raw_fine", self.second.raw, ""
            yield "signal_fine", self.second.signal, ""
            yield "fine_pointing", self.second.seams, REGISTRATION
        yield "mosaic", self.mosaic, "mosaic.zarr"
        yield "attention", self.attention, SCORES
        yield "plan", self.attention, "plan.json"
        yield "class_map", self.class_map, MAP
        yield "class_probabilities", self.class_map, PROBABILITIES
        yield "ground_map", self.ground, GROUND_MAP
        yield "accuracy", self.accuracy, ACCURACY


@dataclass(frozen=True)
class Control:
    """The best uniform scan of the same seconds, which was simulated and judged beside a survey."""

    plan: SurveyPlan
    stores: Stores
    products: Products
