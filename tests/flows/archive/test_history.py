"""A field's history: rows of its runs, a page that loads nothing, an index with links that lead somewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from flows.archive.field_visits import COLOURS, line_chart, look_of
from flows.archive.history import FieldHistory, _summed_seconds, read_histories, render_history, render_index, way_to
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


def test_runs_are_one_history(archive: Path) -> None:
    """Visits stand by their due times; shares add up; what is brown on the map is brown on the page."""
    north, south = read_histories(Archive.open(archive))
    assert (north.field, south.field) == ("north", "south")
    assert [row["visit"] for row in north.runs] == ["2026-06-01T10:00:00Z", f"b {BAD}"]
    assert north.runs[0]["looked"] == "2026-06-01T10:00:00Z"
    assert sum(north.runs[0]["areas"].values()) == pytest.approx(1.0)
    assert north.runs[0]["miou"] is not None
    receipt = json.loads((archive / north.runs[0]["run"] / "receipt.json").read_text())
    shown = load_class_map(archive / receipt["products"]["class_map"])
    wanted = {name: "#" + bytes(map(int, rgb)).hex() for name, rgb in zip(shown.names, shown.colours, strict=True)}
    assert north.runs[0]["colours"] == wanted
    page = render_history(north, "runs")
    seen = [name for name, share in north.runs[0]["areas"].items() if share]
    assert all(f'<i style="background:{wanted[name]}"></i>{name.replace("_", " ")}' in page for name in seen)
    chart = line_chart({"a": [(0.0, 1.0)], "b": [(0.0, 1.0)]}, "x", colours={"b": "#123456", "c": "#654321"})
    assert chart.legend == {"a": COLOURS[0], "b": "#123456"}
    assert "#123456" in (chart.drawing or "")


def test_pages_load_nothing_and_lead_to_reports(archive: Path, command_line: Any, tmp_path: Path) -> None:
    """With no script but the player's, every word escaped; each link is a file that is there, on either page."""
    page = tmp_path / "pages" / "history.html"
    ended = command_line("report", archive, "--field", "north", "-o", page)
    assert ended.code == 0, ended.err
    text = page.read_text(encoding="utf-8")
    found = Page(text)
    assert [one for one in found.loaded if not one.startswith("data:image/png;base64,")] == []
    assert len(found.scripts) == 2
    assert BAD not in text
    assert "&lt;script&gt;" in text
    assert not re.search(r"https?://|@import|url\(", text.partition("<script>")[0])
    assert len(found.links) == 2
    assert all((page.parent / link).is_file() for link in found.links)
    assert all(words in text for words in ("2026-06-01 10:00", "Share of the map", "<svg"))
    page = tmp_path / "index.html"
    ended = command_line("report", archive, "-o", page)
    assert ended.code == 0, ended.err
    found = Page(page.read_text(encoding="utf-8"))
    assert sorted(found.links) == ["index-north.html", "index-south.html"]
    assert all((tmp_path / link).is_file() for link in found.links)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("--field nrth -o {0}/x.html", 1, "no field of .* is called 'nrth'; did you mean north?"),
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


def test_charts_and_pages_of_little(tmp_path: Path) -> None:
    """One point is drawn too, the same points alike; a field without a run has a page; links are relative."""
    series = {"soil": [(0.0, 1.0), (86400.0, 0.5)], "crop": [(0.0, 0.2)]}
    chart, again = line_chart(series, "Share", "%"), line_chart(series, "Share", "%")
    assert chart.drawing == again.drawing
    assert chart.drawing is not None
    assert chart.drawing.count("<use") == 3
    assert all(chart.drawing.count(f"fill: none; stroke: {colour}") == 1 for colour in chart.legend.values())
    assert ">100 %<" in chart.drawing
    assert not re.search(r"https?:|url\(|<style", chart.drawing)
    page = render_history(FieldHistory("new", "archive", []), "")
    Page(page)
    assert "nothing to draw yet" in page
    Page(render_index([], "archive", {}))
    assert way_to(tmp_path / "archive", tmp_path / "x.html") == "archive"
    assert way_to(tmp_path / "archive", tmp_path / "pages" / "x.html") == "../archive"
    assert way_to(tmp_path / "my field", tmp_path / "x.html") == "my%20field"


