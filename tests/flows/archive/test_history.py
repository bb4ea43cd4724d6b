"""A field's history: rows of its runs, and a page that loads nothing and links to existing reports."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from flows.archive.history import FieldHistory, _draw_areas, read_history, render_history
from flows.settings.load import time_of_visit
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.records import Run
from tests.flows.conftest import Page

pytestmark = pytest.mark.usefixtures("no_effects")

BAD = '<script>alert("1")</script>&'


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, survey_png: Any) -> Path:
    """Return an archive of one field with two surveys, by time or another name of the visit, and of another field."""
    root = tmp_path_factory.mktemp("history") / "archive"
    for visit in (f"b {BAD}", "2026-06-01T10:00:00Z"):
        survey_png(root, name="north", visit=visit, budget=None, scan_step="2")
    survey_png(root, name="south", budget=None, scan_step="2", labels=None)
    return root


def test_a_history_has_the_runs_of_one_field(archive: Path) -> None:
    """Visits are in order of their time, else of the start of the survey; class fractions add up to 1."""
    north = read_history(Archive.open(archive), "north")
    assert [row["visit"] for row in north.runs] == ["2026-06-01T10:00:00Z", f"b {BAD}"]
    assert north.runs[0]["visited"] == "2026-06-01T10:00:00+00:00"
    assert set(north.legend.names) >= set(north.runs[-1]["areas"])
    for row in north.runs:
        assert sum(row["areas"].values()) == pytest.approx(1.0)
        receipt = json.loads((archive / row["run"] / "receipt.json").read_text())
        assert row["miou"] == receipt["accuracy"]["miou"]
        assert row["capture_s"] == receipt["savings"]["capture_s"]["done"]


def test_an_archive_without_runs_has_no_history(tmp_path: Path) -> None:
    """The message says to survey first."""
    with pytest.raises(SettingsError, match="has 0 fields; survey into it first"):
        read_history(Archive.open(tmp_path))


def test_a_visit_surveyed_again_is_one_point(tmp_path: Path) -> None:
    """The newest run of visit and scene counts; other scenes and times are other visits."""
    archive = Archive.open(tmp_path)
    for scene, visit in (("a", None), ("a", "2026-06-08"), ("b", "2026-06-01"), ("a", None)):
        with archive.new_run("north") as draft:
            started = f"2026-05-{len(archive.runs()) + 10}T08:00:00Z"
            draft.write_file("receipt.json", json.dumps({"survey": "north", "scene": scene, "started": started}))
            draft.publish(survey="north", settings={"visit": visit})
    history = read_history(archive)
    assert [row["replaced"] for row in history.runs] == [True, False, False, False]
    page = render_history(history, "")
    assert "3 visits, 4 runs in the archive." in page
    assert page.count("replaced by a later run") == 1
    areas = [{**row, "unit": "fraction", "areas": {"soil": 1.0}} for row in history.runs]
    assert _draw_areas(areas, None) == _draw_areas(areas[1:], None)


@pytest.mark.parametrize(
    ("settings", "visited"),
    [
        ({"scene": "farm", "visit": "2026-06-21T09:30:00Z", "day": 130}, "2026-06-21T09:30"),
        ({"scene": "farm", "day": 179}, "2026-06-28T11:00"),
        ({"scene": "farm", "hour": 13.5}, "2026-06-21T13:30"),
        ({"scene": "field.png", "day": 130}, "2026-11-22T08:00"),
        ({"scene": "farm", "day": 10**12}, "2026-11-22T08:00"),
    ],
)
def test_a_visit_has_the_day_of_its_farm(settings: dict[str, Any], visited: str) -> None:
    """The time in a visit's name takes precedence; scenes from files have the time of their survey."""
    facts = {"created": "2026-11-23T00:00:00Z", "settings": settings}
    assert str(time_of_visit(Run(Path("x"), facts, {"started": "2026-11-22T08:00:00Z"}, None))).startswith(visited)


def test_pages_load_nothing_and_link_to_reports(archive: Path, command_line: Any, tmp_path: Path) -> None:
    """There is no script and all text is escaped; each link is an existing file, and the chart is data in the page."""
    page = tmp_path / "pages" / "history.html"
    ended = command_line("report", archive, "--field", "north", "-o", page)
    assert ended.code == 0, ended.err
    text = page.read_text(encoding="utf-8")
    found = Page(text)
    assert [one.partition(",")[0] for one in found.loaded] == ["data:image/png;base64"]
    assert found.scripts == []
    assert BAD not in text
    assert "&lt;script&gt;" in text
    assert not re.search(r"https?://|@import|url\(", text)
    assert len(found.links) == 2
    assert all((page.parent / link).is_file() for link in found.links)
    assert all(words in text for words in ("2026-06-01 10:00", "Class areas"))


def test_scores_on_training_scenes_are_marked() -> None:
    """The table has an asterisk, with a note below."""
    row = {"run": "runs/x", "created": "2026-06-01T10:00:00Z", "visited": None, "visit": None, "capture_s": None}
    row |= {"replaced": False, "unit": "fraction", "areas": {}, "miou": 0.5, "overall_accuracy": None}
    pages = [
        render_history(FieldHistory("north", "a", [{**row, "training_scene": seen}]), "") for seen in (None, "all")
    ]
    assert ">50.0</td>" in pages[0]
    assert "judged on" not in pages[0]
    assert ">50.0*</td>" in pages[1]
    assert "* judged on a scene that the weights were trained on." in pages[1]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("--field nrth -o {0}/x.html", 2, "no field of .* is called 'nrth'; give --field with one of: north, south"),
        ("-o {0}/x.html", 2, "has 2 fields; give --field with one of: north, south"),
        ("-o {0}", 2, "is a folder, expected the file to write"),
        ("-o {0}/x.pdf", 2, "expected a page's name that ends in .html"),
        ("-o {1}/x.html", 2, "lies in the archive"),
    ],
)
def test_impossible_reports_are_refused(
    archive: Path, command_line: Any, tmp_path: Path, words: str, code: int, message: str
) -> None:
    """One message comes with the exit code, and no file is written."""
    command_line("report", archive, *words.format(tmp_path, archive).split()).refused(code, message)
    assert not list(tmp_path.glob("*.html"))
