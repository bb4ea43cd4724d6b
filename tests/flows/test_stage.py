"""Stages of functions: what their keys depend on, dry runs, cleared stores, retries, and calls that do not fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.flows import stage as stage_module
from spectralzoom.flows.stage import Output, Stores, Unkeyed, stage
from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.store import Archive, Ref

facts = st.integers() | st.booleans() | st.text(max_size=3) | st.none() | st.tuples(st.integers(), st.booleans())


@dataclass(frozen=True)
class Scene:
    """An object that is known by its key, whatever else it holds."""

    key: str
    pixels: int = 0


@stage("letter", version=1)
def letter(out: Output, *, text: Any, scene: Scene | None = None, pool: Unkeyed[int] = 1) -> None:
    """Write a text."""
    (out.path / "letter").write_text(f"{text}")


@stage("two letters", version=1, product="word")
def join(out: Output, first: Ref, second: Ref | None = None, *more: Ref, between: str = "") -> None:
    """Write the texts of all inputs into one."""
    given = [one for one in (first, second, *more) if one is not None]
    (out.path / "letter").write_text(between.join((one.path / "letter").read_text() for one in given))


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an empty archive."""
    return Archive.open(tmp_path / "archive")


def spell(stores: Stores, text: str = "a", between: str = "-") -> Ref:
    """Make a word of a letter, a word of that word, and return the second one."""
    one = letter(stores, text=text)
    return join(stores, join(stores, one, one, between=between), one)


STAGES = ("letter", "join", "join-2")  # rows of `spell`


def states(stores: Stores) -> dict[str, str]:
    """Return the state of each stage."""
    return {name: row.state for name, row in stores.rows.items()}


@given(facts, facts, st.integers(), st.integers())
def test_keyword_arguments_are_the_key(one: Any, other: Any, pool: int, pixels: int) -> None:
    """An argument that is `Unkeyed` changes no key; an object with a key counts by it alone."""
    dry = Stores(Archive(Path("nowhere")), dry=True)
    usual = letter(dry, text=one, scene=Scene("a"))
    assert letter(dry, text=one, scene=Scene("a", pixels), pool=pool) == usual
    assert letter(dry, text=one, scene=Scene("b")) != usual
    other_is_one = (other, type(other)) == (one, type(one))
    assert (letter(dry, text=other, scene=Scene("a")) == usual) == other_is_one
    assert (letter.product, usual.stage, usual.path.parent.name) == ("letter", "letter", "letter")


def test_inputs_and_version_are_the_key(archive: Archive) -> None:
    """Their order counts, and inputs that are None are none; two stages of one product share their stores."""
    stores = Stores(archive)
    a, b = letter(stores, text="a"), letter(stores, text="b")
    words = [join(stores, *some) for some in ((a, b), (b, a), (a, b, a), (a,), (a, None))]
    assert len(set(words)) == 4
    assert words[3] == words[4] == replace(join, build=join.build, title="again")(stores, a)
    assert replace(join, version=2)(stores, a) != words[3]
    assert words[0].stage == "word"


def test_a_decorated_function_has_the_key_of_its_arguments() -> None:
    """Another function around it changes no argument."""
    dry = Stores(Archive(Path("nowhere")), dry=True)
    around = replace(letter, build=wraps(letter.build)(lambda *given, **facts: letter.build(*given, **facts)))
    keys = [
        one(dry, text=text, pool=pool).key for one, text, pool in ((letter, "a", 1), (around, "a", 2), (around, "b", 1))
    ]
    assert keys[0] == keys[1] != keys[2]


def test_a_store_is_made_once(archive: Archive) -> None:
    """A second survey finds it, and has no seconds of its making."""
    stores = [Stores(archive), Stores(archive)]
    assert spell(stores[0]) == spell(stores[1])
    assert [states(one) for one in stores] == [dict.fromkeys(STAGES, state) for state in ("ran", "cached")]
    made, found = (one.rows["letter"] for one in stores)
    assert made.wall_s is not None
    assert (found.wall_s, found.bytes_out) == (None, made.bytes_out)


def test_a_dry_run_makes_nothing_and_answers_addresses(tmp_path: Path, archive: Archive) -> None:
    """Its keys are those of the stores; after one argument changed, what follows from it would run."""
    nowhere = Stores(Archive(tmp_path / "none"), dry=True)
    planned = spell(nowhere)
    assert states(nowhere) == dict.fromkeys(STAGES, "to run")
    assert not (tmp_path / "none").exists()
    made = spell(Stores(archive))
    assert planned == made
    dry = [Stores(archive, dry=True) for _ in range(3)]
    before = sorted(archive.root.rglob("*"))
    assert [one == made for one in (spell(dry[0]), spell(dry[1], between="+"), spell(dry[2], text="b"))] == [
        True,
        False,
        False,
    ]
    assert [list(states(one).values()) for one in dry] == [["cached"] * 3, ["cached", *["to run"] * 2], ["to run"] * 3]
    assert sorted(archive.root.rglob("*")) == before


