"""Helpers that write small surveys without sensor data: stores that depend on each other, and runs that name them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spectralzoom.storage.arrays.class_maps import ClassMap, create_class_map, write_class_tile
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, Ref, manifest_text


@dataclass(frozen=True)
class Small:
    """Stores of one survey: raw lines, their mosaic, a map of both, and the run that names them, if any."""

    raw: Ref
    mosaic: Ref
    map: Ref
    run: Path = Path("no run")


def settings(seed: int = 0, **more: Any) -> dict[str, Any]:
    """Return the survey's settings as a receipt holds them."""
    return {"scene": "farm", "source": "sim", "seed": seed, "budget": 0.5, **more}


def small_survey(
    archive: Archive, *, seed: int = 0, kernel: str = "bilinear", named: bool = True, simulated: bool = True
) -> Small:
    """Make (or find) the stores of one survey, and a run that rests on them where ``named``."""
    light = {"scene": "farm", "seed": seed, "source": "sim" if simulated else "rig"}
    raw = make_store(archive, "capture", {"light": light}, [])
    mosaic = make_store(archive, "rectify", {"grid": {"height": 8, "width": 8}, "kernel": kernel}, [raw])
    drawn = make_store(archive, "segment", {"weights": "w0"}, [mosaic, raw])
    if not named:
        return Small(raw, mosaic, drawn)
    receipt = {
        "survey": "farm",
        "settings": settings(seed, kernel=kernel, source="sim" if simulated else "rig"),
        "stages": [{"name": "capture_coarse", "key": raw.key, "state": "ran", "wall_s": 1.5, "cpu_s": 1.0}],
        "products": {"class_map": f"{drawn.uri}/class_map.zarr", "mosaic": f"{mosaic.uri}/mosaic.zarr"},
    }
    return Small(raw, mosaic, drawn, publish_receipt(archive, receipt, drawn, settings=receipt["settings"]))


def publish_receipt(archive: Archive, receipt: Any, *inputs: Ref, name: str = "farm", **facts: Any) -> Path:
    """Publish a run with a receipt alone, a table or its text."""

    def write(folder: Path, uri: str) -> dict[str, Any]:
        (folder / "receipt.json").write_text(receipt if isinstance(receipt, str) else json.dumps(receipt))
        return facts

    return archive.publish_run(name, write, inputs)


def make_store(archive: Archive, stage: str, params: dict[str, Any], inputs: list[Ref]) -> Ref:
    """Make (or find) a store of one file."""

    def build(path: Path) -> None:
        (path / "data.bin").write_bytes(json.dumps([stage, params]).encode() * 40)

    return archive.produce(stage, build, version=1, params=params, inputs=inputs)[0]


def flip(path: Path, at: int = -3, bit: int = 2) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def rewrite(path: Path, **facts: Any) -> None:
    """Change facts of a manifest and write a valid checksum."""
    content = {name: value for name, value in json.loads(path.read_text()).items() if name != "seal"} | facts
    path.write_text(manifest_text(content))


def grow_old(ref: Ref, days: float) -> None:
    """Set a store's date back, in its manifest and on its file."""
    path = ref.path / "manifest.json"
    rewrite(path, created="2020-01-01T00:00:00+00:00")
    moment = path.stat().st_mtime - days * 86_400
    os.utime(path, (moment, moment))


def problems(archive: Archive) -> list[str]:
    """Return the problems that `verify` finds."""
    return [f"{one.uri} {one.problem}" for one in verify_everything(archive) if one.problem is not None]


def write_class_map(path: Path, found: ClassMap, grid: AngularGrid | None = None) -> None:
    """Store a whole class map at once; stages write it tile by tile."""
    create_class_map(path, found.classes.shape, found.legend, grid=grid)
    write_class_tile(path, (0, 0), found.classes, found.confidence)
