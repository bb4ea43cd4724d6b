"""Tables as CSV: spreadsheets run no cell, and readers get the names."""

from __future__ import annotations

import csv
import io

import numpy as np
import pandas
import pytest

from spectralzoom.storage.export.csv_tables import csv_table

FORMULAS = [
    "=1+1",
    "+1",
    "-1",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "\n=1",
    " =1",
    '"=1"',
    "\uff1d1",
    "'=1",
    "'tis",
    'a";=1',
    "a\n=1",
]


@pytest.mark.parametrize("name", [*FORMULAS, "weed", "sugar, beet", 'so "called"', "a;=1+1", "", "Mais"])
def test_names_are_no_formulas_and_come_back(name: str) -> None:
    """No cell begins as a formula, text is quoted, and a leading apostrophe hides the name."""
    text = csv_table({"class": [name], name: [2]})
    (head, row) = csv.reader(io.StringIO(text, newline=""))
    for cell in (head[1], row[0]):
        assert not cell.lstrip(' "').startswith(("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d"))
        assert cell.removeprefix("'") == name
    assert text.endswith('",2\n')


def test_numbers_stay_numbers() -> None:
    """NaN and None are empty, and negative numbers have no apostrophe."""
    columns = {"n": [1, -2], "x": np.array([-0.25, np.nan]), "y": [None, 1 / 3]}
    found = pandas.read_csv(io.StringIO(csv_table(columns)))
    pandas.testing.assert_frame_equal(
        found, pandas.DataFrame({"n": [1, -2], "x": [-0.25, np.nan], "y": [np.nan, 1 / 3]})
    )
