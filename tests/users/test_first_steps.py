"""Typical first problems of users with their own data: one message names the remedy, or the command works."""

from __future__ import annotations

import errno
import json
import os
import resource
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.readers.scene_files import load_scene_file
from tests.flows.conftest import command_line
from tests.storage.readers.test_label_grids import write

__all__ = ["command_line"]

SMALL = ["--steps", "1"]
RNG = np.random.default_rng(4)
CLASSES = np.kron(RNG.integers(0, 2, (4, 4)), np.ones((8, 8))).astype(np.uint8)


def image() -> NDArray[np.int16]:
    """Return three bands of noise on the classes, different on each call."""
    return (CLASSES[..., None] * 60 + RNG.integers(1, 40, (32, 32, 3))).astype(np.int16)


# --- values -----------------------------------------------------------------------------------------------------------


def test_undeclared_minus_9999_is_read_as_nodata(tmp_path: Path) -> None:
    """Samples of -9999 become NaN and a note counts them; a stated nodata value keeps them as values."""
    values = image()
    values[:6] = -9999
    path = write(tmp_path / "a.tif", values)
    scene = load_scene_file(path, wavelengths=[460, 550, 640])
    assert np.isnan(scene.values[:6]).all()
    assert np.isfinite(scene.values[6:]).all()
    assert scene.missing.sum() == 6 * 32
    assert any("576 samples are -9999, which is taken for no data" in note for note in scene.provenance)
    (tmp_path / "scene.toml").write_text("nodata = 1e30\n")
    stated = load_scene_file(path, wavelengths=[460, 550, 640])
    np.testing.assert_array_equal(stated.values, values)
    assert stated.light_hash != scene.light_hash


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    """Return four labelled tiles; the second is nodata everywhere, and the values of the third are mostly negative."""
    (folder := tmp_path / "tiles").mkdir()
    (folder / "scene.toml").write_text("wavelengths_nm = [460, 550, 640]\n")
    for number in range(1, 5):
        values = np.full((32, 32, 3), -9999, np.int16) if number == 2 else image() * (-1 if number == 3 else 1)
        write(folder / f"{number:03d}.tif", values, nodata=-9999)
        write(folder / f"{number:03d}_labels.tif", CLASSES)
    return folder


def test_training_leaves_out_a_tile_without_values(tiles: Path, tmp_path: Path, command_line: Any) -> None:
    """Training and evaluation name it in a note; if no other tile is left, training is refused with the tile's name."""
    out = tmp_path / "w.safetensors"
    ended = command_line("train", tiles, "-o", out, "--hold-out", "004", *SMALL)
    assert ended.code == 0, ended.err
    assert "note: 1 scene without any value left out: 002" in ended.err
    assert "note: most values of 003 are negative, thus without light; add an offset" in ended.err
    assert "most values of 001" not in ended.err
    judged = command_line("evaluate", tiles, "--weights", out, "--fractions", "0.5")
    assert judged.code == 0, judged.err
    assert "note: 1 scene without any value left out: 002" in judged.err
    for number in ("001", "003", "004"):
        (tiles / f"{number}.tif").unlink()
    command_line("train", tiles, "-o", out, *SMALL).refused(1, "no scene to train on: no value anywhere in 002")


@pytest.mark.parametrize("held_out", [False, True])
def test_the_advised_evaluation_command_works(tiles: Path, tmp_path: Path, command_line: Any, held_out: bool) -> None:
    """If all scenes were used in training, the advice asks for others; with held-out scenes, its command runs."""
    out = tmp_path / "w.safetensors"
    ended = command_line("train", tiles, "-o", out, *(["--hold-out", "004"] if held_out else []), *SMALL)
    said = " ".join(ended.err.split())
    if held_out:
        assert f"spectralzoom evaluate {tiles} --weights {out}" in said
        assert command_line("evaluate", tiles, "--weights", out).code == 0
    else:
        assert f"spectralzoom evaluate OTHER_SCENES --weights {out}; or train with some held out" in said


# --- init -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["list", "file"])
def test_init_names_the_wavelengths_that_its_next_command_needs(
    tmp_path: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """The advised command runs after either of the two lines for wavelengths is filled in."""
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "field.npy", image().astype(np.float32))
    np.save(tmp_path / "field_labels.npy", CLASSES)
    told = json.loads(command_line("init", ".", "--json").out)
    toml = tmp_path / "scene.toml"
    assert told["first"] == "write the 3 wavelengths into scene.toml, as it says"
    line = "# wavelengths_nm = []" if way == "list" else '# wavelengths_file = "bands.txt"'
    assert line in toml.read_text()
    toml.write_text(toml.read_text().replace(line, line.removeprefix("# ").replace("[]", "[460, 550, 640]")))
    (tmp_path / "bands.txt").write_text("460 10\n550 10\n640 10\n")
    trained = command_line(*shlex.split(told["next"])[1:], *SMALL)
    assert trained.code == 0, trained.err


@pytest.mark.parametrize("there", [False, True])
def test_init_on_readonly_disk(tmp_path: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    """The message says that the disk is read-only, also with --force, and an existing scene.toml stays."""
    Image.fromarray(image().astype(np.uint8)).save(tmp_path / "a.png")
    if there:
        (tmp_path / "scene.toml").write_text("nodata = 1\n")

    def refuse(path: Any, *rest: Any, **named: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(os, "mkdir", refuse)
    command_line("init", tmp_path, "--force").refused(1, f"{tmp_path}.*read-only")
    assert (tmp_path / "scene.toml").exists() == there


# --- words ------------------------------------------------------------------------------------------------------------


def test_the_date_of_a_visit_has_one_format() -> None:
    """Days between visits are counted from dates of one format, which the error names; other text is allowed."""
    for visit in ("01.06.2026", "6/1/2026", "2026-6-1", "01.06.2026 noon", "2026-13-10b", "0026-06-10"):
        with pytest.raises(SettingsError, match=r"visit must be text, or begin with a date as YYYY-MM-DD"):
            load_settings(None, {"scene": "farm", "visit": visit})
    for visit in ("first of June", "2026-06-01T10:00:00Z", "v1.2.3", "2026-05-04_2", "10010101"):
        assert load_settings(None, {"scene": "farm", "visit": visit}).visit == visit
    assert moment_of("2026-06-01 morning") == moment_of("2026-06-01_2") == moment_of("2026-06-01T25:00")
    assert moment_of("2026-06-01 08:00 north") == moment_of("2026-06-01T08:00:00Z")


# --- a disk that refuses ----------------------------------------------------------------------------------------------


@contextmanager
def small_files(most: int) -> Iterator[None]:
    """Limit the size of all files of this process; GDAL reports no error for the writes that the limit refuses."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_an_export_to_a_full_disk_ends_in_one_message(surveyed_png: Any, tmp_path: Path, command_line: Any) -> None:
    """The message gives the disk's error without GDAL's, and no file is left; with space the export works."""
    archive, out = tmp_path / "archive", tmp_path / "maps"
    surveyed_png(archive)
    with small_files(600):
        ended = command_line("export", archive, "-o", out)
    ended.refused(1, r"cannot write to .*a file may not grow so large here.*nothing published was changed")
    assert [path.name for path in out.rglob("*") if path.is_file()] == [".export.lock"]
    assert command_line("export", archive, "-o", out).code == 0