@pytest.mark.parametrize(
    ("points", "drawn"),
    [
        ([(-62135596800.0, 0.5)], 1),
        ([(-62135596800.0, 0.5), (253402300799.0, 0.5)], 2),
        ([(0.0, 0.0), (0.0, 0.0)], 2),
        ([(0.0, 1e-300), (1e-6, 2e-300)], 2),
        ([(0.0, 1e308), (1.0, float("nan")), (2.0, 0.5)], 1),
        ([(0.0, float("inf"))], 0),
        ([(float(hour), 0.5) for hour in range(501)], 0),
    ],
    ids=["year 1", "all years", "nothing", "next to nothing", "claims", "endless", "very many"],
)
def test_whatever_a_receipt_claims_is_drawn_or_left_out(points: list[tuple[float, float]], drawn: int) -> None:
    """Dates of any year and numbers of any size make no chart that fails or warns; many points are a line alone."""
    chart = line_chart({"soil": points}, "Share", "%")
    assert (chart.drawing or "").count("<use") == drawn
    assert (chart.drawing is None) == (drawn == 0 and len(points) == 1)


@pytest.mark.parametrize(
    ("settings", "looked"),
    [
        ({"visit": "2026-06-21T09:30:00Z", "scene": "farm", "day": 130}, "2026-06-21 09:30"),
        ({"visit": "second", "scene": "farm", "day": 130}, "2026-05-10 11:00"),
        ({"scene": "farm", "day": 172, "hour": 13.5}, "2026-06-21 13:30"),
        ({"scene": "field.png", "day": 130}, "2026-11-22 08:00"),
        ({"scene": "farm", "day": None}, "2026-11-22 08:00"),
        ({"scene": "farm", "day": 10**9}, "2026-11-22 08:00"),
    ],
)
def test_a_look_has_the_date_of_the_look(settings: dict[str, Any], looked: str) -> None:
    """By its visit's name, by the farm's day; the clock is asked last, when the survey began."""
    receipt = {"settings": settings, "started": "2026-11-22T08:00:00Z"}
    run = Run(Path("x"), {"created": "2026-11-23T00:00:00Z"}, receipt, None, frozenset())
    found = look_of(run)
    assert found is not None
    assert f"{found:%Y-%m-%d %H:%M}" == looked


def test_rare_classes_have_a_scale_of_their_own() -> None:
    """A class of two thousandths fills its chart as one of half the field does; all charts have the same dates."""
    moments = ("2026-05-10T00:00:00Z", "2026-06-21T00:00:00Z")
    rows = [
        {"run": "runs/x", "created": at, "looked": at, "unit": "share", "colours": {},
         "areas": {"soil": 0.5, "weed": weed}, "savings": {"capture_s": 0.5}, "miou": None, "overall_accuracy": None,
         "capture_seconds": {"done": None, "full": None}}
        for at, weed in zip(moments, (0.001, 0.002), strict=True)
    ]  # fmt: skip
    page = render_history(FieldHistory("north", "archive", rows), "")
    weed = page.partition('aria-label="weed"')[2].partition("</svg>")[0]
    assert ">0.2 %<" in weed
    assert ">0.2 %<" not in page.partition('aria-label="soil"')[2].partition("</svg>")[0]
    assert re.findall(r">(2026[^<]*)<", weed)


def test_two_visits_of_one_second_are_both_counted() -> None:
    """Published or looked at in the same moment they stand in the order that they came in."""
    runs = [{"created": "2026-06-21T11:00:00Z", "capture_seconds": {"done": done, "full": 9.0}} for done in (3.0, 2.0)]
    summed = _summed_seconds(runs)
    assert [seconds for _, seconds in summed["these visits"]] == [3.0, 5.0]
