"""The receipt: complete, in order and valid JSON; shown as a table and as a page."""

from __future__ import annotations

import base64
import io
import json
import re
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from spectralzoom.flows.publish.field_map import RIGHT_RGB, WRONG_RGB, FieldMap, error_address
from spectralzoom.flows.publish.receipt import CAPTURE_COSTS, Receipt, build_receipt, check_receipt
from spectralzoom.flows.publish.receipt_table import format_score, headline, print_summary, saving_rows
from spectralzoom.flows.publish.report import render_report
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.terminal.figures import format_area
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.storage.whole_files import to_json
from tests.flows.conftest import Page

PNG = b"\x89PNG\r\n\x1a\nnot a real picture"


def scored(miou: float, overall: float, **per_class: float | None) -> dict[str, object]:
    """Return the scores of a map without false classes."""
    return {"miou": miou, "overall_accuracy": overall, "per_class_iou": per_class, "false_classes": {}}


def make_receipt(*, wall: float = 1.5, labels: bool = True) -> Receipt:
    """Return a receipt with made-up figures that has every field of the design."""
    saving = {"done": 50, "full": 100, "ratio": 0.5, "full_is": "predicted"}
    savings: dict[str, object] = {name: dict(saving) for name in ("multiply_adds", "patches", *reversed(CAPTURE_COSTS))}
    savings["multiply_adds"] = {**saving, "overview": 20, "score": 1, "detail": 29}
    savings["capture_s"] = {"done": 104.0, "full": 209.0, "ratio": 104 / 209, "full_is": "predicted"}
    accuracy = {  # the map shows wheat, but the labels have none
        "miou": np.float32(0.75),
        "overall_accuracy": 0.934,
        "per_class_iou": {"soil": 0.9, "bare_weed": 0.6, "wheat": float("nan")},
        "false_classes": {"wheat": 2},
    }
    control = {
        **{"scan": "every 2nd line, 25 ms", "capture_s": 103.0, "kept": 1_200_000, "multiply_adds": 40},
        **scored(0.7, 0.912, soil=0.8, bare_weed=0.5, wheat=None),
    }
    row = {
        **{"name": "shot", "state": "on", "variant": "exact", "bound": 0.0, "cost_ns": 3.9, "reason": "asked"},
        **{"left_out": 0.5, "magnitude": "shot noise", "unit": "sigma"},
    }
    total = {
        **{"asked": "auto", "tolerance": 0.1, "unit": "sigma", "bound": 0.08, "within": True, "on": 1, "off": 0},
        "saved_s": 7.5,
    }
    costs = {"wall_s": wall, "cpu_s": wall, "peak_rss_bytes": 10**9, "bytes_in": 0, "bytes_out": 10**8}
    stages = [
        {"name": "capture", "key": "ab12", "state": "ran", **costs},
        {"name": "rectify", "key": "cd34", "state": "cached", **dict.fromkeys(costs)},
    ]
    return build_receipt(
        survey="farm",
        source="sim",
        scene="farm@1",
        seed=7,
        started=f"2026-06-01T08:00:{wall:04.1f}Z",
        finished=f"2026-06-01T09:00:{wall:04.1f}Z",
        versions={"torch": "2.13.0"},
        settings=Settings().to_dict(),
        stages=stages,
        savings=savings,
        data_bytes={**{"captured": 2_000_000, "written": 7_000_000, "kept": 1_500_000}, "reference": 4_000_000},
        products={"quicklook": f"runs/{wall}/quicklook.png"},
        accuracy=accuracy if labels else None,
        control=control if labels else None,
        effects=[row],
        effects_total=total,
        areas={"px": {"soil": 1, "bare_weed": 0}},
        zones={},
    )


def page_of(receipt: Receipt) -> str:
    """Return the report of a receipt, with an empty map."""
    return render_report(receipt, PNG, FieldMap((2, 2), [], []))


