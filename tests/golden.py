"""Survey eight tiny fields and hold their results to `tests/golden.json`: python tests/golden.py [--only NAME ...].

The script writes the file anew and prints what changed; `tests/test_golden.py` compares. A row that changes on purpose
says why in its commit. A figure that is removed loses its line, and no other line changes.

A row has SHA-256 of the mosaic, of the class map, and of times and mirror positions of the lines. It has the mean and
standard deviation of each component's scores, pixels of each class, and the figures of the receipt. It has no times of
the computer, memory, file sizes or names of runs.

Rounding differs between processors and between versions of libraries. The file names those that it was written with.
There, all values are compared exactly. Elsewhere, hashes are left out, and numbers are compared within `close`.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path[0] = str(ROOT)  # not this folder: modules are imported by their full names

import numpy as np  # noqa: E402
import threadpoolctl  # noqa: E402
import torch  # noqa: E402
import xarray as xr  # noqa: E402

import spectralzoom  # noqa: E402
from spectralzoom import OpenedRun  # noqa: E402

GOLDEN = ROOT / "tests" / "golden.json"
WRITE = "python tests/golden.py"
DIGITS = 9  # significant digits of stored numbers
LIBRARIES = ("numpy", "scipy", "numba", "torch")
Row = dict[str, Any]

BANDS = tuple(range(8, 264, 8))  # 32 of the farm's 270
FARM: dict[str, Any] = {"scene": "farm", "size": "128x96", "bands": BANDS, "seed": 0, "camera": {"samples": 80}}
NAMED = {"effects": "rotation,slit,smear,shot,read-noise"}
TWO_PASSES = {"budget": 0.8, **NAMED}
POSE = {"lon_deg": 9.5, "lat_deg": 52.1, "heading_deg": 25.0, "tilt_deg": 50.0, "height_m": 1400.0}
AREA = ((9.5070913, 52.1094775), (9.5073837, 52.1095032), (9.5073562, 52.1096561), (9.5071223, 52.1096302))
HOLE = ((9.5072089, 52.1095399), (9.5072673, 52.1095396), (9.5072677, 52.1095756), (9.5072093, 52.1095759))
RIG = {"visit": "first", "rig": {"mirror_driver": "fake", "camera_driver": "fake"}}
STORED = 3  # stages that a survey has stored when it is killed


# --- the surveys ------------------------------------------------------------------------------------------------------


def survey(out: Path, **asked: Any) -> OpenedRun:
    """Survey the farm, or a field of the same size, into an archive with the plain engine."""
    return spectralzoom.survey(_flags(out, asked))


def _flags(out: Path, asked: Mapping[str, Any]) -> dict[str, Any]:
    return {**FARM, **asked, "out": str(out / "archive"), "engine": "plain"}


def survey_raster(out: Path) -> OpenedRun:
    """Survey the pixels of a picture of patches of soil, crops and weeds, as they are in the file."""
    rng = np.random.default_rng(0)
    nm = np.linspace(420, 950, 24)
    edge = 1 / (1 + np.exp(-(nm - 715) / 15))  # of green plants
    spectra = np.stack([0.1 + 0.2 * (nm - 420) / 530, 0.04 + 0.45 * edge, 0.06 + 0.3 * edge, np.full(24, 0.12)])
    kinds = rng.integers(0, 4, (9, 12)).repeat(11, axis=0).repeat(11, axis=1)[:96, :128]
    values = spectra[kinds] * rng.normal(1, 0.05, (96, 128, 1)) + rng.normal(0, 0.004, (96, 128, 24))
    np.save(out / "picture.npy", np.maximum(values, 0).astype(np.float32))
    picture = {"scene": str(out / "picture.npy"), "wavelengths": nm.round(1).tolist(), "weights": "farm"}
    return survey(out, **picture, bands=None, size=None, camera={})


def survey_recording(out: Path) -> OpenedRun:
    """Survey lines that were recorded as ENVI cubes with a pointing table each."""
    simulated = survey(out / "sim", scan_step=2, keep="raw", **NAMED)
    (out / "sweeps").mkdir()
    for name, sweep in simulated.sweeps.items():
        _write_recording(out / "sweeps" / name, sweep)
    return survey(out, sweeps=str(out / "sweeps"), scene="field", weights="farm", bands=None, camera={})


def _write_recording(path: Path, sweep: xr.Dataset) -> None:
    """Write raw lines as a BIL file, their positions as a table, and the references as frames of one line."""
    _write_envi(path, sweep["dn"], "u2", {"line axis": json.loads(sweep.attrs["sweep"])["along"]})
    white = ", ".join(repr(float(value)) for value in sweep["white_reference"].values)
    for kind, more in (("dark", {}), ("white", {"white_reference": f"{{{white}}}", "mirror at rest": "1"})):
        _write_envi(Path(f"{path}.{kind}"), sweep[kind].expand_dims("line"), "f4", more)
    table = sweep[["time", "mirror_x", "mirror_y", "exposure_ms", "valid_line"]].to_dataframe()
    columns = {name: table[name].to_list() for name in ("time", "mirror_x", "mirror_y", "exposure_ms")}
    rows = [",".join(["line", *columns, "valid"])]
    for number, values in enumerate(zip(*columns.values(), strict=True)):
        rows.append(",".join([str(number), *map(repr, values), str(int(table["valid_line"].iloc[number]))]))
    Path(f"{path}.pointing.csv").write_text("\n".join(rows) + "\n")


def _write_envi(path: Path, values: xr.DataArray, dtype: str, more: Mapping[str, str]) -> None:
    cube = values.transpose("line", "band", "sample").values.astype(f"<{dtype}")
    cube.tofile(f"{path}.bil")
    each = {name: ", ".join(map(repr, values[name].values.tolist())) for name in ("wavelength", "fwhm")}
    header = {
        **{"samples": cube.shape[2], "lines": cube.shape[0], "bands": cube.shape[1], "header offset": 0},
        **{"file type": "ENVI Standard", "data type": {"u2": 12, "f4": 4}[dtype], "interleave": "bil", "byte order": 0},
        **{"wavelength units": "Nanometers", **{name: f"{{{numbers}}}" for name, numbers in each.items()}, **more},
    }
    Path(f"{path}.hdr").write_text("ENVI\n" + "".join(f"{name} = {value}\n" for name, value in header.items()))


def survey_rig(out: Path) -> OpenedRun:
    """Survey the farm through fake devices that see the simulated one."""
    return survey(out, source="rig", budget=0.8, effects=NAMED["effects"], **RIG)


def survey_area(out: Path) -> OpenedRun:
    """Survey a polygon with a hole in a field with a pose."""
    outline = [[list(place) for place in (*ring, ring[0])] for ring in (AREA, HOLE)]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": outline}}
    (out / "area.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return survey(out, budget=0.8, effects="none", pose=POSE, area=str(out / "area.geojson"))


def survey_killed(out: Path) -> OpenedRun:
    """Survey in another process, kill it once it has stored some stages, and resume."""
    program = "import json, sys, spectralzoom; spectralzoom.survey(json.loads(sys.argv[1]))"
    words = [sys.executable, "-c", program, json.dumps(_flags(out, TWO_PASSES))]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as child:
        while len(list((out / "archive").glob("stages/*/*/manifest.json"))) < STORED:
            if child.poll() is not None:
                raise RuntimeError(f"the survey ended before it was killed: {child.communicate()[1]}")
            time.sleep(0.005)
        child.kill()
    if list((out / "archive").glob("runs/*/receipt.json")):
        raise RuntimeError(f"the survey had ended when it was killed; kill it earlier than after {STORED} stages")
    return survey(out, **TWO_PASSES)


SURVEYS: dict[str, Callable[[Path], OpenedRun]] = {
    "uniform": lambda out: survey(out, scan_step=2),
    "two passes": lambda out: survey(out, **TWO_PASSES),
    "raster": survey_raster,
    "recording": survey_recording,
    "rig": survey_rig,
    "pose": lambda out: survey(out, scan_step=1, effects="none", pose=POSE),
    "area of interest": survey_area,
    "killed and resumed": survey_killed,
}


# --- rows -------------------------------------------------------------------------------------------------------------

LEFT_OUT = {  # parts of a receipt that are no figures, or differ from run to run
    **dict.fromkeys(("settings", "stages", "products", "versions", "seed"), "given or named"),
    **dict.fromkeys(("data_bytes.written", "data_bytes.kept"), "of compressed files"),
    "effects_total.saved_s": "of the machine",
    **dict.fromkeys(("accuracy.none", "accuracy.all", "accuracy.controls", "accuracy.confusion"), "of other maps"),
}


def row(name: str, out: Path) -> Row:
    """Run one of the surveys in an empty folder, and return its results by name."""
    run = SURVEYS[name](out)
    mosaic, drawn = run.dataset("mosaic"), run.dataset("class_map")
    scores = mosaic["scores"].transpose("component", "y", "x")
    step = scores.attrs["scale_factor"]
    found: Row = {
        "mosaic sha256": _digest(scores, mosaic["y"], mosaic["x"], step),
        "components sha256": _digest(mosaic["mean"], mosaic["axes"].transpose("component", "band")),
        "class map sha256": _digest(drawn["classes"].transpose("y", "x"), ",".join(run.class_names)),
        "mosaic step": step,
    }
    if sweeps := run.lines:
        placed = [sweeps[name][axis] for name in sorted(sweeps) for axis in ("time", "mirror_x", "mirror_y")]
        found["lines sha256"] = _digest(",".join(sorted(sweeps)), *placed)
        for axis in ("x", "y"):
            largest = [float(abs(sweep[f"mirror_{axis}"]).max()) for sweep in sweeps.values()]
            found[f"mirror {axis} sum of largest"] = sum(largest)
    if "ground_map" in run.products:
        found["ground map sha256"] = _digest(run.ground_map["classes"].transpose("y", "x"))
    for number, plane in enumerate(scores.values * step):
        found |= {f"component {number:02} mean": plane.mean(), f"component {number:02} std": plane.std()}
    found |= {f"px {kind}": (drawn["classes"].values == at).sum() for at, kind in enumerate(run.class_names)}
    found |= {f"effect {one['name']}": one["variant"] for one in run.receipt.get("effects", ()) if one["state"] == "on"}
    found |= dict(_figures(run.receipt))
    return {key: _rounded(value) for key, value in found.items()}


def _digest(*parts: xr.DataArray | str | float) -> str:
    """Return the SHA-256 of arrays, with their shapes and types, and of plain values."""
    digest = hashlib.sha256()
    for part in parts:
        values = part.values if isinstance(part, xr.DataArray) else np.frombuffer(repr(part).encode(), np.uint8)
        digest.update(f"{values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _figures(part: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number of a receipt by its place, such as ``savings.lines.done``."""
    if name in LEFT_OUT:
        return
    if isinstance(part, Mapping):
        for key, value in part.items():
            yield from _figures(value, f"{name}.{key}" if name else key)
    elif isinstance(part, list):
        for number, value in enumerate(part if name != "effects" else ()):
            yield from _figures(value, f"{name}.{number}")
    elif isinstance(part, int | float):
        yield name, part


