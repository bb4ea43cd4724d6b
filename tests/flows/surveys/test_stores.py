"""The stores of a survey in an archive: raw lines once, equal stores from processes, and cleared inputs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

from spectralzoom.flows.prefect_flow import survey
from spectralzoom.flows.products import Pass, Products
from spectralzoom.flows.publish.publishing import clear_intermediate
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.stages.condense import SignalChoice, components_of
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.source import References
from spectralzoom.storage.arrays.cubes import open_raw_cube
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import Archive, Ref, uri_of
from tests.conftest import QUIET, Survey
from tests.faults.small_survey import stored
from tests.flows.conftest import act_instead, problems
from tests.storage.plain_mosaic import KillOnce


@pytest.mark.parametrize("order", [(1.0, 16.0), (16.0, 1.0)], ids=["short pass first", "long pass first"])
@pytest.mark.parametrize("dark", [0, 5])
@pytest.mark.parametrize("shared", [False, True], ids=["own white frames", "one white frame"])
def test_few_bands_are_stored_in_steps_of_the_longest_exposure(
    order: tuple[float, float], dark: int, shared: bool
) -> None:
    """One DN of a long exposure is a smaller scene value than one of a short exposure, so no pass loses a DN.

    Bands without light do not count. Each pass has a white frame of its exposure, or all have one of 1 ms.
    """
    found = SignalStatistics(4 + dark, 64)
    lit = np.append(np.ones(4, np.float32), np.full(dark, np.nan, np.float32))
    found.add(np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 1)).astype(np.float32) * lit, np.ones((8, 8), np.bool_))
    zero = np.zeros((8, 4 + dark), np.float32)
    white = zero + 100 * np.nan_to_num(lit)
    values, bands = np.ones(4 + dark, np.float32), np.arange(4.0 + dark)
    common = References(zero, white, values, exposure_ms=1.0)
    frames = [common if shared else References(zero, one * white, values) for one in order]
    cubes: Any = [
        SimpleNamespace(references=one, wavelength_nm=bands, exposure_ms=np.full(8, ms))
        for one, ms in zip(frames, order, strict=True)
    ]
    np.testing.assert_allclose(components_of(found, cubes, SignalChoice()).noise, lit / 1600)


@pytest.mark.usefixtures("no_effects")
def test_stores_of_another_run_are_not_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another survey kept these raw lines and published the first pass's mosaic without a second pass."""
    np.save(tmp_path / "nothing.npy", np.zeros((96, 96), np.float32))
    bands = ",".join(map(str, range(5, 265, 40)))
    given: dict[str, Any] = {"scene": "farm", "size": (96, 96), "bands": bands, "out": str(tmp_path / "archive")}
    given |= {"engine": "plain", "accuracy": False, "budget": 0.95, "scan_exposure_ms": 4.0, "zoom": "always"}
    others: list[Path] = []

    def meanwhile(*survey_of: Any) -> None:
        """Run the other survey when the first one has its map."""
        monkeypatch.undo()
        nothing = {"policy": "mask", "mask": str(tmp_path / "nothing.npy")}
        others.append(survey.fn(Settings(**given, **nothing, keep="raw")).folder)
        clear_intermediate(*survey_of)

    act_instead(monkeypatch, "clear_intermediate", meanwhile)
    one = read_run(survey.fn(Settings(**given, policy="random")).folder)
    archive = Archive.open(tmp_path / "archive")
    assert "raw_fine" in one.products
    assert archive.locate(one.products["raw_coarse"]).is_dir()
    assert archive.locate(read_run(others[0]).products["mosaic"]).is_dir()


@pytest.mark.usefixtures("no_effects")
def test_raw_lines_are_stored_once_and_as_uint16(tmp_path: Path) -> None:
    """Every captured line is in one array, under one name; the spool is empty; derived arrays are smaller."""
    flags = {"scene": "farm", "size": "192x160", "engine": "plain", "budget": "0.95", "keep": "raw"}
    bands = ",".join(map(str, range(5, 265, 10)))  # as many as a spectrum of light needs
    root = tmp_path / "archive"
    published = run_survey(load_settings(None, {**flags, "bands": bands, "out": str(root)}), QUIET)
    nodes = {path.parent: json.loads(path.read_text())["node_type"] for path in root.glob("stages/**/zarr.json")}
    arrays = [(path, zarr.open_array(path, mode="r")) for path, kind in sorted(nodes.items()) if kind == "array"]
    named = [getattr(array.metadata, "dimension_names", None) or () for _, array in arrays]
    by_line = [one for one, names in zip(arrays, named, strict=True) if {"line", "band"} <= set(names)]
    assert {path.name for path, _ in by_line} == {"dn"}
    assert {array.dtype for _, array in by_line} == {np.dtype(np.uint16)}
    sweeps = [open_raw_cube(path.parent).sweep.name for path, _ in by_line]
    assert len(sweeps) == len(set(sweeps))
    assert sum(array.shape[0] for _, array in by_line) == published.receipt["savings"]["lines"]["done"]
    assert [path for path in (root / "spool").rglob("*") if path.is_file()] == []
    raw = {path for path, _ in by_line}
    assert not [path for path, array in arrays if array.dtype == np.uint16 and path not in raw]
    for kind in ("condense", "condense_fine", "rectify_fine"):  # no derived array has all bands of a pixel
        scores = [array for path, array in arrays if path.match(f"stages/{kind}/*/*.zarr/scores")]
        assert scores, kind
        assert all(array.shape[0] < by_line[0][1].shape[2] for array in scores), kind
    lines, signal = (
        sum(array.nbytes for path, array in arrays if path.match(f"stages/{kind}/*/*.zarr/{name}"))
        for kind, name in (("capture", "dn"), ("condense_fine", "scores"))
    )
    assert signal < lines


def test_processes_make_the_same_archive(
    tmp_path: Path, survey_png: Survey, surveyed_png: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes, one killed by kill -9, write the keys and bytes of a survey with threads; xarray opens the map."""
    roots = tmp_path / "threads", tmp_path / "processes"
    surveyed_png(roots[0])
    monkeypatch.setattr("spectralzoom.flows.stages.rectify.TileMaker", partial(KillOnce, folder=str(tmp_path)))
    survey_png(roots[1], scheduler="processes", workers=2)
    assert (tmp_path / "killed").exists()
    assert stored(roots[0]) == stored(roots[1])
    assert problems(roots[1]) == []
    (drawn,) = roots[1].glob("stages/segment/*/class_map.zarr")
    with xr.open_zarr(drawn, consolidated=False) as found:
        assert found["classes"].values.shape == (96, 128)


def test_a_receipt_names_every_store() -> None:
    """The mosaic of the first pass has its name where there is no second pass."""
    kinds = ("raw", "signal", "mosaic", "seams", "places")
    first, second = (Pass(*(Ref(f"{kind}-{number}", "k", Path()) for kind in kinds)) for number in range(2))
    rest = {name: Ref(name, "k", Path()) for name in ("attention", "class_map", "effects", "ground", "accuracy")}
    for later, given in ((None, [first]), (second, [first, second])):
        found = Products(mosaic=given[-1].mosaic, first=first, second=later, **rest).addresses()
        stores = {ref.uri for one in given for name, ref in vars(one).items() if name != "places" or one is first}
        hidden = set() if later is None else {first.mosaic.uri}
        assert {uri_of(address) for address in found.values()} == stores - hidden | {ref.uri for ref in rest.values()}
        assert uri_of(found["mosaic"]) == given[-1].mosaic.uri
