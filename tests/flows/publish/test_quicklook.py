"""The quicklook: a readable PNG for any size, and its parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from flows.publish import panels, quicklook
from flows.publish.panels import class_rgb, outline
from flows.publish.quicklook import QuicklookData, _draw_attention, draw_quicklook
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.mosaics import choose_bands

WAVES = np.linspace(400, 1000, 61)


def make_data(height: int, width: int, *, patch: int = 16) -> QuicklookData:
    """Return a small survey of noise with every optional part."""
    rng = np.random.default_rng(0)
    rows, columns = -(-height // (4 * patch)) * 4, -(-width // (4 * patch)) * 4
    return QuicklookData(
        survey="a field $with_marks$ & <signs>",
        seed=1,
        about="budget 0.5",
        policy="entropy",
        rectified=rng.random((height, width, 3), np.float32),
        caption="true colour, 640 / 550 / 460 nm",
        score=rng.random((rows, columns)),
        patch_px=patch,
        patch_index=np.array([0, 1], np.intp),
        blocks=((0, min(patch, height), 0, width),),
        class_map=rng.integers(0, 3, (height, width)).astype(np.uint8),
        class_names=("soil", "sugar_beet", r"$\weeds_{$"),
        class_colours=np.array([[140, 94, 60], [0, 158, 115], [200, 30, 90]], np.uint8),
        truth=rng.integers(0, 3, (height, width)).astype(np.uint8),
        confidence=rng.random((height, width), np.float32),
    )


@pytest.mark.parametrize(("height", "width"), [(96, 128), (20, 300), (300, 20), (1, 1)])
def test_picture_has_a_readable_size(tmp_path: Path, height, width):
    """Any proportions give 1200 to 1800 x 600 to 2000 px, also with letters that the font lacks."""
    data = replace(make_data(height, width), class_names=("soil", "甜菜", r"$\weeds_{$"))
    (tmp_path / "q.png").write_bytes(draw_quicklook(data))
    with Image.open(tmp_path / "q.png") as image:
        assert 1200 <= image.width <= 1800
        assert 600 <= image.height <= 2000


@pytest.mark.parametrize("score", [-np.inf, np.inf, 0.0])
def test_scores_without_a_range_are_drawn(score):
    """Scores that are all equal or infinite do not stop the picture."""
    data = make_data(64, 64)
    figure = Figure(figsize=(8, 6))
    _draw_attention(figure.add_subplot(), replace(data, score=np.full_like(data.score, score)))
    FigureCanvasAgg(figure).draw()


def test_pictures_need_no_optional_part_and_are_reproducible(tmp_path: Path):
    """Truth, patches, blocks and finite scores may be absent; the same data give the same bytes."""
    for name in ("one", "two"):
        (tmp_path / name).write_bytes(draw_quicklook(make_data(32, 48)))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    data = make_data(64, 64)
    empty = replace(
        data,
        truth=None,
        confidence=None,
        patch_index=np.array([], np.intp),
        blocks=(),
        score=np.full_like(data.score, np.nan),
        rectified=np.full_like(data.rectified, np.nan),
        class_map=np.full_like(data.class_map, 255),
    )
    (tmp_path / "empty.png").write_bytes(draw_quicklook(empty))
    (tmp_path / "confidence.png").write_bytes(draw_quicklook(replace(data, truth=None)))
    assert (tmp_path / "empty.png").stat().st_size > 10_000


def test_colours_of_bands_and_of_pixels_without_a_class():
    """Bands nearest to 640, 550 and 460 nm are shown in any order, else ends and middle; no class is grey."""
    assert choose_bands(WAVES)[0] == (24, 15, 6)
    order = np.random.default_rng(0).permutation(61)
    assert choose_bands(WAVES[order])[0] == tuple(np.argsort(order)[[24, 15, 6]])
    for waves, told in (
        (np.arange(1000.0, 2000.0, 100), ((9, 4, 0), "false colour, 1900 / 1400 / 1000 nm")),
        (np.array([660.0, 800.0]), ((1, 0, 0), "false colour, 800 / 660 / 660 nm")),
        (np.array([800.0]), ((0, 0, 0), "grey, 800 nm")),
    ):
        assert choose_bands(waves) == told
    picture = class_rgb(np.array([[0, 9, 255]], np.uint8), np.array([[230, 159, 0], [0, 158, 115]]))
    np.testing.assert_array_equal(picture[0, 1], picture[0, 2])
    assert (picture[0, 0] != picture[0, 1]).any()


def test_outline_is_the_border_of_the_patches():
    """Two neighbours have one common border of six sides, cut off at the edge of the scene."""
    chosen = np.zeros((3, 4), bool)
    chosen[0, 0] = chosen[0, 1] = True
    segments = np.array(outline(chosen, 10, (25, 15)))
    lengths = np.abs(segments[:, 1] - segments[:, 0]).sum(axis=1)
    assert lengths.sum() == 2 * (15 + 10)
    assert segments.min() == -0.5
    assert segments[..., 0].max() == 14.5


@pytest.mark.parametrize("confident", [True, False])
def test_a_uniform_scan_shows_the_confidence_of_its_map(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, confident):
    """It replaces the panel of lines that were captured again."""
    told: dict[str, str] = {}
    monkeypatch.setattr(quicklook, "_caption", lambda axes, title, text: told.update({title: text}))
    data = make_data(96, 128)
    data.class_map[:9] = data.truth[:9] = UNLABELLED
    confidence = data.confidence if confident else None
    (tmp_path / "q.png").write_bytes(draw_quicklook(replace(data, policy=None, blocks=(), confidence=confidence)))
    assert told["2  Confidence"] == ("of the model" if confident else "the map has none")
    assert told["4  Labels"].endswith(f"correct: {100 * (data.class_map == data.truth)[9:].mean():.1f} %")
    assert "2  Captured again" not in told


def test_a_later_visit_shows_the_changes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Changed pixels have the colours of today's classes, others are grey; the caption has their number and days."""
    words: list[tuple[str, str]] = []
    shown = Mock(wraps=quicklook._show)
    monkeypatch.setattr(quicklook, "_caption", lambda axes, title, text: words.append((title, text)))
    monkeypatch.setattr(quicklook, "_show", shown)
    data = make_data(96, 128)
    was = np.full((96, 128), 255, np.uint8)
    was[5:7, 10:20] = 1
    now = np.where(was == 255, data.class_map, 0).astype(np.uint8)
    (tmp_path / "picture.png").write_bytes(draw_quicklook(replace(data, was=was, days=7.0, class_map=now)))
    assert ("1  Captured, and differing from the prior map", "20 px have another class than 7 days before") in words
    changed = shown.call_args_list[0].args[2]
    assert (changed[was != 255] == np.float32(data.class_colours[0] / 255)).all()
    assert np.ptp(changed[was == 255], axis=-1).max() == 0


