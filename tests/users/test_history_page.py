"""The history of a field in a real browser: its player, two visits beside each other, dates of the looks, phone."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.archive.history import read_histories, render_history
from flows.publish.page_data import NOTHING
from storage.archive.archive import Archive
from storage.arrays.class_maps import load_class_map
from storage.arrays.mosaics import load_mosaic
from tests.conftest import Survey
from tests.remembered_work import without_effects
from tests.users.browser import Tab, chromium, needs_browser

pytestmark = needs_browser

BAD = '<script>alert("1")</script>&\u202e'
FIRST, LATER = f"first {BAD}", "2126-06-04T10:00:00Z"
SHOWN = FIRST.replace("\u202e", "\\u202e")


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> Path:
    """An archive of two visits, of which the second remembers the first."""
    out = tmp_path_factory.mktemp("field") / "archive"
    with without_effects():
        for visit, prior in ((FIRST, None), (LATER, "latest")):
            survey_png(out, name="north", visit=visit, prior=prior)
    return out


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """One browser for all tests of this file."""
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, field: Path) -> Path:
    """The history's page, the first visit under a name that means no good."""
    (north,) = read_histories(Archive.open(field))
    path = tmp_path_factory.mktemp("history") / "history.html"
    path.write_text(render_history(north, ""), "utf-8")
    return path


def text(tab: Tab, name: str) -> str:
    """What an element says."""
    return str(tab.run(f"document.getElementById('{name}').textContent"))


def test_the_visits_are_played(tab: Tab, page: Path) -> None:
    """The slider shows the visit that it stands at, and Play begins with the first."""
    tab.open(page)
    assert text(tab, "said").startswith("2126-06-04 10:00: ")
    assert not tab.run("document.getElementById('changes').hidden")
    tab.run("which.value = 0, which.dispatchEvent(new Event('input'))")
    assert text(tab, "said").startswith(SHOWN)
    assert text(tab, "said").endswith("a first look")
    assert tab.run("document.getElementById('changes').hidden")
    tab.run("which.value = 1, which.dispatchEvent(new Event('input'))")
    tab.click(*tab.centre("#play"))
    assert text(tab, "said").startswith(SHOWN)
    tab.wait("document.getElementById('said').textContent.startsWith('2126-06-04')")
    assert tab.troubles == []


@pytest.mark.parametrize("by", ["mouse", "touch", "arrows"])
def test_two_visits_are_swiped(tab: Tab, page: Path, by: str) -> None:
    """The left one ends at the handle, whoever moved it; each side shows the visit that was chosen."""
    tab.open(page, (800, 900), touch=by == "touch")
    left = "document.getElementById('left-map')"
    assert tab.run(f"{left}.src") != tab.run("document.getElementById('right-map').src")
    assert text(tab, "two").startswith(f"Left {SHOWN}, ")
    assert text(tab, "two").endswith(", right 2126-06-04 10:00.")
    x, y = tab.centre(".swipe-handle")
    if by == "arrows":
        tab.run("document.querySelector('.swipe-handle').focus()")
        for _ in range(10):
            tab.key("ArrowLeft", 37)
    else:
        (tab.drag if by == "mouse" else tab.swipe)((x, y), (x - 80, y))
    share = "Number(document.querySelector('.swipe-handle').value) / 1000"
    tab.wait(f"{share} < 0.45")
    cut = tab.run(f"parseFloat({left}.style.clipPath.split(' ')[1])")
    assert cut == pytest.approx(100 - 100 * tab.run(share))
    tab.run(
        "document.getElementById('left').value = 1, document.getElementById('left').dispatchEvent(new Event('change'))"
    )
    assert tab.run(f"{left}.src") == tab.run("document.getElementById('right-map').src")


def test_on_a_phone_and_on_paper_nothing_is_cut(tab: Tab, page: Path) -> None:
    """The page is as wide as the window; on paper both visits stand side by side."""
    tab.open(page, (390, 844), touch=True)
    assert tab.run("document.documentElement.scrollWidth") == 390
    tab.open(page, (690, 900))
    tab.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert tab.run("document.documentElement.scrollWidth") <= 690
        sides = "['left-map', 'right-map'].map((one) => document.getElementById(one).getBoundingClientRect())"
        (left, right) = tab.run(f"{sides}.map((one) => [one.left, one.right])")
        assert left[1] <= right[0]
    finally:
        tab.call("Emulation.setEmulatedMedia", media="")


def test_a_report_of_a_run_shows_what_its_stores_hold(tab: Tab, field: Path) -> None:
    """Class, confidence, spectrum and memory of a place are those of class map, mosaic and the visit before."""
    run = sorted((field / "runs").iterdir())[-1]
    products = json.loads((run / "receipt.json").read_text())["products"]
    drawn, mosaic = load_class_map(field / products["class_map"]), load_mosaic(field / products["mosaic"])
    tab.open(run / "report.html", ready="document.getElementById('field').dataset.ready")
    assert tab.troubles == []
    before = load_class_map(field / _products_of(field, 0)["class_map"])
    for y, x in ((5, 7), (50, 100), (95, 127)):
        assert tab.run(f"field.at('classes', {y}, {x})") == drawn.classes[y, x]
        assert tab.run(f"field.at('before', {y}, {x})") == before.classes[y, x]
        assert tab.run(f"field.at('confidence', {y}, {x})") == round(100 * float(drawn.confidence[y, x]))
        values = mosaic.values[y // 4, x // 4][np.argsort(mosaic.wavelength_nm)]
        step = np.array(tab.run("field.facts.spectra.step"))
        assert (np.abs(np.array(tab.run(f"field.spectrum({y}, {x})")) - values) <= 0.51 * step).all()
        assert "days ago" in tab.run(f"field.words({y}, {x})")
    (still,) = [one for one in [tab.run("document.getElementById('still').src")] if one]
    with Image.open(io.BytesIO(base64.b64decode(still.partition(",")[2]))) as picture:
        assert (np.asarray(picture) == drawn.classes).all()
    assert tab.run("field.facts.sweeps.length") == len(tab.run("field.facts.sweeps")) > 1
    assert NOTHING == 255  # as the page's script has it


def _products_of(field: Path, number: int) -> dict[str, Any]:
    run = sorted((field / "runs").iterdir())[number]
    return dict(json.loads((run / "receipt.json").read_text())["products"])
