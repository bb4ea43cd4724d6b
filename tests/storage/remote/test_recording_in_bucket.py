"""A recording out of an archive in a bucket: raw cubes of a run that another machine published."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from functools import partial

from pipeline.errors import ArchiveError
from storage.readers.recordings import open_recording
from tests.pipeline.capture.recordings import CAMERA, FULL, simulated
from tests.storage.readers.test_recordings import write_raw
from tests.storage.small_bucket import FIRST, SECOND, Machine


def test_a_run_of_a_bucket_is_a_recording(bucket: str, machine: Machine) -> None:
    """The newest run and the run named give the cubes that the first machine wrote; another name is refused."""
    archive, source = machine(FIRST), simulated()
    ref, _ = archive.produce("capture", partial(write_raw, source=source, sweep=FULL), version=1, params={})
    with archive.new_run("field") as draft:
        draft.write_file("receipt.json", json.dumps({"products": {"raw_coarse": ref.uri}}))
    machine(SECOND)
    for address in (bucket, f"{bucket}/runs/{draft.id}"):
        (sweep,) = open_recording(address, CAMERA).sweeps
        np.testing.assert_array_equal(sweep.read(0, 80), np.stack([line.data for line in source.lines(FULL)]))
    with pytest.raises(ArchiveError, match="has no run 'other'"):
        open_recording(f"{bucket}/runs/other", CAMERA)