def test_class_colours_are_exact(tmp_path: Path) -> None:
    """Among many colours, a rare class and pixels without a class keep their colours."""
    data = make_data(96, 128)
    data.class_map[:3, :3] = 2
    data.class_map[3:6, :3] = 255
    (tmp_path / "q.png").write_bytes(draw_quicklook(replace(data, truth=None)))
    with Image.open(tmp_path / "q.png") as image:
        found = {colour for _, colour in image.convert("RGB").getcolors(2**24)}
    assert {(140, 94, 60), (0, 158, 115), (200, 30, 90), (219, 219, 214)} <= found


@pytest.mark.parametrize(("height", "width"), [(96, 128), (480, 300), (256, 64)])
def test_long_titles_stay_within_the_picture(height: int, width: int) -> None:
    """Titles and captions are wrapped, so none is cut off or overlaps the next panel."""
    with mpl.rc_context(quicklook._STYLE):
        data = replace(make_data(height, width), about="every line, 25 ms; " * 8, changed=True)
        FigureCanvasAgg(figure := quicklook._compose(data)).draw()
    assert figure._suptitle.get_window_extent().x1 <= figure.bbox.width
    for row in figure.subfigs:
        ends = [*(axes.bbox.x0 for axes in row.axes[1:]), figure.bbox.x1]
        for axes, end in zip(row.axes, ends, strict=True):
            assert all(one.get_window_extent().x1 <= end for one in (axes._left_title, *axes.texts))


def test_a_legend_of_long_names_stays_within_the_picture():
    figure = Figure(figsize=(15, 6), layout="constrained")
    names = tuple(f"buildings_grass_trees_and_drives_{number}" for number in range(16))
    colours = np.zeros((16, 3), np.uint8)
    quicklook._draw_legend(figure, replace(make_data(32, 32), class_names=names, class_colours=colours), 5)
    assert figure.legends[0].get_window_extent().width <= figure.bbox.width
    assert len(figure.legends[0].get_texts()) >= 16


def test_a_large_field_is_drawn_from_every_nth_pixel(monkeypatch: pytest.MonkeyPatch):
    """The map is thinned for the picture; the axes are those of the whole field."""
    monkeypatch.setattr(panels, "MOST_PX", 64)
    data = make_data(96, 128)
    given = {"rectified": data.rectified[::2, ::2], "confidence": None, "truth": None}
    with mpl.rc_context(quicklook._STYLE):
        drawn = [row.axes[0] for row in quicklook._compose(replace(data, **given)).subfigs]
    for axes in drawn:
        assert axes.images[0].get_array().shape[:2] == (48, 64)
        assert axes.get_xlim() == (-0.5, 127.5)
        assert tuple(axes.images[0].get_extent()) == (-0.5, 127.5, 95.5, -0.5)
