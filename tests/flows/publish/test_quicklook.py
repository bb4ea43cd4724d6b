"""The quicklook: a readable PNG for any size, and its parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from spectralzoom.flows.publish import quicklook
from spectralzoom.flows.publish.quicklook import (
    QuicklookData,
    _panels,
    draw_quicklook,
    palette_of,
    span_title,
    stretched,
)
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.mosaics import choose_bands

WAVES = np.linspace(400, 1000, 61)


def make_data(height: int, width: int) -> QuicklookData:
    """Return a small survey of noise with every optional part."""
    rng = np.random.default_rng(0)
    return QuicklookData(
        survey="a field $with_marks$ & <signs>",
        seed=1,
        about="budget 0.5",
        rectified=rng.random((height, width, 3), np.float32),
        caption="true colour, 640 / 550 / 460 nm",
        class_map=rng.integers(0, 3, (height, width)).astype(np.uint8),
        class_names=("soil", "sugar_beet", r"$\weeds_{$"),
        class_colours=np.array([[140, 94, 60], [0, 158, 115], [200, 30, 90]], np.uint8),
        confidence=rng.random((height, width), np.float32),
        again=np.arange(height * width).reshape(height, width) < width * height // 4,
        read=np.ones((height, width), bool),
        gain=rng.random((height, width), np.float32),
        truth=rng.integers(0, 3, (height, width)).astype(np.uint8),
    )


@pytest.mark.parametrize(("height", "width"), [(96, 128), (20, 300), (300, 20), (1, 1)])
def test_picture_has_a_readable_size(tmp_path: Path, height, width):
    """Any proportions give 1200 to 1800 x 600 to 2000 px, also with letters that the font lacks."""
    data = replace(make_data(height, width), class_names=("soil", "甜菜", r"$\weeds_{$"))
    (tmp_path / "q.png").write_bytes(draw_quicklook(data))
    with Image.open(tmp_path / "q.png") as image:
        assert 1200 <= image.width <= 1800
        assert 600 <= image.height <= 2000


def test_pictures_need_no_optional_part_and_are_reproducible(tmp_path: Path):
    """Truth, second pass and gain may be absent; the same data give the same bytes."""
    for name in ("one", "two"):
        (tmp_path / name).write_bytes(draw_quicklook(make_data(32, 48)))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    data = make_data(64, 64)
    empty = replace(
        data,
        truth=None,
        again=None,
        read=None,
        gain=None,
        confidence=np.full_like(data.confidence, np.nan),
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
    picture = palette_of(np.array([[230, 159, 0], [0, 158, 115]]))[np.array([[0, 9, 255]])]
    np.testing.assert_array_equal(picture[0, 1], picture[0, 2])
    assert (picture[0, 0] != picture[0, 1]).any()


def test_panels_show_the_second_pass_else_the_confidence() -> None:
    """Chosen pixels are coloured over grey; a uniform scan shows its confidence; labels have the correct pixels."""
    data = make_data(96, 128)
    data.class_map[:9] = data.truth[:9] = UNLABELLED
    shown = dict(_panels(data))
    again = shown["Captured again: 25 % of the field"]
    assert np.ptp(again[~data.again], axis=-1).max() == 0
    assert (again[data.again][:, 2] > again[data.again][:, 0]).all()
    assert "Read in full: the whole field" in shown
    right = 100 * (data.class_map == data.truth)[9:].mean()
    assert f"Labels: labelled pixels correct: {right:.1f} %" in shown
    uniform = [words.split(",")[0] for words, _ in _panels(replace(data, again=None, read=None, truth=None))]
    assert uniform == ["Field: true colour", "Expected gain", "Class map by the model", "Confidence"]


def test_values_are_stretched_over_their_own_range() -> None:
    """The title has both ends; values alike everywhere do not divide by zero."""
    values = np.append(np.linspace(0.6, 0.9, 101), np.nan)
    assert span_title("Confidence", values) == "Confidence, dark 0.6 to bright 0.9"
    shown = stretched(values)
    assert (shown[0], shown[100], np.isnan(shown[101])) == (0, 1, True)
    assert (stretched(np.full(3, 0.5)) == 0).all()


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
    """Titles and captions are wrapped, so none is cut off or overlaps the next panel; panels have one size."""
    with mpl.rc_context(quicklook.STYLE):
        data = replace(make_data(height, width), about="every line, 25 ms; " * 8)
        FigureCanvasAgg(figure := quicklook._compose(data)).draw()
    assert figure._suptitle.get_window_extent().x1 <= figure.bbox.width
    assert len({axes.get_position(original=True).size.round(9).tobytes() for axes in figure.axes}) == 1
    for axes in figure.axes:
        ends = [one.bbox.x0 for one in figure.axes if one.bbox.x0 > axes.bbox.x0 + 1]
        assert axes._left_title.get_window_extent().x1 <= min([*ends, figure.bbox.x1])


def test_a_legend_of_long_names_stays_within_the_picture():
    """It has the classes of the map and of the labels, and no others."""
    names = tuple(f"buildings_grass_trees_and_drives_{number}" for number in range(16))
    data = replace(make_data(32, 32), class_names=names, class_colours=np.zeros((16, 3), np.uint8))
    data.class_map[:] = 3
    data.truth[:] = np.arange(32) % 15
    with mpl.rc_context(quicklook.STYLE):
        figure = quicklook._compose(data)
    assert figure.legends[0].get_window_extent().width <= figure.bbox.width
    assert figure.legends[0].get_window_extent().y1 <= min(axes.bbox.y0 for axes in figure.axes)
    assert [one.get_text().split("  ")[0] for one in figure.legends[0].get_texts()] == [
        name.replace("_", " ") for name in names[:15]
    ]


def test_a_large_field_is_drawn_from_every_nth_pixel(monkeypatch: pytest.MonkeyPatch):
    """The map is thinned for the picture; the axes are those of the whole field."""
    monkeypatch.setattr(quicklook, "MOST_PX", 64)
    data = make_data(96, 128)
    given = {name: getattr(data, name)[::2, ::2] for name in ("rectified", "confidence", "again", "read", "gain")}
    with mpl.rc_context(quicklook.STYLE):
        drawn = quicklook._compose(replace(data, **given)).axes
    for axes in drawn:
        assert axes.images[0].get_array().shape[:2] == (48, 64)
        assert axes.get_xlim() == (-0.5, 127.5)
        assert tuple(axes.images[0].get_extent()) == (-0.5, 127.5, 95.5, -0.5)
