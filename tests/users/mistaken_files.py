"""Write the files of users with their own data: one for each common mistake, and a correct picture."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import zarr
from PIL import Image

CUBE = (12, 16, 5)
NM = "460,550,640,700,800"
RNG = np.random.default_rng(7)


def write_files(here: Path) -> None:
    """Write one file for each mistake into a folder, and folders of pictures with their labels."""
    picture = RNG.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    cube = RNG.uniform(0, 1, CUBE).astype(np.float32)
    _pictures(here, picture)
    _arrays(here, cube)
    _containers(here, cube)
    _texts(here)
    _folders(here, picture)


def _pictures(here: Path, picture: np.ndarray) -> None:
    labels = (picture[..., 0] > 99).astype(np.uint8)
    Image.fromarray(picture).save(here / "field.png")
    shutil.copy(here / "field.png", here / "FIELD_2.PNG")
    for name in ("a field.png", "Rüben.png", "two\nlines.png"):
        shutil.copy(here / "field.png", here / name)
    Image.fromarray(picture[:1, :1]).save(here / "one_px.png")
    (here / "cut.png").write_bytes((here / "field.png").read_bytes()[:200])
    (here / "text.png").write_text("this is a text\n")
    (here / "field.jp2").write_bytes(b"\0\0\0\x0cjP  ")
    (here / "field.fits").write_bytes(b"SIMPLE  =                    T")
    shutil.copy(here / "field.png", here / "no_ending")
    shutil.copy(here / "field.png", here / "field.tif")
    (here / "loop.png").symlink_to("loop.png")
    for name, values in {"small_labels.png": labels[:20], "two_classes.png": labels}.items():
        Image.fromarray(values).save(here / name)
    Image.fromarray(np.dstack([labels * 255, labels * 90, labels * 0])).resize((32, 24)).save(here / "labels.jpg")


def _arrays(here: Path, cube: np.ndarray) -> None:
    holes = cube.copy()
    holes[3:5, 3:9] = np.nan
    for name, values in {
        "cube": cube,
        "band_first": np.moveaxis(cube, 2, 0),
        "float_labels": np.full(CUBE[:2], 0.5),
        "holes": holes,
        "nothing": np.full(CUBE, np.nan),
        "filled": np.where(cube > 0.9, 1e30, cube),
        "plane": cube[..., 0],
        "table": np.ones((198, 10000), np.float32),
        "five_axes": np.ones((2, 2, 3, 3, 2)),
        "series": np.stack([cube, cube + 1, cube + 2]),
        "empty": np.ones((0, 16, 5)),
    }.items():
        np.save(here / f"{name}.npy", values)
    np.save(here / "objects.npy", np.array([{"soil": 1}], object), allow_pickle=True)


def _containers(here: Path, cube: np.ndarray) -> None:
    with h5py.File(here / "bare.h5", "w") as file:
        file["cube"] = cube
    (here / "cut.nc").write_bytes((here / "bare.h5").read_bytes()[:900])
    scipy.io.savemat(here / "one_cube.mat", {"cube": cube, "wl": np.arange(5.0), "day": 130})
    scipy.io.savemat(here / "with_nm.mat", {"cube": cube, "wavelengths": [0.46, 0.55, 0.64, 0.7, 0.8]})
    scipy.io.savemat(here / "two_cubes.mat", {"north": cube, "south": cube})
    (here / "cut.mat").write_bytes((here / "one_cube.mat").read_bytes()[:600])
    (here / "alone.hdr").write_text(
        "ENVI\nsamples = 16\nlines = 12\nbands = 5\ndata type = 4\ninterleave = bip\nbyte order = 0\n"
    )
    old = zarr.create_group(here / "old.zarr", zarr_format=2)
    old.create_array("0", data=cube)
    zarr.create_group(here / "hollow.zarr")


def _texts(here: Path) -> None:
    square = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]}
    owned = {"type": "Feature", "properties": {"owner": "Ada"}, "geometry": square}
    (here / "owners.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [owned]}))
    (here / "bom.toml").write_bytes(b'\xef\xbb\xbfsource = "sim"\r\nscene = "field.png"\nbudget = 0.8\n')
    (here / "sweeps.toml").write_text("sweeps = true\n")
    (here / "nobody.toml").write_text('scene = "~nobody-here/field.png"\n')
    (here / "unknown.toml").write_text('scene = "field.png"\nbuget = 0.8\n')
    (here / "broken.toml").write_text("scene = field.png\n")
    (here / "latin.toml").write_bytes('scene = "Rüben.png"\n'.encode("latin-1"))
    (here / "empty").mkdir()


def _folders(here: Path, picture: np.ndarray) -> None:
    mask = (picture[..., 0] > 99).astype(np.uint8)

    def folder(name: str, files: dict[str, np.ndarray], toml: str | None = None) -> None:
        for inner, values in files.items():
            path = here / name / inner
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(values).save(path)
        if toml is not None:
            (here / name / "scene.toml").write_text(toml)

    two = {"images/001.png": picture, "images/002.png": picture}
    folder("apart", {**two, "labels/001.png": mask, "labels/002.png": mask})
    folder("beside", {"A 1.png": picture, "A 1_mask.png": mask, "b.TIF": picture, "B_labels.PNG": mask})
    folder("lacking", {**two, "masks/001.png": mask, "masks/009.png": mask})
    folder("tiles", {**two, "masks/001.png": mask * 2, "masks/002.png": mask + 1})
    folder("several", {"001.png": picture, "001_mask.png": mask, "001_labels.png": mask})
    folder("one_stem", {"001.png": picture, "001.tif": picture, "masks/001.png": mask})
    folder("stems", {"001.png": picture, "001.tif": picture})
    folder("season", {"2024-05-01/field.png": picture, "2024-06-01/field.png": picture})
    folder("one_of_each", {"corrected.png": picture, "site_gt.png": mask})
    folder("soil", {**two, "labels/001.png": mask * 0, "labels/002.png": mask * 0})
    folder("unlabelled", {**two, "labels/001.png": mask * 0, "labels/002.png": mask * 0}, "unlabelled = 0\n")
    folder("soft", {**two, "labels/001.png": picture, "labels/002.png": mask})
    folder("sizes", {**two, "labels/001.png": mask, "labels/002.png": mask[:9]})
    folder("bare", two)
    folder("other_bands", {"001.png": picture, "002.png": mask, "labels/001.png": mask, "labels/002.png": mask})
    folder("hidden", {"001.png": picture, "labels/001.png": mask})
    for name in (".DS_Store", "Thumbs.db", "._001.png", "desktop.ini"):
        (here / "hidden" / name).write_bytes(b"\0\5\x16\7")
    colours = {**two, "labels/001.png": np.dstack([mask * 255] * 3), "labels/002.png": np.dstack([mask * 9] * 3)}
    stated = "[classes]\nsoil = [0, 0, 0]\ncrop = [255, 255, 255]\n"
    folder("no_class", colours, 'labels = "labels/{number}.png"\n' + stated)
    folder("bad_key", two, "label = 'labels'\n")
    folder("two_kinds", two, "[classes]\nsoil = 0\ncrop = [0, 255, 0]\n")
    folder("no_number", {"north.png": picture}, 'labels = "{number}.png"\n')
    folder("palette", {"001.png": picture})
    image = Image.fromarray(mask, "P")
    image.putpalette([120, 80, 10, 0, 200, 0])
    image.save(here / "palette" / "001_mask.png")
