"""Mistakes of users with their own data: each ends in one message that names the remedy, or the file is read."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.training.data import load_data_set
from spectralzoom.storage.readers.scene_files import load_scene_file
from spectralzoom.storage.store import Archive
from tests.flows.conftest import command_line
from tests.users.mistaken_files import NM, write_files

__all__ = ["command_line"]

SURVEY = "survey --engine plain --no-accuracy --out never --weights w.safetensors --source sim --scene "
TRAIN = "train --steps 1 -o new.safetensors "
BANDS = f" --wavelengths {NM}"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, weights: Path) -> Path:
    """Return a folder with every mistaken file."""
    here = tmp_path_factory.mktemp("mistakes")
    write_files(here)
    shutil.copy(weights, here / "w.safetensors")
    Archive.open(here / "kept")
    return here


CASES = {
    # a scene
    "missing file": (1, SURVEY + "none.png", "there is no file none.png"),
    "missing weights": (2, "survey --scene field.png", "weights is missing.* train some"),
    "unknown ending": (1, SURVEY + "field.fits", "ends in .fits, which is not read; use .png"),
    "cut off JPEG 2000": (1, SURVEY + "field.jp2", "field.jp2 cannot be read as JPEG 2000.*damaged"),
    "cut off NetCDF": (1, SURVEY + "cut.nc", "cut.nc cannot be read as NetCDF or HDF5.*copy it again"),
    "HDF5 without wavelengths": (1, SURVEY + "bare.h5", "has 5 bands and nothing says their wavelengths"),
    "polygons without a class": (1, SURVEY + "field.png --labels owners.geojson", "they have owner"),
    "no ending": (1, SURVEY + "no_ending", "no header beside no_ending.*ending of another kind"),
    "png called tif": (1, SURVEY + "field.tif", "field.tif cannot be read as TIFF"),
    "link to itself": (1, SURVEY + "loop.png", "a link that leads nowhere, loop.png"),
    "cut off picture": (1, SURVEY + "cut.png", "cut.png cannot be read as .png.*is it damaged"),
    "cut off MATLAB": (1, SURVEY + "cut.mat" + BANDS, "cut.mat cannot be read as .mat.*copy it again"),
    "objects": (1, SURVEY + "objects.npy" + BANDS, "Python objects"),
    "empty array": (1, SURVEY + "empty.npy" + BANDS, "empty cube of shape"),
    "five axes": (1, SURVEY + "five_axes.npy" + BANDS, r"shape \(2, 2, 3, 3, 2\); expected \(y, x, band\)"),
    "bands first": (1, SURVEY + "band_first.npy" + BANDS, r"expected 16 wavelengths.*got 5; .*axes are y, x, band"),
    "NaN everywhere": (1, SURVEY + "nothing.npy" + BANDS, "no finite number"),
    "fill values": (1, SURVEY + "filled.npy" + BANDS, "write nodata = 1e"),
    "header without data": (1, SURVEY + "alone.hdr" + BANDS, "no data file beside"),
    "folder called zarr": (1, SURVEY + "hollow.zarr", "hollow.zarr has no array"),
    # which array
    "several arrays": (1, SURVEY + "two_cubes.mat" + BANDS, r"north \(12, 16, 5\), south.*two_cubes.mat:ARRAY"),
    "no such variable": (1, SURVEY + "two_cubes.mat:west" + BANDS, r"no array west; it has north \(12, 16, 5\)"),
    "a table as a scene": (1, SURVEY + "table.npy --wavelengths 550", "table of 198 x 10000"),
    "series": (1, SURVEY + "series.npy" + BANDS, r"shape \(3, 12, 16, 5\); expected \(y, x, band\).* store one time"),
    "name in an array file": (1, SURVEY + "cube.npy:red" + BANDS, "one array, which has no name"),
    # wavelengths and bands
    "no wavelengths": (1, SURVEY + "cube.npy", "nothing says their wavelengths; .* or give survey --wavelengths"),
    "too few wavelengths": (1, SURVEY + "cube.npy --wavelengths 460,550", "expected 5 wavelengths.* got 2"),
    "band that is not there": (1, SURVEY + "cube.npy --bands 0,5 --wavelengths 460,550", "band 5, but .*0..4"),
    "band twice": (2, SURVEY + "cube.npy --bands 1,1 --wavelengths 460,550", "names a band twice"),
    # labels
    "labels of another size": (1, SURVEY + "field.png --labels small_labels.png", "20 x 32 px, the scene is 24 x 32"),
    "labels with fractions": (1, SURVEY + "plane.npy --wavelengths 550 --labels float_labels.npy", "fractions"),
    "labels as JPEG": (1, SURVEY + "field.png --labels labels.jpg", "different colours.*JPEG.* PNG"),
    "the picture as labels": (1, SURVEY + "field.png --labels field.png", "is this the picture itself"),
    "labels of a farm": (2, "survey --labels two_classes.png --engine plain --out never", "brings its own"),
    "colour of no class": (1, TRAIN + "no_class", r"colour \[9, 9, 9\], which is no class.* add it to \[classes\]"),
    # weights
    "name too long": (1, SURVEY + "x" * 5000 + ".png", "cannot be the name of a file"),
    "labels of a long name": (1, SURVEY + "field.png --labels " + "x" * 300 + ".png", "name is too long"),
    "weights in a folder": (1, "evaluate bare --weights apart", "the weights apart are a folder, expected a file"),
    # settings
    "sweeps that are no path": (2, "survey sweeps.toml", "'sweeps' .*must be text that is not empty, got True"),
    "home of nobody": (2, "survey nobody.toml", "'scene': there is no user of '~nobody-here'"),
    "unknown setting": (2, "survey unknown.toml", "buget"),
    "broken settings": (2, "survey broken.toml", "broken.toml.*line 1"),
    "settings not in UTF-8": (2, "survey latin.toml", "latin.toml.*utf-8"),
    "budget 0": (2, SURVEY + "field.png --budget 0", "above 0 and at most 1, got '0'"),
    "settings as a scene": (
        2,
        "survey --scene north.toml",
        "no scene; give settings as: spectralzoom survey north.toml",
    ),
    "plan of settings as a scene": (2, "plan --scene 'a b.TOML'", "as: spectralzoom survey 'a b.TOML'$"),
    "description as a scene": (2, "survey --scene bad_key/scene.toml", "no scene; give its scene: --scene bad_key$"),
    "description as settings": (2, "survey bad_key/scene.toml", "describes a scene: give the scene's file as --scene"),
    "built-in scene as settings": (2, "survey farm", "as: spectralzoom survey --scene farm$"),
    "served scene": (2, "serve scouting --every 1h", "as: spectralzoom survey --scene scouting$"),
    "picture that is gone": (2, "plan 'no field.png'", "as: spectralzoom survey --scene 'no field.png'$"),
    "micrometres": (2, SURVEY + "cube.npy --wavelengths .46,.55,.64,.7,.8", "if it means 460 nm, write 460$"),
    "one of micrometres": (2, SURVEY + "cube.npy --wavelengths 460,550,.64,700,800", "if it means 640 nm, write 640$"),
    "a stated unit": (2, SURVEY + "cube.npy --wavelengths '0.705 µm,1,2,3,4'", "without a unit.* write 705$"),
    "nm as a unit": (2, SURVEY + "cube.npy --wavelengths '460 nm,550,640,700,800'", "if it means 460 nm, write 460$"),
    "metres": (
        2,
        SURVEY + "cube.npy --wavelengths 5e-7,1,2,3,4",
        "of nm from 150 to 30000, without a unit, got '5e-7'$",
    ),
    "weights that are gone": (
        1,
        SURVEY.replace("w.saf", "gone.saf") + "field.png",
        "gone.*give others as --weights, or",
    ),
    "scene as settings": (2, "survey field.png", "a scene is given as: spectralzoom survey --scene field.png"),
    # training
    "empty folder to train on": (1, TRAIN + "empty", "holds no scene"),
    "no labels at all": (1, TRAIN + "bare", "no labels; training needs them.* labels/001.png"),
    "several label files": (1, TRAIN + "several", "001_labels.png and .*001_mask.png; keep one"),
    "two files of one stem": (1, TRAIN + "one_stem", "001.png and .*001.tif would both have the labels"),
    "labels of one class": (1, TRAIN + "soil", "two or more classes.* unlabelled = "),
    "no labelled pixel": (1, TRAIN + "unlabelled", "no pixel of 001 has a class; correct the labels, or 'unlabelled'"),
    "soft labels": (1, TRAIN + "soft", "at most 64.* hard edges"),
    "scenes of other bands": (1, TRAIN + "other_bands", "other bands"),
    "unknown key of scene.toml": (1, TRAIN + "bad_key", "unknown key label; known are"),
    "classes of two kinds": (1, TRAIN + "two_kinds", "some classes that are numbers and some that are colours"),
    "number that names lack": (1, TRAIN + "no_number", "north has no labels; training needs them"),
    "training into no folder": (
        2,
        TRAIN.replace("new.", "none/new.") + "apart",
        "expected the name of a file in a folder that exists",
    ),
    "no steps": (2, TRAIN.replace("--steps 1", "--steps 0") + "apart", "--steps must be above 0"),
    "scenes of files": (2, TRAIN + "apart --scenes 3", "--scenes is for built-in scenes"),
    "too many for validation": (1, TRAIN + "apart --validation 3", "leaves none of 2 scenes to train on"),
    "band that is no number": (2, TRAIN + "apart --bands a", "whole numbers with commas, got 'a'"),
    "no -o": (2, "train apart", "--out requires an argument"),
    "hold-out of the farm": (2, "train farm -o new.safetensors --hold-out 1", "--hold-out is for scene files"),
    "unknown scene held out": (1, TRAIN + "apart --hold-out 9", "no scene 9 to hold out; it has 001, 002"),
    # init
    "init of nothing": (1, "init none", "no file or folder none"),
    "init of a broken picture": (1, "init text.png", "text.png cannot be read"),
    "init of a folder of dates": (1, "init season", "in its folders 2024-05-01, 2024-06-01: name one"),
    "init twice": (2, "init bad_key", "bad_key/scene.toml exists.*--force"),
    # archives
    "folder that is no archive": (1, "export apart -o maps", "apart"),
    "unknown run": (2, "explain kept yesterday", "yesterday"),
    "wavelengths of a farm": (2, "survey --wavelengths 460 --engine plain --out never", "brings its own"),
    "evaluation without weights": (2, "evaluate apart", "give --weights FILE"),
    "evaluation without labels": (1, "evaluate bare --weights w.safetensors", "has no labels"),
}


@pytest.mark.parametrize("case", CASES)
def test_mistakes_are_one_message(case: str, files: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line names the remedy, the exit code is right, there is no traceback, and no file is written."""
    code, words, message = CASES[case]
    monkeypatch.chdir(files)
    before = sorted(files.rglob("*"))
    command_line(*shlex.split(words)).refused(code, message)
    assert sorted(files.rglob("*")) == before


