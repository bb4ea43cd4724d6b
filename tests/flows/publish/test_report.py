"""The report: self-contained, escaped, complete."""

from __future__ import annotations

import base64
import copy
from html.parser import HTMLParser

from flows.publish.report import Picture, render_report
from tests.flows.publish.test_receipt import make_receipt

PNG = b"\x89PNG\r\n\x1a\nnot a real picture"
VOID = {"meta", "img"}


class Tags(HTMLParser):
    """Checks that tags close in order and collects what would be loaded from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.seen: set[str] = set()

    def handle_starttag(self, tag, attrs):
        """Remember the tag and its addresses."""
        self.seen.add(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        """The innermost open tag must be the one that closes."""
        assert self.open.pop() == tag


def read(page: str) -> Tags:
    """Parse a page to its end."""
    tags = Tags()
    tags.feed(page)
    tags.close()
    assert not tags.open
    return tags


def test_page_loads_nothing_from_anywhere():
    """Every address in the page is data of the page; no script, no import, no link."""
    page = render_report(make_receipt(), PNG, [Picture(PNG, "spectra")])
    tags = read(page)
    assert len(tags.sources) == 2
    assert all(source.startswith("data:image/png;base64,") for source in tags.sources)
    assert not tags.seen & {"script", "link", "iframe"}
    assert "http" not in page
    assert "@import" not in page
    assert "url(" not in page


def test_picture_is_the_one_given():
    """The quicklook's bytes come back from the page."""
    source = read(render_report(make_receipt(), PNG)).sources[0]
    assert base64.b64decode(source.partition(",")[2]) == PNG


def test_words_are_escaped():
    """A survey, a class, a policy and a setting with markup in their names stay words."""
    receipt = copy.deepcopy(make_receipt())
    bad = '<script>alert("1")</script>&'
    receipt["survey"] = receipt["scene"] = receipt["settings"]["out"] = receipt["stages"][0]["name"] = bad
    receipt["versions"] = {bad: bad}
    receipt["accuracy"]["per_class_iou"] = {bad: 0.5}
    receipt["accuracy"]["false_classes"] = {bad: 1}
    receipt["accuracy"]["controls"] = {bad: {"miou": 0.5, "spread": None}}
    receipt["effects"][0]["why"] = bad
    page = render_report(receipt, PNG, [Picture(PNG, bad + '" onload="x')])
    assert "script" not in read(page).seen
    assert '" onload="' not in page
    assert page.count("&lt;script&gt;") >= 11


def test_page_has_the_figures():
    """Savings, accuracy with its controls, settings and versions are on the page."""
    page = render_report(make_receipt(), PNG, looked_twice=0.23)
    figures = ("104 s", "predicted", "50 %", "75.0", "93.4", "56.2 ± 1.2", "67 %", "budget", "torch", "Class by class")
    for words in (*figures, "this survey wheat 2 px", "2 of 3 classes are in the truth"):
        assert words in page, words


def test_page_without_labels_has_no_accuracy():
    """Without a truth the page says nothing about accuracy, and dollar signs of names survive the template."""
    receipt = make_receipt(labels=False)
    receipt["survey"] = "field $title"
    page = render_report(receipt, PNG)
    read(page)
    assert "How good the map is" not in page
    assert "field $title" in page
