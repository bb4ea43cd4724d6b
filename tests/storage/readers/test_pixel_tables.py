"""Tables of pixels and their spectra are the picture that they were made of."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.labels import load_labels
from storage.readers.open_cubes import open_cube
from storage.readers.scene_files import load_scene_file

NM = np.linspace(400, 1000, 9)


def picture(rows: int, columns: int, bands: int = 9) -> NDArray[np.uint16]:
    """A smooth field that is alike neither turned nor mirrored."""
    y, x = np.mgrid[:rows, :columns]
    plane = 500 + 300 * np.sin(x / 9) + 8 * y + 2 * x
    return (plane[..., None] * np.linspace(0.5, 1, bands)).astype(np.uint16)


def table(cube: NDArray[Any], order: Literal["C", "F"]) -> NDArray[Any]:
    """Spectra as columns, pixels in an order."""
    return cube.reshape((-1, cube.shape[2]), order=order).T


@pytest.mark.parametrize("order", ["F", "C"])
@pytest.mark.parametrize("kind", [".mat", "73.mat", ".npz", "turned.mat"])
def test_a_table_with_rows_and_columns_is_its_picture(tmp_path: Path, kind: str, order: Literal["C", "F"]) -> None:
    """Values come out as they were, whatever the order of the pixels and the kind of the file; a note says which."""
    cube = picture(40, 30)
    values, path = table(cube, order), tmp_path / f"a{kind}"
    if kind == ".npz":
        np.savez(path, Y=values, height=40, width=30)
    elif kind == "73.mat":
        with h5py.File(path, "w", userblock_size=512) as file:
            file["Y"], file["nRow"], file["nCol"] = values.T, [[40.0]], [[30.0]]
    else:
        about = {"nRow": 40, "nCol": 30, "SlectBands": np.arange(9)[:, None], "maxValue": 900}
        scipy.io.savemat(path, {"Y": values.T if kind == "turned.mat" else values, **about})
    scene = load_scene_file(path, wavelengths=NM.tolist())
    np.testing.assert_array_equal(scene.values, cube)
    said = "down its columns" if order == "F" else "along its rows"
    assert any("1200 pixels is read as 40 x 30 px (y x x)" in note and said in note for note in scene.provenance)


def test_a_square_table_is_taken_in_the_order_of_its_program(tmp_path: Path) -> None:
    """Turned over its diagonal a square picture is as smooth: MATLAB's order counts, and the note asks to look."""
    cube = picture(40, 40)
    scipy.io.savemat(tmp_path / "jasper.mat", {"Y": table(cube, "F"), "nRow": 40, "nCol": 40, "nBand": 9})
    source = open_cube(tmp_path / "jasper.mat")
    np.testing.assert_array_equal(source.read(0, 40), cube)
    assert any("rows and columns may be exchanged" in note for note in source.notes)


def test_labels_of_a_table_are_folded_alike(tmp_path: Path) -> None:
    """A label for each pixel lies as the spectra do; a table of another number of pixels is left as it is."""
    labels = (np.mgrid[:40, :30][0] // 15 + 1).astype(np.uint8)
    scipy.io.savemat(tmp_path / "gt.mat", {"label": labels.ravel(order="F"), "nRow": 40, "nCol": 30})
    np.testing.assert_array_equal(load_labels(tmp_path / "gt.mat", (40, 30), classes={}).index, labels - 1)
    scipy.io.savemat(tmp_path / "other.mat", {"A": np.ones((5, 7)), "nRow": 40, "nCol": 30})
    assert open_cube(tmp_path / "other.mat").shape == (5, 7, 1)


@pytest.mark.parametrize("order", ["F", "C"])
@pytest.mark.parametrize("turned", [False, True])
def test_the_hint_is_right_for_both_orders(tmp_path: Path, order: Literal["C", "F"], turned: bool) -> None:
    """Without rows and columns the message names a command for each order; the fitting one gives the picture."""
    cube = picture(60, 50)
    values = table(cube, order).T if turned else table(cube, order)
    scipy.io.savemat(tmp_path / "table.mat", {"Y": values})
    with pytest.raises(SceneError, match="table of") as refused:
        open_cube(tmp_path / "table.mat")
    found = re.search(r"numpy\.reshape\(values.*?order='F'\)", str(refused.value))
    assert found is not None
    assert "order='C' where along its rows. Look at one band" in str(refused.value)
    command = found[0].replace("order='F'", f"order={order!r}")
    made = eval(command, {"numpy": np, "values": values, "height": 60, "width": 50})
    np.testing.assert_array_equal(made, cube)
