"""A field's history: rows of its runs, a page that loads nothing, an index with links that lead somewhere."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.archive.history import FieldHistory, read_history, render_history, time_of_visit
from storage.archive.archive import Archive
from storage.archive.records import Run
from storage.arrays.class_maps import load_class_map
from tests.flows.conftest import Page

pytestmark = pytest.mark.usefixtures("no_effects")

BAD = '<script>alert("1")</script>&'


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, survey_png: Any) -> Path:
    """Two surveys of one field, by their due times or other names, and one of another."""
    root = tmp_path_factory.mktemp("history") / "archive"
    survey_png(root, name="north", visit=f"b {BAD}")
    survey_png(root, name="north", visit="2026-06-01T10:00:00Z")
    survey_png(root, name="south")
    return root


def row(**facts: Any) -> dict[str, Any]:
    """A run of a history that scored 50 of 100."""
    return {
        **{"run": "runs/x", "created": "2026-06-01T10:00:00Z", "visited": "2026-06-01T10:00:00Z", "unit": "fraction"},
        **{"areas": {}, "savings": dict.fromkeys(("capture_s", "lines", "bytes_kept", "multiply_adds"))},
        **{"miou": 0.5, "overall_accuracy": 0.5, "training_scene": None, **facts},
    }


def test_runs_are_one_history(archive: Path) -> None:
    """Visits stand by their due times; shares add up; a map that was drawn is among the pictures."""
    north = read_history(Archive.open(archive), "north")
    assert [row["visit"] for row in north.runs] == ["2026-06-01T10:00:00Z", f"b {BAD}"]
    assert north.runs[0]["visited"] == "2026-06-01T10:00:00Z"
    assert sum(north.runs[0]["areas"].values()) == pytest.approx(1.0)
    assert north.runs[0]["miou"] is not None
    assert [one["when"] for one in north.visits] == [
        "2026-06-01 10:00",
        f"b {BAD}, {north.runs[1]['visited'][:16].replace('T', ' ')}",
    ]
    receipt = json.loads((archive / north.runs[0]["run"] / "receipt.json").read_text())
    shown = load_class_map(archive / receipt["products"]["class_map"])
    with Image.open(io.BytesIO(base64.b64decode(north.visits[0]["map"].partition(",")[2]))) as picture:
        np.testing.assert_array_equal(np.asarray(picture), np.minimum(shown.classes, 127))
    assert north.visits[0]["words"].endswith("first visit")


def test_pages_load_nothing_and_lead_to_reports(archive: Path, command_line: Any, tmp_path: Path) -> None:
    """Without a script, every word escaped; each link is a file that is there."""
    page = tmp_path / "pages" / "history.html"
    ended = command_line("report", archive, "--field", "north", "-o", page)
    assert ended.code == 0, ended.err
    text = page.read_text(encoding="utf-8")
    found = Page(text)
    assert [one for one in found.loaded if not one.startswith("data:image/png;base64,")] == []
    assert found.scripts == []
    assert BAD not in text
    assert "&lt;script&gt;" in text
    assert not re.search(r"https?://|@import|url\(", text)
    assert len(found.links) == 2
    assert all((page.parent / link).is_file() for link in found.links)
    assert all(words in text for words in ("2026-06-01 10:00", "Fraction of the map"))


def test_scores_on_a_scene_of_the_training_are_marked() -> None:
    """In the table, with the words of terminal and report below it, and in the chart as lines of their own."""
    pages = {
        seen: render_history(FieldHistory("north", "a", [row(training_scene=seen)]), "runs")
        for seen in (None, "all", "other pixels")
    }
    assert ">50.0</td>" in pages[None]
    assert "judged on" not in pages[None]
    assert ">50.0*</td>" in pages["all"]
    assert "* judged on a training scene (not valid for other fields)." in pages["all"]
    assert ">50.0***</td>" in pages["other pixels"]
    (chart,), (other,) = (re.findall(r'class="chart" src="([^"]+)"', pages[seen]) for seen in (None, "all"))
    assert chart != other


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("--field nrth -o {0}/x.html", 1, "no field of .* is called 'nrth'; give --field with one of: north, south"),
        ("-o {0}/x.html", 1, "has 2 fields; give --field with one of: north, south"),
        ("-o {0}", 2, "is a folder, expected the file to write"),
        ("-o {0}/x.pdf", 2, "expected a page's name that ends in .html"),
        ("-o {1}/x.html", 2, "lies in the archive"),
    ],
)
def test_a_report_that_cannot_be_written(
    archive: Path, command_line: Any, tmp_path: Path, words: str, code: int, message: str
) -> None:
    """One message, the exit code, and no file."""
    command_line("report", archive, *words.format(tmp_path, archive).split()).refused(code, message)
    assert not list(tmp_path.glob("*.html"))


@pytest.mark.parametrize(
    ("settings", "observation"),
    [
        ({"visit": "2026-06-21T09:30:00Z", "scene": "farm", "day": 130}, "2026-06-21 09:30"),
        ({"visit": "second", "scene": "farm", "day": 130}, "2026-05-10 11:00"),
        ({"scene": "farm", "day": 172, "hour": 13.5}, "2026-06-21 13:30"),
        ({"scene": "field.png", "day": 130}, "2026-11-22 08:00"),
        ({"scene": "farm", "day": None}, "2026-11-22 08:00"),
        ({"scene": "farm", "day": 10**9}, "2026-11-22 08:00"),
    ],
)
def test_a_look_has_the_date_of_the_look(settings: dict[str, Any], observation: str) -> None:
    """By its visit's name, by the farm's day; the clock is asked last, when the survey began."""
    receipt = {"settings": settings, "started": "2026-11-22T08:00:00Z"}
    run = Run(Path("x"), {"created": "2026-11-23T00:00:00Z"}, receipt, None)
    found = time_of_visit(run)
    assert found is not None
    assert f"{found:%Y-%m-%d %H:%M}" == observation
