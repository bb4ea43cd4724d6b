"""Count the bytes of a run (captured, written, kept, moved) against one reference, and publish the run with them.

The bytes kept include the receipt and the report. Both are written again until the figure in them is right.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flows.publish.receipt import Facts, Receipt, check_receipt
from flows.tasks.run import SurveyRun
from pipeline.errors import IncompleteStoreError
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.prices import BYTES_PER_SAMPLE, raw_bytes
from storage.archive.archive import Archive
from storage.archive.keys import store_at
from storage.archive.records import RECEIPT, read_run
from storage.archive.run_folders import RunDraft
from storage.archive.staging import MANIFEST_NAME
from storage.archive.whole_files import to_json

REPORT = "report.html"


def open_account(run: SurveyRun, plan: FinePlan) -> Facts:
    """Return the bytes of the passes and of the reference; figures that are counted at publication are 0."""
    bands = len(run.scene.wavelength_nm)
    if run.raster is None:
        captured = raw_bytes([*run.plan.coarse, *plan.sweeps], run.camera, bands)
        reference = raw_bytes(run.plan.full, run.camera, bands)
    else:
        captured, reference = 0, int(np.prod(run.scene.shape)) * bands * BYTES_PER_SAMPLE
    return {
        **{"captured": captured, "written": 0, "kept": 0, "moved_bucket": 0},
        "moved_workers": 0 if run.settings.pool.shares_memory else None,
        **{"reference": reference, "reused": {}},
    }


def publish_counted(
    archive: Archive,
    draft: RunDraft,
    receipt: Receipt,
    page_of: Callable[[Receipt], str],
    *,
    rests_on: Mapping[str, str],
    written: int = 0,
) -> Receipt:
    """Publish a run with receipt and page, and return the receipt with the bytes of the published run.

    All other files are in the draft's folder. ``rests_on`` is of `Archive.manifest_hashes`, ``written`` are bytes of
    stores that the receipt does not count yet.
    """
    facts: dict[str, Any] = {"survey": receipt["survey"], "settings": receipt["settings"], "rests_on": rests_on}
    stores, moved = archive.sizes(rests_on), archive.take_moved()
    before, longest, folder = receipt["data_bytes"], {RECEIPT: 0, REPORT: 0}, 0
    built = {row["key"] for row in receipt["stages"] if row["state"] == "ran"}
    reused = {uri: size for uri, size in stores.items() if uri.rpartition("/")[2] not in built}
    while True:
        sent = moved + folder if archive.in_bucket else 0
        told = {
            "written": before["written"] + written + folder,
            "kept": sum(stores.values()) + folder,
            "moved_bucket": before["moved_bucket"] + sent,
            "reused": reused,
        }
        receipt = check_receipt(receipt | {"data_bytes": before | told})
        for name, text in ((RECEIPT, to_json(receipt)), (REPORT, page_of(receipt))):
            content = text.encode()
            longest[name] = max(longest[name], len(content))
            draft.write_file(name, content.ljust(longest[name], b"\n"))  # no file shrinks, so that the loop ends
        size = draft.bytes_published(**facts)
        if size == folder:
            break
        folder = size
    draft.publish(**facts)
    archive.take_moved()  # the upload of the folder is counted already
    return receipt


def recount_bytes(archive: Archive, run: str, replace_rows: Callable[[str, Receipt], str]) -> Receipt:
    """Publish a run again with its present bytes, such as after stores were cleared away; return its receipt.

    ``run`` is the name of its folder; ``replace_rows`` puts the savings of a receipt into a page. Nothing else changes.
    Raises ArchiveError: there is no such run; IncompleteStoreError: it is damaged.
    """
    draft = archive.extend_run(run)
    assert draft is not None
    with draft:
        place = archive.locate(f"runs/{run}")
        found = read_run(place)
        if found.problem is not None:
            raise IncompleteStoreError(f"{found.uri}: {found.problem}; run verify --repair on the archive")
        for path in place.iterdir():
            if path.name not in (RECEIPT, REPORT, MANIFEST_NAME):  # written below
                shutil.copyfile(path, draft.folder / path.name)
        page = (place / REPORT).read_text(encoding="utf-8")
        there = [uri.split("/")[1:] for uri in found.names if (archive.root / uri / MANIFEST_NAME).is_file()]
        rests_on = archive.manifest_hashes(store_at(archive.root, stage, key) for stage, key in there)
        return publish_counted(
            archive, draft, dict(found.receipt), lambda receipt: replace_rows(page, receipt), rests_on=rests_on
        )