def _rounded(value: Any) -> Any:
    """Return a plain value; a float with `DIGITS` significant digits."""
    value = value.item() if isinstance(value, np.generic) else value
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def machine() -> dict[str, str]:
    """Return what the rounding of results depends on: instructions of the processor, and libraries."""
    blas = {one.get("architecture", "?") for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"}
    processor = {"torch instructions": torch.backends.cpu.get_cpu_capability(), "blas kernels": ", ".join(sorted(blas))}
    return processor | {name: version(name) for name in LIBRARIES}


# --- comparison -------------------------------------------------------------------------------------------------------


def close(name: str, expected: Any, found: Any, row: Row) -> bool:
    """Return whether a value is that of another machine but for rounding; hashes always are.

    Scores of a component may differ by 1 % of their standard deviation, pixels of a class by 0.1 % of all pixels.
    Positions of the mirror may differ by a millionth, other numbers by 1 % or 0.01. Other kernels of torch and OpenBLAS
    on one processor change figures by a hundred-thousandth at most.
    """
    if name.endswith("sha256"):
        return True
    if isinstance(expected, str) or isinstance(found, str) or None in (expected, found):
        return bool(expected == found)
    most = max(0.01, 0.01 * abs(expected))
    if name.startswith("component"):
        most = 0.01 * row[name.replace("mean", "std")] + row["mosaic step"] / 10
    elif name.startswith("mirror"):
        most = 1e-6 * abs(expected)
    elif name.startswith("px "):
        most = max(most, 0.001 * sum(value for key, value in row.items() if key.startswith("px ")))
    return bool(abs(expected - found) <= most)


def differences(expected: Row, found: Row, *, exact: bool) -> list[str]:
    """Return a line for each value that differs, is missing or is new."""
    missing = object()
    wrong = []
    for name in {**expected, **found}:
        before, now = expected.get(name, missing), found.get(name, missing)
        if before is missing or now is missing:
            wrong.append(f"{name}: {'new' if before is missing else 'missing'}, {now if before is missing else before}")
        elif before != now and (exact or not close(name, before, now, expected)):
            wrong.append(f"{name}: expected {before}, found {now}")
    return wrong


def complaint(name: str, wrong: list[str], golden: Mapping[str, Any]) -> str:
    """Return the message of a survey whose row differs."""
    here = machine()
    other = [
        f"{key} {golden['machine'][key]} there, {here[key]} here" for key in here if here[key] != golden["machine"][key]
    ]
    how = f"within tolerances, as the file is of another machine ({'; '.join(other)})" if other else "exactly"
    return "\n  ".join(
        [
            f"survey {name!r} differs from its row in {GOLDEN.name}, compared {how}:",
            *wrong,
            f"If this is on purpose, write it by `{WRITE} --only {name!r}`, and say why in the commit.",
        ]
    )


def load() -> dict[str, Any]:
    """Return the machine and the rows of the file."""
    found: dict[str, Any] = json.loads(GOLDEN.read_text())
    return found


def main() -> None:
    """Write the rows anew, all or some, and print what changed."""
    parser = ArgumentParser(description=__doc__, prog=WRITE)
    parser.add_argument("--only", nargs="+", choices=SURVEYS, default=list(SURVEYS), metavar="NAME")
    asked = parser.parse_args().only
    known = load() if GOLDEN.exists() else {"machine": machine(), "surveys": {}}
    if known["machine"] != machine() and set(asked) != set(SURVEYS):
        parser.error("the file is of another machine; write all rows, without --only")
    rows: dict[str, Row] = {name: one for name, one in known["surveys"].items() if name in SURVEYS}
    for name in asked:
        with tempfile.TemporaryDirectory(prefix="golden-") as folder:
            began = time.monotonic()
            found = row(name, Path(folder))
        print(f"{name}: {time.monotonic() - began:.1f} s", flush=True)
        for line in differences(rows.get(name, {}), found, exact=True) if name in rows else ():
            print(f"  {line}")
        rows[name] = found
    content = {"machine": machine(), "surveys": {name: rows[name] for name in SURVEYS if name in rows}}
    GOLDEN.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
