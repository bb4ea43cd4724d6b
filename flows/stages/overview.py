"""Read the overview of a mosaic, by which patches are scored and whose unchanged regions the class map keeps."""

from __future__ import annotations

from spectralzoom.flows.stage import Output, stage
from spectralzoom.flows.stages.field_work import FieldWork
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.storage.store import Ref

OVERVIEWS = "overviews"  # folder of a store, with a file of each region


@stage("overview", version=1, product="overview", made_by=("models/network", "models/reading"))
def read_overview(out: Output, mosaic: Ref, *, work: FieldWork, capture: LineSpec) -> None:
    """Write features and logits of the overview, a file for each region; ``capture`` is that of the mosaic."""
    folder = out.path / OVERVIEWS
    folder.mkdir()
    work.write_overviews(mosaic, capture, folder, out.report)
