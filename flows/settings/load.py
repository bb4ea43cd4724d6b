"""Read tables of settings from files and flags, and say in one sentence what is wrong with one."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Any

from pydantic import BaseModel, ValidationError

from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RIG_FIELD
from spectralzoom.pipeline.errors import BudgetError, SettingsError
from spectralzoom.pipeline.toml_files import read_toml

OF_A_SCENE = "scene.toml"
FLAG = "flag"  # origin of a setting that no file has
PATHS = ("scene", "labels", "sweeps", "pointing", "dark", "white", "out", "mask", "weights", "area", "plots")
Schema = dict[str, Any]  # of one setting, in JSON: its type, limits, default and help


@cache
def declared(model: type[BaseModel]) -> dict[str, dict[str, Schema]]:
    """Return the schema of each setting by its table and name; the table "" has those of no table."""
    whole = model.model_json_schema()
    found: dict[str, dict[str, Schema]] = {"": {}}
    for name, about in whole["properties"].items():
        if "$ref" in about:
            table = whole["$defs"][about["$ref"].rpartition("/")[2]]
            found[name] = table["properties"] | table["hidden"]
        elif "group" in about:
            found[""][name] = about
    return found


def allowed(about: Schema) -> str:
    """Return the allowed values of a setting, as after "must be"; empty for a type that says them itself."""
    if "enum" in about:
        return f"one of {listed(about)}"
    low, high, unit = about.get("minimum"), about.get("maximum"), about.get("unit")
    kind = about.get("type")
    if kind == "integer":
        return f"a whole number from {low} to {high}"
    if kind == "number":
        span = f"of at least {low:g}" if high is None else f"from {low:g} to {high:g}"
        return f"a number {span}" + (f" {unit}" if unit else "") + (" or inf" if about.get("usual") == "inf" else "")
    return {"boolean": "true or false", "string": "text that is not empty"}.get(str(kind), "")


def listed(about: Schema) -> str:
    """Return the words of a setting with a fixed list as text; empty for others."""
    words = about.get("enum", ())
    return ("  " if any("," in word for word in words) else ", ").join(words)


def flag_of(key: str, *, off: bool = False) -> str:
    """Return the flag of a setting such as ``camera.samples``, or the one that turns it ``off``."""
    table, dot, own = key.replace("_", "-").rpartition(".")
    return f"--{table}{dot}{'no-' if off else ''}{own}"


def place_of(key: str, origin: Mapping[str, str]) -> str:
    """Return how a message names a setting: as a flag, or with its file."""
    place = origin.get(key) or origin.get(key.partition(".")[0])
    if place == FLAG:
        return flag_of(key)
    return f"'{key}'" + (f" in {place}" if place else "")


def read_file(path: str | Path | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the settings of a file, and its name for each key. Relative paths in it start at its folder.

    Raises SettingsError: it cannot be read.
    """
    if path is None:
        return {}, {}
    scene = f"; a scene is given as: spectralzoom survey --scene {quote(str(path))}"
    hint = "" if Path(path).suffix == ".toml" else scene
    if Path(path).name == OF_A_SCENE:
        raise SettingsError(f"{path} describes a scene: give the scene's file as --scene, or name settings otherwise")
    try:
        table = anchor_paths(read_toml(Path(path)), Path(path).parent)
    except FileNotFoundError:
        raise SettingsError(f"no settings file {path}; give the path of a survey's TOML file, or none{hint}") from None
    except ValueError as error:
        raise SettingsError(f"cannot read the settings file {path}: {error}; expected TOML in UTF-8{hint}") from None
    return table, dict.fromkeys(_keys(table), str(path))


