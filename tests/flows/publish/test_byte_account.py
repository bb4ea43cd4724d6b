"""The byte account of a run: the size of files in folders confirms each figure, and terminal and page show it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.archive.commands import contents
from spectralzoom.flows.publish.receipt_table import saving_rows
from spectralzoom.storage import store
from spectralzoom.storage.store import Archive
from tests.conftest import Survey
from tests.flows.conftest import problems
from tests.flows.publish.test_receipt import make_receipt, page_of, printed

pytestmark = pytest.mark.usefixtures("no_effects")

ONE_SCAN: dict[str, Any] = {"budget": None, "scan_step": "2"}


def walked(*folders: Path) -> int:
    """Return the bytes of all files in folders, as `find -type f` lists them."""
    return sum(path.stat().st_size for folder in folders for path in folder.rglob("*") if path.is_file())


def told(folder: Path) -> dict[str, Any]:
    """Return the account in the receipt of a run's folder."""
    account: dict[str, Any] = json.loads((folder / "receipt.json").read_text())["data_bytes"]
    return account


@pytest.fixture
def spooled(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that gets the bytes of each spool when it is removed."""
    found: list[int] = []
    remove = store.remove

    def remove_measured(path: Path) -> None:
        if path.parent.name == "spool":
            found.append(walked(path))
        remove(path)

    monkeypatch.setattr(store, "remove", remove_measured)
    return found


@pytest.mark.parametrize(("keep", "budget", "accuracy"), [("raw", "0.45", False), ("signal", "0.8", True)])
def test_the_account_of_a_survey_matches_its_folders(
    spooled: list[int], survey_png: Survey, tmp_path: Path, keep: str, budget: str, accuracy: bool
) -> None:
    """Kept and written bytes are those of files, captured bytes those of lines; nothing is moved.

    Raw lines, the overview and the mosaic of a first pass, which are cleared, count as written and not as kept. The
    folder of the run does not count.
    """
    root = tmp_path / "archive"
    published = survey_png(root, accuracy=accuracy, keep=keep, budget=budget)
    account = told(published.folder)
    assert account == published.receipt["data_bytes"]
    cleared = [root / "stages" / "capture"] if keep == "signal" else []
    assert walked(*cleared) < 30_000  # manifests
    assert account["kept"] == walked(root / "stages") - walked(*cleared)
    assert sum(spooled) > 0
    assert account["written"] >= account["kept"] + sum(spooled)
    (overview,) = (json.loads(path.read_text())["files"] for path in root.glob("stages/overview/*.cleared"))
    gone = sum(size for size, _ in overview.values())
    assert keep == "signal" or account["written"] == account["kept"] + sum(spooled) + gone
    assert account["reference"] >= 96 * 128 * 3 * 2  # a line has all samples of the camera
    assert 0 < account["captured"] < sum(spooled)  # a spool has values, times and checksums of the lines
    assert account["captured"] > 0.9 * sum(spooled)
    (listed,) = contents(Archive.open(root))["runs"]
    assert listed["bytes"] == walked(root / "stages", root / "runs")
    assert problems(root) == []


def test_cached_stores_count_as_kept_not_as_written(survey_png: Survey, tmp_path: Path) -> None:
    """A second run of the same survey writes no store, and keeps those of the first."""
    root = tmp_path / "archive"
    first, again = (survey_png(root, accuracy=False, **ONE_SCAN) for _ in range(2))
    assert again.folder != first.folder
    account = told(again.folder)
    assert account["written"] == 0
    stores = [ref for ref in Archive.open(root).refs() if ref.stage != "capture"]
    assert account["kept"] == walked(*(ref.path for ref in stores))
    assert account["captured"] == told(first.folder)["captured"]  # its passes are the same


def test_a_visit_does_not_count_the_one_before(survey_png: Survey, tmp_path: Path) -> None:
    """The stores of its prior map belong to the visit before; both accounts add up to the stores of the archive."""
    root = tmp_path / "archive"
    flags = ONE_SCAN | {"prior": "latest", "accuracy": False}
    visits = [survey_png(root, **flags, visit=f"2026-06-0{day}T10:00:00Z") for day in (1, 8)]
    assert visits[1].receipt["prior_map"]["days"] == 7
    accounts = [told(visit.folder) for visit in visits]
    everything = walked(root / "stages") - walked(root / "stages" / "capture")
    assert sum(one["kept"] for one in accounts) == everything


def test_terminal_and_page_show_bytes_against_the_reference() -> None:
    """Kept, captured and written bytes have a row each, with their fraction of the reference."""
    rows = [row for row in saving_rows(make_receipt()) if row["label"].startswith("bytes")]
    assert [(row["label"], row["done"], row["full"], row["ratio"]) for row in rows] == [
        ("bytes kept", "1.5 MB", "4 MB", 0.375),
        ("bytes captured", "2 MB", "4 MB", 0.5),
        ("bytes written", "7 MB", "4 MB", 1.75),
    ]
    tiny = make_receipt()
    tiny["data_bytes"] |= {"captured": 384, "written": 655_553, "kept": 655_553, "reference": 384}
    for receipt, figures in (
        (make_receipt(), ("bytes kept", "1.5 MB", "38 %", "4 MB")),
        (tiny, ("656 kB", "384 B", "1 710 times")),  # a multiple, no percentage of six digits
    ):
        page = page_of(receipt).replace("\u202f", " ")
        for text in (" ".join(printed(receipt, 80, verbose=True).replace("\u202f", " ").split()), page):
            assert [figure for figure in figures if figure not in text] == []