WORKS = {  # address, wavelengths, shape (y, x, band), and the expected note
    "upper-case ending": ("FIELD_2.PNG", None, (24, 32, 3), ""),
    "spaces": ("a field.png", None, (24, 32, 3), ""),
    "umlauts": ("Rüben.png", None, (24, 32, 3), ""),
    "line ends in a name": ("two\nlines.png", None, (24, 32, 3), ""),
    "one pixel": ("one_px.png", None, (1, 1, 3), ""),
    "some NaN": ("holes.npy", NM, (12, 16, 5), "missing samples: 60 of 960"),
    "two axes": ("plane.npy", "550", (12, 16, 1), ""),
    "one cube beside vectors": ("one_cube.mat", NM, (12, 16, 5), r"array cube of the file, which also has wl \(1, 5\)"),
    "nm beside it": (
        "with_nm.mat",
        None,
        (12, 16, 5),
        "no unit, read as micrometres by their size; wavelengths from the list wavelengths",
    ),
    "named variable": ("two_cubes.mat:north", NM, (12, 16, 5), ""),
    "Zarr v2 of another tool": ("old.zarr", NM, (12, 16, 5), "dims have no names"),
}


@pytest.mark.parametrize("case", WORKS)
def test_unusual_but_valid_files_are_read(case: str, files: Path) -> None:
    """The values have the expected shape, and a note states each assumption."""
    address, listed, shape, words = WORKS[case]
    nm = None if listed is None else [float(one) for one in listed.split(",")]
    scene = load_scene_file(f"{files}/{address}", wavelengths=nm)
    assert scene.values.shape == shape
    assert re.search(words, "; ".join(scene.provenance))


def test_a_byte_order_mark_in_a_settings_file_is_ignored(files: Path) -> None:
    """Windows editors write a byte order mark (BOM) at the beginning of a file."""
    assert load_settings(files / "bom.toml").budget == 0.8


FOLDERS = {  # names of scenes and of their label files
    "apart": {"001": "labels/001.png", "002": "labels/002.png"},
    "beside": {"A 1": "A 1_mask.png", "b": "B_labels.PNG"},
    "lacking": {"001": "masks/001.png", "002": None},
    "hidden": {"001": "labels/001.png"},
    "one_of_each": {"corrected": "site_gt.png"},
    "stems": {"001.png": None, "001.tif": None},
    "palette": {"001": "001_mask.png"},
}


@pytest.mark.parametrize("folder", FOLDERS)
def test_images_find_their_labels_by_name(folder: str, files: Path) -> None:
    """Suffixes such as _mask and case do not matter; hidden files and labels without an image are ignored."""
    data = load_data_set(files / folder)
    found = {name: data.label_files.get(name) for name in data.files}
    root = files / folder
    assert {name: path and path.relative_to(root).as_posix() for name, path in found.items()} == FOLDERS[folder]
