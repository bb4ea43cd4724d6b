"""The map of a report in a real browser: layers, keys, phone and paper; the page runs no script from the data."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spectralzoom.flows.publish.field_map import FieldMap, MapLayer, layer_address
from spectralzoom.flows.publish.report import LEAFLET, render_report
from tests.flows.publish.test_receipt import make_receipt
from tests.users.browser import Tab, chromium, needs_browser

HEIGHT, WIDTH = 48, 64
BAD = '<img src=x onerror="document.title=1">\u202e</script>'
READY = "document.getElementById('field').dataset.ready"
BOXES = "[...document.querySelectorAll('.leaflet-control-layers-overlays input')]"
SHOWN = "document.querySelectorAll('#map .leaflet-overlay-pane img').length"
SHA256 = {
    f"{LEAFLET}/leaflet.js": "db49d009c841f5ca34a888c96511ae936fd9f5533e90d8b2c4d57596f4e5641a",
    f"{LEAFLET}/leaflet.css": "a7837102824184820dfa198d1ebcd109ff6d0ff9a2672a074b9a1b4d147d04c6",
    f"{LEAFLET}/LICENSE": "53e8dc25862014e4324741ca18fbe3611e11d42ef69f59f86ea8c5389647d4cb",
}


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """Yield one browser tab for all tests of this file."""
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the report of a known map with three layers and malicious HTML in its texts; return its path."""
    numbers = np.zeros((HEIGHT, WIDTH), np.uint8)
    numbers[:, WIDTH // 2 :] = 1
    shown = layer_address(numbers, np.array([[120, 80, 40], [20, 200, 60]], np.uint8))
    layers = [MapLayer("True colour", shown, shown=True), MapLayer("Class map", shown, shown=True)]
    layers.append(MapLayer("Truth", shown, opacity=0.5))
    classes = [{"name": f"crop{BAD}", "fraction": "50 %", "colour": "#14c83c"}]
    ramps = [{"name": "confidence", "low": "0.6", "high": "1"}]
    field = FieldMap((WIDTH, HEIGHT), layers, classes, ramps, pixel_m=0.25)
    receipt = make_receipt()
    receipt["survey"] = f"field{BAD}"
    file = io.BytesIO()
    Image.new("L", (1800, 1400), 128).save(file, "PNG")
    picture = file.getvalue()
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_report(receipt, picture, field), "utf-8")
    return path


@pytest.fixture
def opened(tab: Tab, page: Path) -> Tab:
    """Open the report in a window of desktop size."""
    tab.open(page, ready=READY)
    return tab


@needs_browser
def test_layers_are_switched_on_and_off(opened: Tab) -> None:
    """A layer that is off is not on the map; the truth is drawn with opacity 0.5."""
    assert opened.run(f"{BOXES}.map((one) => one.checked)") == [True, True, False]
    assert opened.run(SHOWN) == 2
    opened.run(f"{BOXES}.filter((one) => !one.checked).forEach((one) => one.click())")
    assert opened.run(SHOWN) == 3
    assert opened.run("document.querySelector('#map img[alt=Truth]').style.opacity") == "0.5"


@needs_browser
def test_the_slider_fades_the_layers_over_the_picture(opened: Tab) -> None:
    """Each layer keeps its own opacity times that of the slider; the picture below stays."""
    opened.run("Object.assign(document.getElementById('opacity'), {value: 40}).dispatchEvent(new Event('input'))")
    assert opened.run("[...document.querySelectorAll('#map img')].map((one) => one.style.opacity)") == ["", "0.4"]


@needs_browser
def test_the_scale_bar_has_the_length_on_the_ground(opened: Tab) -> None:
    """It is at most 150 px long, and a pixel of the field is 0.25 m."""
    words, long, field = opened.run(
        "[bar.textContent, bar.style.width, document.querySelector('#map img').getBoundingClientRect().width]"
    )
    assert float(words.removesuffix(" m")) == pytest.approx(
        0.25 * WIDTH / field * float(long.removesuffix("px")), rel=0.02
    )
    assert float(long.removesuffix("px")) <= 150


@needs_browser
def test_keys_move_the_map(opened: Tab) -> None:
    """The plus key zooms in, and the right arrow pans."""
    opened.run("document.getElementById('map').focus()")
    zoom = opened.run("map.getZoom()")
    opened.key("+", 187)
    opened.wait(f"map.getZoom() > {zoom}")
    middle = opened.run("map.getCenter().lng")
    opened.key("ArrowRight", 39)
    opened.wait(f"map.getCenter().lng > {middle}")


@needs_browser
@pytest.mark.parametrize("width", [900, 1024, 1100, 1440])
def test_savings_fit_and_layers_are_closed(tab: Tab, page: Path, width: int) -> None:
    """All columns fit into their card, and the closed layer box is less than 100 px wide."""
    tab.open(page, (width, 900), ready=READY)
    assert tab.run(
        "[...document.querySelectorAll('#savings .wide')].every((one) => one.scrollWidth <= one.clientWidth)"
    )
    assert tab.run("document.querySelector('.leaflet-control-layers').offsetWidth") < 100


@needs_browser
def test_the_report_fits_a_phone(tab: Tab, page: Path) -> None:
    """The page is 390 px wide like the window, and scores are visible without scrolling."""
    tab.open(page, (390, 844), ready=READY, touch=True)
    assert tab.run("document.documentElement.scrollWidth") == 390
    outside = "(one) => one.getBoundingClientRect().right > 390"
    scores = "document.querySelectorAll('#accuracy td')"
    assert tab.run(f"[...{scores}].length") > 6
    assert not tab.run(f"[...{scores}].some({outside})")


@needs_browser
def test_the_report_fits_paper(opened: Tab) -> None:
    """The quicklook replaces the map, no table is wider than the page, and the PDF has 2 to 4 pages."""
    opened.call("Emulation.setDeviceMetricsOverride", width=690, height=900, deviceScaleFactor=1, mobile=False)
    opened.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert opened.run("getComputedStyle(document.getElementById('map')).display") == "none"
        wide = "[...document.querySelectorAll('.wide')].filter((one) => one.scrollWidth > one.clientWidth + 1).length"
        assert opened.run(wide) == 0
        assert opened.run("document.documentElement.scrollWidth") <= 690
    finally:
        opened.call("Emulation.setEmulatedMedia", media="")
    assert 2 <= len(re.findall(rb"/Type /Page\b", opened.pdf())) <= 4


@needs_browser
def test_the_page_loads_nothing_and_runs_no_foreign_script(opened: Tab, page: Path) -> None:
    """The content security policy allows only the page's own scripts; there is no network request."""
    elsewhere = [one for one in opened.asked if not one.startswith(("data:image/", page.as_uri()))]
    assert elsewhere == []
    assert opened.troubles == []
    assert opened.run("document.title").startswith("field<img")
    opened.run(
        "document.body.append(Object.assign(document.createElement('script'), {textContent: 'document.title = 1'}))"
    )
    assert opened.run("document.title").startswith("field<img")
    assert any("Content Security Policy" in one for one in opened.troubles)


def test_the_bundled_leaflet_is_unchanged() -> None:
    """Each of its files has the SHA-256 of the published release."""
    for name, known in SHA256.items():
        assert name.startswith(LEAFLET)
        assert hashlib.sha256(files("spectralzoom.flows.publish").joinpath(name).read_bytes()).hexdigest() == known
