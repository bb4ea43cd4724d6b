"""The map of a report, in a real browser: what is under the pointer, spectra, layers, swipe, keys, phone and paper."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flows.publish.field_map import FieldMap, SweepShown
from flows.publish.page_data import PagePlaces, grey_png, page_spectra
from flows.publish.report import Picture, render_report
from tests.flows.publish.test_receipt import make_receipt
from tests.users.browser import Tab, chromium, needs_browser

pytestmark = needs_browser

HEIGHT, WIDTH, FACTOR = 48, 64, 4
BAD = '<img src=x onerror="document.title=1">\u202e</script>'
NM = np.array([450.0, 550.0, 650.0, 750.0, 850.0])
MOSAIC = np.random.default_rng(0).uniform(0.1, 0.9, (HEIGHT // FACTOR, WIDTH // FACTOR, 5)).astype(np.float32)
READY = "document.getElementById('field').dataset.ready"


def known_map() -> FieldMap:
    """Soil on the left, crop on the right, a corner without a class; everything that a report can have."""
    classes = np.zeros((HEIGHT, WIDTH), np.uint8)
    classes[:, WIDTH // 2 :] = 1
    classes[:4, :4] = 255
    confidence = np.full((HEIGHT, WIDTH), 0.87, np.float32)
    confidence[:4, :4] = np.nan
    seats = np.zeros((6, 8), bool)
    seats[1, 1] = True
    lattice = np.stack(np.meshgrid(np.linspace(52, 51, 3), np.linspace(9, 11, 3), indexing="ij")[::-1], axis=-1)
    return FieldMap(
        names=("soil", f"crop{BAD}"),
        colours=np.array([[120, 80, 40], [20, 200, 60]]),
        classes=classes,
        picture=np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
        picture_words="True colour",
        patch_px=8,
        confidence=confidence,
        truth=1 - np.minimum(classes, 1),
        before=np.ones_like(classes),
        before_words="3.0 days earlier",
        changed=np.where(seats, 0.5, 0.0),
        age_days=np.full((HEIGHT, WIDTH), 3.0, np.float32),
        seats=seats,
        sweeps=[SweepShown((8, 16, 0, WIDTH), "fine", f"fine sweep 2 of 2{BAD}")],
        spectra=page_spectra([MOSAIC], MOSAIC.shape, NM, FACTOR),
        places=PagePlaces("EPSG:32632", 1024 * lattice, lattice),
    )


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """One browser for all tests of this file."""
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a map that is known by heart."""
    receipt = make_receipt()
    receipt["survey"] = f"field{BAD}"
    picture = quicklook_like()
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_report(receipt, picture, [Picture(picture, "a picture")], field=known_map()), "utf-8")
    return path


def quicklook_like() -> bytes:
    """A picture of the size of a quicklook."""
    return grey_png(np.full((1400, 1800), 128, np.uint8))


@pytest.fixture
def opened(tab: Tab, page: Path) -> Tab:
    """The report on a desk."""
    tab.open(page, ready=READY)
    return tab


def place(tab: Tab, y: float, x: float) -> tuple[float, float]:
    """Where a pixel of the field is seen in the window."""
    tab.centre("#map")
    box = tab.run(
        "(() => { const one = document.querySelector('.leaflet-classes-pane canvas').getBoundingClientRect();"
        "return [one.x, one.y, one.width, one.height]; })()"
    )
    return box[0] + (x + 0.5) / WIDTH * box[2], box[1] + (y + 0.5) / HEIGHT * box[3]


def text(tab: Tab, name: str) -> str:
    """What an element says."""
    return str(tab.run(f"document.getElementById('{name}').textContent"))


def test_the_pointer_tells_class_probability_and_place(opened: Tab) -> None:
    """Also the truth, what was before, the sweep and longitude and latitude; words of data are words."""
    opened.mouse("Moved", *place(opened, 12, 10))
    opened.wait("readout.textContent.startsWith('x 10, y 12')")
    said = text(opened, "readout")
    shown = BAD.replace("\u202e", "\\u202e")
    assert "soil (87 %)" in said
    assert f"truth: crop{shown}" in said
    assert "50 % of this place changed" in said
    assert "looked at 3.0 days ago" in said
    assert f"fine sweep 2 of 2{shown}" in said
    lat, lon = 52 - 12.5 / HEIGHT, 9 + 2 * 10.5 / WIDTH
    assert f"{lat:.7f}° N, {lon:.7f}° E ({1024 * lon:.2f}, {1024 * lat:.2f})" in said
    opened.mouse("Moved", *place(opened, 1, 1))
    opened.wait("readout.textContent.startsWith('x 1, y 1')")
    assert "no class" in text(opened, "readout")


