"""Count the bytes of a run (captured, written, kept, moved) against one reference, and publish the run with them.

The bytes kept include the receipt and the report. Both are written again until the figure in them is right.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from flows.publish.receipt import Facts, Receipt, check_receipt
from flows.settings.values import KEEP_SIGNAL
from flows.tasks.run import SurveyRun
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.prices import BYTES_PER_SAMPLE, raw_bytes
from storage.archive.archive import Archive
from storage.archive.records import RECEIPT
from storage.archive.run_folders import RunDraft
from storage.archive.whole_files import to_json
from storage.readers.recordings import LINE_PRODUCTS

REPORT = "report.html"


def open_account(run: SurveyRun, plan: FinePlan) -> Facts:
    """Return the bytes of the passes and of the reference; figures that are counted at publication are 0."""
    bands = len(run.scene.wavelength_nm)
    if run.raster is None:
        captured = raw_bytes([*run.plan.coarse, *plan.sweeps], run.camera, bands)
        reference = raw_bytes(run.plan.full, run.camera, bands)
    else:
        captured, reference = 0, int(np.prod(run.scene.shape)) * bands * BYTES_PER_SAMPLE
    return {**{"captured": captured, "written": 0, "kept": 0, "moved_bucket": 0}, "reference": reference}


def publish_counted(
    archive: Archive,
    draft: RunDraft,
    receipt: Receipt,
    page_of: Callable[[Receipt], str],
    *,
    rests_on: Mapping[str, str],
    of_earlier: Collection[str] = (),
    written: int = 0,
) -> Receipt:
    """Publish a run with receipt and page, and return the receipt with the bytes of the published run.

    Raw lines that the setting ``keep`` drops after the publication do not count as kept, nor do the stores
    ``of_earlier`` visits. All other files are in the draft's folder. ``rests_on`` is of `Archive.manifest_hashes`,
    ``written`` are bytes of stores that the receipt does not count yet.
    """
    facts: dict[str, Any] = {"survey": receipt["survey"], "settings": receipt["settings"], "rests_on": rests_on}
    products, drops_raw = receipt["products"], receipt["settings"]["keep"] == KEEP_SIGNAL
    others = {*of_earlier, *(products[name] for name in LINE_PRODUCTS if drops_raw and name in products)}
    stores = archive.sizes(uri for uri in rests_on if uri not in others)
    moved = archive.take_moved()
    before, longest, folder = receipt["data_bytes"], {RECEIPT: 0, REPORT: 0}, 0
    while True:
        told = {
            "written": before["written"] + written + folder,
            "kept": sum(stores.values()) + folder,
            "moved_bucket": before["moved_bucket"] + (moved + folder if archive.in_bucket else 0),
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
