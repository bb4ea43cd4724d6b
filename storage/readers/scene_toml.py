"""``scene.toml``: what a scene file does not say about itself, read and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from pipeline.errors import SceneError
from storage.archive.toml_files import read_toml

SETTINGS_NAME = "scene.toml"

Colour = tuple[int, int, int]
ClassValue = int | Colour


@dataclass(frozen=True)
class SceneSettings:
    """Content of one ``scene.toml``. Everything is optional; ``path`` is None where there is no such file."""

    path: Path | None = None
    bands: tuple[int, ...] | None = None  # of the file, counted from 0
    wavelengths_nm: tuple[float, ...] | None = None  # of ``bands``, or of all bands of the file
    wavelengths_file: Path | None = None  # rows of nm and FWHM, all bands of the file and the dropped ones
    dropped_bands: tuple[int, ...] = ()  # rows of wavelengths_file that the file leaves out, counted from 1
    nodata: float | None = None  # the number that stands for no value
    labels: str | None = None  # relative to the folder of scene.toml; may hold {number}
    unlabelled: ClassValue | None = None
    classes: Mapping[str, ClassValue] = field(default_factory=dict)


KNOWN_KEYS = tuple(one.name for one in fields(SceneSettings) if one.name != "path")


def find_scene_settings(scene: Path) -> SceneSettings:
    """Read the ``scene.toml`` beside a scene file, or above it where the file lies in a folder ``images``.

    Raises
    ------
    SceneError : the file is no TOML, has a key that is not known, or a value of the wrong kind.
    """
    candidates = [scene.parent / SETTINGS_NAME]
    if scene.parent.name == "images":
        candidates.append(scene.parent.parent / SETTINGS_NAME)
    found = next((path for path in candidates if path.is_file()), None)
    return SceneSettings() if found is None else load_scene_settings(found)


def load_scene_settings(path: Path) -> SceneSettings:
    """Read one ``scene.toml``; errors as for :func:`find_scene_settings`."""
    try:
        content = read_toml(path)
    except (FileNotFoundError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as TOML: {error}; correct it or take it away") from error
    unknown = sorted(set(content) - set(KNOWN_KEYS))
    if unknown:
        raise SceneError(f"{path} has the unknown key {', '.join(unknown)}; known are {', '.join(KNOWN_KEYS)}")
    if "wavelengths_nm" in content and "wavelengths_file" in content:
        raise SceneError(f"{path} has both wavelengths_nm and wavelengths_file; keep one")
    file_name = _text(path, content, "wavelengths_file")
    return SceneSettings(
        path=path,
        bands=_whole_numbers(path, content, "bands"),
        wavelengths_nm=_numbers(path, content, "wavelengths_nm"),
        wavelengths_file=None if file_name is None else path.parent / file_name,
        dropped_bands=_whole_numbers(path, content, "dropped_bands") or (),
        nodata=_number(path, content, "nodata"),
        labels=_text(path, content, "labels"),
        unlabelled=None if "unlabelled" not in content else _class_value(path, "unlabelled", content["unlabelled"]),
        classes=_classes(path, content.get("classes", {})),
    )


def _text(path: Path, content: Mapping[str, Any], key: str) -> str | None:
    value = content.get(key)
    if value is not None and not isinstance(value, str):
        raise SceneError(f"{path}: {key} must be a file name in quotes, got {value!r}")
    return value


def _numbers(path: Path, content: Mapping[str, Any], key: str) -> tuple[float, ...] | None:
    value = content.get(key)
    if value is None:
        return None
    if not isinstance(value, list) or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        raise SceneError(f"{path}: {key} must be a list of numbers such as [660.0, 800.0], got {value!r}")
    return tuple(float(v) for v in value)


def _number(path: Path, content: Mapping[str, Any], key: str) -> float | None:
    value = content.get(key)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise SceneError(f"{path}: {key} must be a number such as -9999 or 1e30, got {value!r}")
    return None if value is None else float(value)


def _whole_numbers(path: Path, content: Mapping[str, Any], key: str) -> tuple[int, ...] | None:
    value = content.get(key)
    if value is None:
        return None
    if not isinstance(value, list) or any(isinstance(v, bool) or not isinstance(v, int) for v in value):
        raise SceneError(f"{path}: {key} must be a list of whole numbers such as [0, 1], got {value!r}")
    return tuple(value)


def _class_value(path: Path, name: str, value: object) -> ClassValue:
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, int) and 0 <= v <= 255 for v in value):
        return value[0], value[1], value[2]
    raise SceneError(f"{path}: {name} must be a whole number or a colour [r, g, b] in 0..255, got {value!r}")


def _classes(path: Path, value: object) -> dict[str, ClassValue]:
    if not isinstance(value, dict):
        raise SceneError(f"{path}: classes must be a table of name = number or name = [r, g, b], got {value!r}")
    classes = {name: _class_value(path, f"class {name}", entry) for name, entry in value.items()}
    if len({isinstance(entry, tuple) for entry in classes.values()}) > 1:
        raise SceneError(f"{path}: some classes are numbers and some are colours; use one kind")
    if len(set(classes.values())) < len(classes):
        raise SceneError(f"{path}: two classes have the same number or colour; give each its own")
    if len(classes) > 255:
        raise SceneError(f"{path}: {len(classes)} classes, at most 255 fit a class map; merge some")
    return classes