def test_receipt_has_the_fields_of_the_design_and_reads_back():
    """Fields are in order, with accuracy or without; non-finite numbers become null, and JSON reads back equal."""
    receipt = make_receipt()
    before = "survey source scene seed started finished versions settings stages savings data_bytes accuracy control"
    assert " ".join(receipt) == f"{before} effects effects_total areas products"
    assert set(receipt["savings"]) == {*CAPTURE_COSTS, "patches", "multiply_adds"}
    assert "accuracy" not in make_receipt(labels=False)
    assert check_receipt(json.loads(to_json(receipt))) == receipt
    text = to_json({"nan": float("nan"), "list": [np.float64("inf"), np.int64(3)], "tuple": (1.5, None, True)})
    assert json.loads(text) == {"nan": None, "list": [None, 3], "tuple": [1.5, None, True]}
    assert receipt["accuracy"]["per_class_iou"] == {"soil": 0.9, "bare_weed": 0.6, "wheat": None}


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        (("versions",), None),
        (("stages", 0, "key"), None),
        (("savings", "multiply_adds"), None),
        (("data_bytes", "kept"), None),
        (("savings", "lines", "full_is"), None),
        (("savings", "multiply_adds", "score"), None),
        (("control", "capture_s"), None),
        (("stages", 1, "state"), "done"),
        (("savings", "lines", "full_is"), "guessed"),
    ],
)
def test_invalid_fields_are_named(path, wrong):
    """A missing field has its place in the message; so have unknown states and origins of a figure."""
    broken: dict = dict(make_receipt())
    part = reduce(getitem, path[:-1], broken)
    if wrong is None:
        del part[path[-1]]
    else:
        part[path[-1]] = wrong
    with pytest.raises(ShapeError, match=path[-1] + (" is missing" if wrong is None else ": Input should be")):
        check_receipt(broken)


def test_the_uniform_scan_of_the_same_seconds_has_a_column() -> None:
    """Without a control, terminal and page have no column for it."""
    receipt = make_receipt()
    assert "uniform scan" in printed(receipt)
    assert "103 s" in page_of(receipt)
    del receipt["control"]
    assert not any("uniform scan" in text for text in (printed(receipt), page_of(receipt)))


def test_the_summary_says_what_was_captured_again() -> None:
    """Without a second pass there is no such sentence."""
    receipt = make_receipt()
    assert "Captured" not in printed(receipt)
    reason = "captured again: 10 % of the field, every line, 17 ms; expected gain 0.8 points above that of the rest"
    receipt["plan"] = {"kind": "lines", "reason": reason, "lines": 50, "seconds": 1.0, "place": "on the right"}
    told = "Captured again: 10 % of the field, every line, 17 ms, mostly on the right; expected gain 0.8 points"
    assert told in " ".join(printed(receipt).split())
    assert told in headline(receipt)[1]


def test_costs_stand_against_the_cheapest_good_scan() -> None:
    """With a table of scans its seconds and raw bytes are the reference, without one those of the full scan."""
    receipt = make_receipt()
    rows = {row["label"]: (row["full"], row["ratio"]) for row in saving_rows(receipt)}
    assert rows["capture time"] == ("209 s", 104 / 209)
    assert rows["bytes kept"] == ("4 MB", 1.5 / 4)
    receipt["scans"] = {"reference": {"seconds": 52.0, "bytes_raw": 3_000_000}}
    rows = {row["label"]: (row["full"], row["ratio"]) for row in saving_rows(receipt)}
    assert rows["capture time"] == ("52 s", 2.0)
    assert rows["bytes kept"] == ("3 MB", 0.5)


def test_the_pause_between_passes_has_a_row() -> None:
    """It is the wall time of the stages between them; there is none if one of them was found."""
    receipt = make_receipt()
    ran = {"state": "ran", "key": "ab12", "cpu_s": 1.0, "peak_rss_bytes": 1, "bytes_in": 1, "bytes_out": 1}
    between = [{"name": name, "wall_s": 1.5, **ran} for name in ("condense_coarse", "rectify", "score", "capture_fine")]
    receipt["stages"] = between
    assert "pause between passes 4.5 s" in " ".join(printed(receipt).split())
    between[1]["wall_s"] = None
    assert "pause" not in printed(receipt)