@pytest.mark.parametrize("dry", [False, True])
def test_a_cleared_store_is_made_again_for_a_later_one_alone(archive: Archive, dry: bool) -> None:
    """It counts as found as long as nothing has to be made of it."""
    made = spell(Stores(archive))
    archive.clear(letter(Stores(archive, dry=True), text="a"))
    stores = Stores(archive, dry=dry)
    assert spell(stores) == made
    assert states(stores) == dict.fromkeys(STAGES, "cached")
    one = letter(stores, text="a")
    assert not stores.has(one)
    join(stores, one, between="+")
    made_now = "to run" if dry else "ran"
    assert states(stores) == {"letter": made_now, "join": "cached", "join-2": "cached", "join-3": made_now}
    assert stores.has(one) != dry


def test_content_that_is_open_leaves_keys_open(archive: Archive) -> None:
    """A stage whose arguments follow from a missing store has no key in a dry run, nor has what is made of it."""
    dry = Stores(archive, dry=True)
    one = letter(dry, text="a")
    assert join(dry, join(dry, replace(one, key="")), one).key == ""


def test_arguments_that_are_no_stores_are_keywords(archive: Archive) -> None:
    """A positional number would be in no key."""
    numbered = stage("number", version=1)(lambda out, number: None)
    with pytest.raises(TypeError, match="must be keywords, to be part of the key"):
        numbered(Stores(archive), 1)


def test_a_store_whose_input_was_cleared_meanwhile_is_not_published(archive: Archive) -> None:
    """Arrays that another survey cleared read as nodata, so the store would hold wrong values."""
    stores = Stores(archive)
    one = letter(stores, text="a")
    cleared = replace(join, build=lambda out, first: archive.clear(first) and None)
    with pytest.raises(ArchiveError, match="another survey has cleared an input of word meanwhile"):
        cleared(stores, one)
    assert archive.refs("word") == []


@pytest.mark.parametrize(("error", "retries", "tries"), [(OSError, 2, 3), (ValueError, 2, 1), (OSError, 0, 1)])
def test_an_oserror_is_retried_in_a_flow_alone(
    archive: Archive, server: str, monkeypatch: pytest.MonkeyPatch, error: type[Exception], retries: int, tries: int
) -> None:
    """A device may answer the second time; other errors and other stages have one try."""
    from prefect import flow

    def build(out: Output) -> None:
        tried.append(out.path)
        raise error("no reply")

    monkeypatch.setattr(stage_module, "RETRY_DELAY_S", 0.0)
    stage_module._task.cache_clear()
    refused, stores = replace(join, build=build, retries=retries), Stores(archive, name="x")

    @flow(persist_result=False)
    def survey() -> None:
        refused(stores)

    for call, expected in ((survey, tries), (lambda: refused(stores), 1)):
        tried: list[Path] = []
        with pytest.raises(error, match="no reply"):
            call()
        assert len(tried) == expected


def few_letters(text: str, **_: object) -> str:
    """Return why a text cannot be served; empty where it can."""
    return "it has no letter" if not text else ""


@stage("initial", version=1, lacks=few_letters)
def initial(out: Output, *, text: str, pool: Unkeyed[int] = 1) -> None:
    """Write the first letter of a text."""
    (out.path / "letter").write_text(text[0])


@pytest.mark.parametrize("dry", [False, True])
def test_a_stage_that_cannot_serve_is_left_out_with_what_needs_it(archive: Archive, dry: bool) -> None:
    """Its reason is in its row and in a note; other stages go on."""
    notes: list[str] = []
    stores = Stores(archive, dry=dry, note=notes.append)
    word = join(stores, letter(stores, text="a"), initial(stores, text=""))
    alone = initial(Stores(archive, dry=dry), text="b")
    made = "to run" if dry else "ran"
    assert states(stores) == {"letter": made, "initial": "left out", "join": "left out"}
    whys = ["it has no letter", "it needs what is left out: initial"]
    assert [row.why for row in stores.rows.values() if row.state == "left out"] == whys
    assert notes == [f"{title} is left out: {why}" for title, why in zip(("initial", "two letters"), whys, strict=True)]
    assert [ref.stage for ref in stores.refs] == ["letter"]
    assert not stores.has(word)
    assert (alone.key != "", archive.is_there(alone.uri)) == (True, not dry)
