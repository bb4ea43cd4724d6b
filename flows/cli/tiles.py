"""Survey the scenes of a folder or pattern one by one: settings of each, and a table of the outcomes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spectralzoom.flows.opening.scene import DATE, check_scene_there
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.publish.scores import format_prediction, warnings_of
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RASTER, SIM
from spectralzoom.flows.terminal.figures import format_percent, format_points, format_seconds, spaced
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.readers.array_files import find_zarr_store
from spectralzoom.storage.readers.envi_files import is_headwall_folder
from spectralzoom.storage.readers.label_files import find_files, is_label_name

PATTERN = "*?["
MOST_CLASSES = 3  # in a row
COLUMNS = ("tile", "score", "time", "classes")


def tiles_of(settings: Settings) -> list[Settings]:
    """Return the settings of each scene in the folder or pattern of ``settings``; of one scene, these alone.

    A Zarr store and the folder of a Headwall camera are one scene. Raises SceneError: there is no image.
    """
    scene = settings.scene
    path = Path(scene)
    if settings.source not in (SIM, RASTER) or scene in BUILT_IN_SCENES or DATE in scene:
        return [settings]
    is_pattern = any(sign in scene for sign in PATTERN) and not path.exists()
    if not is_pattern:
        check_scene_there(scene)
        if not path.is_dir() or find_zarr_store(path) is not None or is_headwall_folder(path):
            return [settings]
    found = (
        sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor)))) if is_pattern else find_files(path).images
    )
    files = [file for file in found if not is_label_name(file)] or found
    if not files:
        raise SceneError(f"no file matches --scene {scene}; check the pattern (seen from {Path.cwd()})")
    if len(files) > 1 and settings.labels is not None:
        raise SceneError(
            f"--scene {scene} has {len(files)} scenes, and --labels fits one; lay labels beside each scene"
        )
    prefix = "" if settings.name is None else f"{settings.name}-"
    return [settings.but(scene=str(file), name=f"{prefix}{file.stem}") for file in files]


def tile_row(scene: str, published: Published, seconds: float) -> list[str]:
    """Return the row of a surveyed tile: score by labels, else expected, warning or confidence; commonest classes."""
    receipt = published.receipt
    expected = receipt.get("expected") or {}
    if (accuracy := receipt.get("accuracy")) is not None:
        score = f"mIoU {format_points(accuracy['miou'])}"
    elif warnings_of(receipt):
        score = "warning"
    elif predicted := format_prediction(expected.get("miou"), expected.get("error")):
        score = f"expected mIoU {predicted}"
    else:
        drawn = load_class_map(published.folder.parent.parent / receipt["products"]["class_map"])
        known = drawn.confidence[np.isfinite(drawn.confidence)]
        score = f"confidence {format_points(float(known.mean()) if known.size else None)}"
    pixels = receipt["areas"]["px"]
    most = sorted((name for name in pixels if pixels[name]), key=lambda name: -pixels[name])[:MOST_CLASSES]
    classes = ", ".join(f"{spaced(name)} {format_percent(pixels[name] / sum(pixels.values()))}" for name in most)
    return [scene, score, format_seconds(seconds), classes]