def _keys(table: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of a table and of the tables in it."""
    for name, value in table.items():
        yield name
        yield from (f"{name}.{key}" for key in value) if isinstance(value, Mapping) else ()


def nested(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings called ``camera.exposure_ms`` as tables."""
    found: dict[str, Any] = {}
    for key, value in flags.items():
        head, _, tail = key.rpartition(".")
        found = merged(found, {head: {tail: value}} if head else {key: value})
    return found


def unnested(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of tables called ``camera.exposure_ms``: the inverse of `nested`."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= {f"{name}.{key}": one for key, one in value.items()} if isinstance(value, Mapping) else {name: value}
    return found


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return two tables as one; ``above`` wins, key by key also in tables."""
    found = {**below, **above}
    for name, inner in above.items():
        if isinstance(inner, Mapping) and isinstance(below.get(name), Mapping):
            found[name] = {**below[name], **inner}
    return found


def anchor_paths(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return settings with relative paths that start at ``folder``. Raises SettingsError: there is no such user."""
    anchored = dict(table)
    for key in PATHS:
        value = anchored.get(key)
        if isinstance(value, str) and value and value not in (*BUILT_IN_SCENES, RIG_FIELD) and "://" not in value:
            try:
                anchored[key] = str(folder / Path(value).expanduser())
            except RuntimeError:
                raise SettingsError(f"{key!r}: there is no user of {value.partition('/')[0]!r}; give a path") from None
    return anchored


def known_only(table: Mapping[str, Any], model: type[BaseModel], origin: Mapping[str, str]) -> dict[str, Any]:
    """Return a table without absent values. Raises SettingsError: it has an unknown key, or true as a number."""
    tables = declared(model)
    found = {str(name): value for name, value in table.items() if value is not None}
    for name, value in found.items():
        if name not in tables or not name:
            _check("", name, value, tables, origin)
        elif isinstance(value, Mapping):
            found[name] = {key: one for key, one in value.items() if one is not None}
            for key, one in found[name].items():
                _check(name, key, one, tables, origin)
        elif not is_dataclass(value):  # which Python gives
            raise SettingsError(f"{place_of(name, origin)} must be a table, [{name}] with keys below it; got {value!r}")
    return found


def _check(head: str, key: str, value: object, tables: Mapping[str, Any], origin: Mapping[str, str]) -> None:
    """Raise SettingsError for an unknown key, or for true as a number."""
    prefix = f"{head}." if head else ""
    place = place_of(prefix + key, origin)
    if key in tables[head]:
        if isinstance(value, bool) and tables[head][key].get("type") in ("integer", "number"):
            raise SettingsError(f"{place} must be {allowed(tables[head][key])}, got {value!r}")
        return
    own = [*tables[head], *(name for name in tables if name and not head)]
    near = [f"{name}.{key}".lstrip(".") for name, keys in tables.items() if key in keys]
    near = near or [prefix + name for name in difflib.get_close_matches(key, own, n=1, cutoff=0.6)]
    hint = f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(prefix + name for name in own)}"
    raise SettingsError(f"unknown setting {place}; {hint}")


def sentence_of(error: ValidationError, model: type[BaseModel], origin: Mapping[str, str]) -> Exception:
    """Return the first mistake in a table of settings as an error of one sentence, with its place."""
    first = error.errors()[0]
    head, *tail = map(str, first["loc"][:2])
    key = ".".join((head, *tail))
    cause = first.get("ctx", {}).get("error")
    tables = declared(model)
    if first["type"] == "missing":
        missing = [str(one["loc"][1]) for one in error.errors() if one["type"] == "missing" and one["loc"][0] == head]
        return SettingsError(f"[{head}] lacks {', '.join(missing)}; give every one, or leave the table out")
    if key in tables:
        wrong = cause or f"must be a table with its keys below it, got {first['input']!r}"
        return SettingsError(f"[{key}]: {wrong}")
    place = place_of(key, origin)
    if isinstance(cause, Exception):
        joint = ": " if isinstance(cause, SettingsError) else " "
        return (BudgetError if isinstance(cause, BudgetError) else SettingsError)(f"{place}{joint}{cause}")
    about = tables[head][tail[0]] if tail and head in tables else tables[""][head]
    return SettingsError(f"{place} must be {allowed(about)}{';' if 'enum' in about else ','} got {first['input']!r}")