def printed(receipt: Receipt, width: int = 100, *, verbose: bool = False) -> str:
    """Return the end of a survey as a terminal of this width shows it."""
    console = Console(file=io.StringIO(), width=width)
    print_summary(receipt, console, verbose=verbose)
    return console.file.getvalue()


def test_the_summary_of_a_survey_fits_the_terminal():
    """Before the report's path, 15 lines of 80 columns give classes, score and costs against the reference."""
    receipt = make_receipt()
    hectares = {"water": 0.00476, "track": 0.00764, "tree": 0.00935, "weed": 0.0102, "wheat_b": 0.118}
    receipt["areas"] = {"ha": hectares, "place": dict.fromkeys(("water", "tree", "weed"), "at the top left")}
    receipt["savings"]["capture_s"] |= {"uniform": 40.0, "uniform_scan": "every line, 17 ms"}
    lines = printed(receipt, 80).rstrip().splitlines()
    assert len(lines) <= 15
    assert lines[0].startswith("Water 47.6 m² (3.2 % of the field), mostly at the top left; track 76.4 m²")
    assert max(map(len, lines)) <= 80
    told = ("capture time", "104 s", "209 s", "50 %", "bytes kept", "1.5 MB", "multiply-adds", "mIoU 75.0 of 100")
    for words in told:
        assert any(words in line for line in lines), words
    assert not any(words in line for line in lines for words in ("rectify", "torch", "shot", "samples"))
    assert [format_area(hectares) for hectares in (2.5, 0.1, 0.0999, 0.0012)] == ["2.5 ha", "0.1 ha", "999 m²", "12 m²"]


def test_the_details_have_stages_effects_and_lost_lines():
    """Each stage has a row, and lost lines one for each sweep."""
    receipt = {**make_receipt(), "lines": {"scan-0": {"invalid": 41}}}
    assert "sweep scan-0: lines left out: 41 invalid" in printed(receipt)
    text = printed(receipt, verbose=True)
    for words in ("samples on the field", "capture", "rectify", "Effects computed: 1 of 1"):
        assert words in text, words


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({}, "The score is not known: there are no labels."),
        ({"settings": {"accuracy": False}}, "The accuracy was left out; the same survey with --accuracy adds it"),
        ({"expected": {"miou": 0.94, "error": 0.02}}, "Expected mIoU 94.0 ± 2.0 of 100, estimated from the map's own"),
        ({"expected": {"miou": 0.94, "error": 0.4}}, "The score is not known: there are no labels."),
    ],
)
def test_a_map_without_labels_has_its_own_estimate(found: dict, words: str):
    """There is none if the error is too large."""
    text = format_score({**make_receipt(labels=False), **found})
    assert words in text
    assert ("mIoU" in text) == ("Expected" in words)


def test_headline_has_the_classes_and_the_figures():
    """The second paragraph has score, worst class and capture time; without labels it has no score."""
    assert headline(make_receipt()) == [
        "Soil 100 % of the field.",
        "mIoU 75.0 of 100 against the labels (93.4 % of pixels correct); the best uniform scan of the same"
        " seconds gives 70.0. The map's worst class is bare weed with 60.0."
        " Capture time: 104 s (50 % of the reference, 209 s).",
    ]
    assert "labels (" not in headline(make_receipt(labels=False))[1]


def test_page_loads_nothing_from_elsewhere():
    """Every address is data in the page, the quicklook has the given bytes; there are no imports or links."""
    page = page_of(make_receipt())
    loaded = Page(page).loaded
    assert len(loaded) == 1
    assert all(source.startswith("data:image/png;base64,") for source in loaded)
    assert not re.search(r"@import|url\(", re.sub("<script>.*?</script>", "", page, flags=re.DOTALL))
    assert base64.b64decode(loaded[0].partition(",")[2]) == PNG