def test_a_click_draws_the_spectrum_of_the_place(opened: Tab) -> None:
    """Beside the mean of each class, in its colour; the values are those of the mosaic to half a step."""
    opened.click(*place(opened, 30, 50))
    opened.wait("document.querySelector('#spectrum .here')")
    found = np.array(opened.run("field.spectrum(30, 50)"))
    step = (MOSAIC.max(axis=(0, 1)) - MOSAIC.min(axis=(0, 1))) / 254
    assert (np.abs(found - MOSAIC[30 // FACTOR, 50 // FACTOR]) <= 0.51 * step).all()
    lines = opened.run(
        "[...document.querySelectorAll('#spectrum path.mean')]"
        ".map((one) => [one.dataset.name, one.getAttribute('stroke')])"
    )
    assert [stroke for _, stroke in lines] == ["rgb(120 80 40)", "rgb(20 200 60)"]  # that of the place's class on top
    assert lines[0][0].startswith("mean of soil, ")
    means = np.array(opened.run("field.facts.spectra.means[1]"))
    assert np.allclose(means, MOSAIC[:, 8:].mean(axis=(0, 1)), atol=step.max())
    label = opened.run("document.querySelector('#spectrum svg').getAttribute('aria-label')")
    assert label.startswith("spectrum at x 50, y 30, mapped as crop")
    assert "2 classes" in label


def test_layers_are_switched_and_faded(opened: Tab) -> None:
    """What is off is not on the map; a slider makes its layer see-through; every layer is there."""
    shown = "(key) => { const one = document.querySelector(`.leaflet-${key}-pane`); return one.children.length; }"
    keys = ["sweeps", "seats", "changed", "age", "before", "truth", "confidence", "classes", "colour"]
    assert opened.run("[...document.querySelectorAll('[data-layer]')].map((one) => one.dataset.layer)") == keys
    assert [opened.run(f"({shown})('{key}')") for key in keys[:-2]] == [0] * 7
    opened.run("document.querySelectorAll('[data-layer]').forEach((one) => one.checked || one.click())")
    assert all(opened.run(f"({shown})('{key}')") for key in keys)
    opened.run("document.querySelector('[data-layer=classes]').click()")
    assert opened.run(f"({shown})('classes')") == 0
    slider = "document.querySelector('[data-opacity=truth]')"
    opened.run(f"{slider}.value = 30, {slider}.dispatchEvent(new Event('input'))")
    assert opened.run("document.querySelector('.leaflet-truth-pane').style.opacity") == "0.3"


def test_classes_are_switched_in_the_legend(opened: Tab) -> None:
    """A class that is off is see-through on the map, and its mean is not drawn."""
    colour = "(x) => [...field.numbers.classes.canvas.getContext('2d').getImageData(x, 30, 1, 1).data]"
    assert opened.run(f"({colour})(10)") == [120, 80, 40, 255]
    assert opened.run(f"({colour})(50)") == [20, 200, 60, 255]
    opened.run("document.querySelector('[data-class=\"0\"]').click()")
    assert opened.run(f"({colour})(10)")[3] == 0
    opened.click(*place(opened, 30, 10))
    opened.wait("document.querySelector('#spectrum .here')")
    assert opened.run("document.querySelectorAll('#spectrum path.mean').length") == 1


@pytest.mark.parametrize("by", ["mouse", "touch", "arrows"])
def test_the_swipe_moves(tab: Tab, page: Path, by: str) -> None:
    """The map of before ends where the handle stands, whoever moved it."""
    tab.open(page, (800, 900), ready=READY, touch=by == "touch")
    tab.run("document.querySelector('[data-layer=before]').click()")
    cut = "parseFloat(document.querySelector('.leaflet-before-pane').style.clipPath.split(',')[1])"
    before, (x, y) = tab.run(cut), tab.centre("#map-swipe")
    if by == "mouse":
        tab.drag((x, y), (x + 100, y))
    elif by == "touch":
        tab.swipe((x, y), (x + 100, y))
    else:
        tab.run("document.getElementById('map-swipe').focus()")
        for _ in range(10):
            tab.key("ArrowRight", 39)
    tab.wait(f"{cut} > {before}")
    moved = tab.run(cut) - before
    line = tab.run("parseFloat(document.getElementById('map-line').style.left)")
    wide = tab.run("document.getElementById('map').clientWidth")
    assert moved == pytest.approx((line - 50) / 100 * wide, abs=1.5)
    if by != "arrows":
        assert moved == pytest.approx(100, abs=8)


def test_keys_move_the_map_and_read_it(opened: Tab) -> None:
    """Plus zooms, an arrow pans, Enter draws the spectrum of the middle."""
    opened.run("document.getElementById('map').focus()")
    zoom = opened.run("field.map.getZoom()")
    opened.key("Enter", 13)
    opened.wait("document.querySelector('#spectrum .here')")
    assert text(opened, "readout").startswith(f"x {WIDTH // 2}, y {HEIGHT // 2}")
    opened.key("+", 187)
    opened.wait(f"field.map.getZoom() > {zoom}")
    middle = opened.run("field.map.getCenter().lng")
    opened.key("ArrowRight", 39)
    opened.wait(f"field.map.getCenter().lng > {middle}")


def test_on_a_phone_nothing_is_cut(tab: Tab, page: Path) -> None:
    """The page is as wide as the window, scores are seen without scrolling, a touch draws the spectrum."""
    tab.open(page, (390, 844), ready=READY, touch=True)
    assert tab.run("document.documentElement.scrollWidth") == 390
    outside = "(one) => one.getBoundingClientRect().right > 390"
    judged = "[...document.querySelectorAll('section')].find((one) => one.textContent.includes('How good'))"
    scores = f"{judged}.querySelectorAll('td')"
    assert tab.run(f"[...{scores}].length") > 10
    assert not tab.run(f"[...{scores}].some({outside})")
    tab.tap(*place(tab, 30, 50))
    tab.wait("document.querySelector('#spectrum .here')")
    assert tab.run("document.querySelector('#spectrum svg').getBoundingClientRect().right") <= 390


def test_on_paper_nothing_is_cut(opened: Tab) -> None:
    """A picture stands for the map, no table is wider than the page, and pages are full."""
    opened.call("Emulation.setDeviceMetricsOverride", width=690, height=900, deviceScaleFactor=1, mobile=False)
    opened.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert (
            opened.run("getComputedStyle(document.getElementById('map').parentElement.parentElement).display") == "none"
        )
        assert opened.run("document.getElementById('still').getBoundingClientRect().height") > 100
        wide = "[...document.querySelectorAll('.wide')].filter((one) => one.scrollWidth > one.clientWidth + 1).length"
        assert opened.run(wide) == 0
        assert opened.run("document.documentElement.scrollWidth") <= 690
    finally:
        opened.call("Emulation.setEmulatedMedia", media="")
    pages = re.findall(rb"/Type /Page\b", opened.pdf())
    assert 2 <= len(pages) <= 4


def test_nothing_is_loaded_and_nothing_of_the_data_runs(opened: Tab, page: Path) -> None:
    """But for the page's own scripts, which its policy names; nothing is asked of the network."""
    elsewhere = [one for one in opened.asked if not one.startswith(("data:image/", page.as_uri()))]
    assert elsewhere == []
    assert opened.troubles == []
    assert opened.run("document.title").startswith("field<img")
    opened.run(
        "document.body.append(Object.assign(document.createElement('script'), {textContent: 'document.title = 1'}))"
    )
    assert opened.run("document.title").startswith("field<img")
    assert any("Content Security Policy" in one for one in opened.troubles)


def test_a_browser_of_before_shows_a_picture(tab: Tab, page: Path) -> None:
    """One that cannot unpack the map has its picture and legend, and no empty frame."""
    added = tab.call("Page.addScriptToEvaluateOnNewDocument", source="delete globalThis.DecompressionStream")
    try:
        tab.open(page)
    finally:
        tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert tab.run("document.getElementById('still').getBoundingClientRect().height") > 100
    assert tab.run("document.querySelector('.stage').getBoundingClientRect().height") == 0
    assert tab.run("document.querySelector('.legend').getBoundingClientRect().height") > 10
    assert tab.troubles == []
