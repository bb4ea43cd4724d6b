"""Keys depend on meaning alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ArchiveError
from pipeline.geometry.scan import Sweep
from storage.archive.keys import canonical_json, stage_key

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(max_size=4), PLAIN, max_size=5))
@settings(max_examples=60, deadline=None)
def test_order_of_parameters_does_not_count(params: dict[str, object]) -> None:
    """The same table in another order has the same key."""
    turned = dict(reversed(params.items()))
    assert stage_key("mosaic", 1, params, ["a"]) == stage_key("mosaic", 1, turned, ["a"])


@given(st.floats(1e-6, 1e6))
@settings(max_examples=60, deadline=None)
def test_rounding_noise_does_not_count(value: float) -> None:
    """A float and the float that its 12 digits give are one parameter; a change in the ninth digit is another."""
    key = stage_key("plan", 1, {"a": value}, [])
    assert key == stage_key("plan", 1, {"a": float(f"{value:.12g}")}, [])
    assert key != stage_key("plan", 1, {"a": value * (1 + 1e-8)}, [])


def test_every_part_counts() -> None:
    """Stage, version, parameters, inputs and their order each change the key."""
    keys = {
        stage_key("a", 1, {"p": 1}, ["x", "y"]),
        stage_key("b", 1, {"p": 1}, ["x", "y"]),
        stage_key("a", 2, {"p": 1}, ["x", "y"]),
        stage_key("a", 1, {"p": 2}, ["x", "y"]),
        stage_key("a", 1, {"p": 1}, ["y", "x"]),
        stage_key("a", 1, {"p": "1"}, ["x", "y"]),
    }
    assert len(keys) == 6
    assert all(len(key) == 20 and set(key) <= set("0123456789abcdef") for key in keys)


def test_kinds_of_the_same_meaning_agree() -> None:
    """2 and 2.0, lists and tuples, numpy numbers and plain ones, paths and dataclasses."""
    sweep = Sweep("a", "fine", "x", 0.0, -3.5, 10)
    assert canonical_json({"a": (1, 2.0, -0.0)}) == canonical_json({"a": [np.int64(1), np.float64(2), 0]})
    assert canonical_json(sweep) == canonical_json(dataclasses.asdict(sweep))
    assert canonical_json([Path("a/b"), {3, 1}]) == '["a/b",[1,3]]'
    assert canonical_json(float("nan")) == '"nan"'
    assert canonical_json(np.ones(3)) != canonical_json(np.ones(3, np.float32))


def test_what_has_no_lasting_text_is_refused() -> None:
    """A function or a bare object cannot be part of a key."""
    for value in (test_every_part_counts, object(), np.array([None])):
        with pytest.raises(ArchiveError, match="cannot be part of a key"):
            stage_key("a", 1, {"p": value}, [])