def test_names_are_escaped():
    """Markup in the names of a survey, class and setting stays text."""
    receipt = make_receipt()
    bad = '<script>alert("1")</script>&'
    receipt["survey"] = receipt["settings"]["scene"] = receipt["settings"]["out"] = bad
    receipt["accuracy"]["per_class_iou"] = {bad: 0.5}
    receipt["accuracy"]["false_classes"] = {bad: 1}
    page = page_of(receipt)
    Page(page)
    assert page.count("&lt;script&gt;") >= 6


def test_page_has_the_figures_and_the_file_of_the_scene():
    """Map, savings and score come first. The scene has its file's name without folders, variable and hash."""
    receipt = make_receipt()
    receipt["scene"] = "9f86d081884c7d65"
    receipt["settings"]["scene"] = "/data/fields/north.mat:cube"
    page = page_of(receipt)
    figures = ("104 s", "50 %", "75.0", "93.4", "read in full", "70.0", "Class by class")
    for words in (*figures, "wheat 2 px", "2 of 3 classes are in the labels", "north.mat, source sim, seed 7"):
        assert words in page, words
    assert "9f86d081884c7d65" not in page
    order = (
        'class="lead">Soil 100 %',
        "mIoU 75.0",
        "<figure>",
        'id="field"',
        'id="savings"',
        'id="accuracy"',
        'id="files"',
    )
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    receipt = make_receipt(labels=False)
    receipt["survey"] = "field $title"
    page = page_of(receipt)
    Page(page)
    assert "<h2>Accuracy</h2>" not in page
    assert "field $title" in page


def test_the_cheapest_good_scan_is_named():
    """Its time and settings come from the scan performance of the weights; without it there is no such line."""
    receipt = make_receipt()
    assert "cheapest good uniform scan" not in printed(receipt)
    receipt["savings"]["capture_s"] |= {"uniform": 40.0, "uniform_scan": "every line, 17 ms"}
    told = " ".join(printed(receipt).split())
    assert "the cheapest good uniform scan (every line, 17 ms), stored as captured and read in full." in told


def test_a_report_has_the_confusion_matrix() -> None:
    """User's accuracy stands beside each mapped class, producer's below each label, then kappa; values by hand."""
    receipt = make_receipt()
    assert "Confusion matrix" not in page_of(receipt)
    receipt["accuracy"] |= {"confusion": [[8, 2, 1], [1, 6, 1], [0, 0, 0]], "kappa": 0.4875}
    page = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page_of(receipt)))
    assert "mapped as soil bare weed user's accuracy" in page.replace("&#39;", "'")
    rows = ("soil 8 1 88.9", "bare weed 2 6 75.0", "wheat 1 1 0.0", "producer's accuracy 72.7 75.0", "kappa: 0.487")
    for row in rows:
        assert row in page.replace("&#39;", "'"), row


def test_a_report_links_the_products() -> None:
    """Links are relative to its folder and escaped; raw lines, which may be cleared, and the report have none."""
    receipt = make_receipt()
    receipt["products"] = {
        **{"raw_coarse": "stages/capture/ab/lines", "class_map": "stages/segment/cd/class_map.zarr"},
        **{"receipt.json": "runs/north #1/receipt.json", "report.html": "runs/north #1/report.html"},
    }
    page = page_of(receipt)
    assert Page(page).links == ["../../stages/segment/cd/class_map.zarr", "receipt.json"]
    assert "spectralzoom export archive &#39;north #1&#39; -o maps" in page


def test_an_error_map_shows_where_map_and_labels_differ() -> None:
    """Pixels are right, wrong, or transparent without label or class."""
    classes, labels = np.array([[0, 1], [2, 255]], np.uint8), np.array([[0, 0], [255, 1]], np.uint8)
    address = error_address(classes, labels)
    with Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))) as opened:
        shown = np.asarray(opened.convert("RGBA"))
    assert tuple(shown[0, 0]) == (*RIGHT_RGB, 255)
    assert tuple(shown[0, 1]) == (*WRONG_RGB, 255)
    assert shown[1, :, 3].tolist() == [0, 0]
