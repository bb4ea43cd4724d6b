"""Tables of pixels and their spectra are read as the picture that they were made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.labels import load_labels
from storage.readers.open_cubes import open_cube

CUBE = np.arange(40 * 30 * 9, dtype=np.uint16).reshape(40, 30, 9)


def spectra(order: Any) -> NDArray[np.uint16]:
    """Spectra as columns, pixels in an order."""
    return CUBE.reshape((-1, 9), order=order).T


@pytest.mark.parametrize("kind", [".mat", "73.mat", ".npz", "turned.mat"])
def test_a_table_with_rows_and_columns_is_its_picture(tmp_path: Path, kind: str) -> None:
    """MATLAB's pixels go down the columns, numpy's along the rows; a note says which."""
    path = tmp_path / f"a{kind}"
    if kind == ".npz":
        np.savez(path, Y=spectra("C"), height=40, width=30)
    elif kind == "73.mat":
        with h5py.File(path, "w", userblock_size=512) as file:
            file["Y"], file["nRow"], file["nCol"] = spectra("F").T, [[40.0]], [[30.0]]
    else:
        about = {"nRow": 40, "nCol": 30, "SlectBands": np.arange(9)[:, None], "maxValue": 900}
        scipy.io.savemat(path, {"Y": spectra("F").T if kind == "turned.mat" else spectra("F"), **about})
    source = open_cube(path)
    np.testing.assert_array_equal(source.read(0, 40), CUBE)
    order = "along the rows" if kind == ".npz" else "down the columns"
    assert any("1200 pixels is read as 40 x 30 px (y x x)" in note and order in note for note in source.notes)


def test_labels_of_a_table_have_its_order(tmp_path: Path) -> None:
    """A label for each pixel; a table of another number of pixels stays as it is."""
    labels = (np.mgrid[:40, :30][0] // 15 + 1).astype(np.uint8)
    scipy.io.savemat(tmp_path / "gt.mat", {"label": labels.ravel(order="F"), "nRow": 40, "nCol": 30})
    np.testing.assert_array_equal(load_labels(tmp_path / "gt.mat", (40, 30), classes={}).index, labels - 1)
    scipy.io.savemat(tmp_path / "other.mat", {"A": np.ones((5, 7)), "nRow": 40, "nCol": 30})
    assert open_cube(tmp_path / "other.mat").shape == (5, 7, 1)


def test_a_table_without_a_size_is_refused(tmp_path: Path) -> None:
    """The message has the command that makes it a cube."""
    scipy.io.savemat(tmp_path / "table.mat", {"Y": np.ones((9, 3000))})
    with pytest.raises(SceneError, match=r"numpy\.reshape\(values\.T, \(height, width, 9\), order='F'\)"):
        open_cube(tmp_path / "table.mat")
