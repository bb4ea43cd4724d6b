"""What `spectralzoom compare` does: two runs of one field side by side, and a picture of where they differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.cli.app import ArchiveName, AsJson, OutFolder, check_outside
from flows.publish.change_pictures import MapPair, draw_difference
from flows.publish.receipt import areas_on_ground
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.tasks.scores import score_of
from flows.terminal.figures import DASH, format_count, format_percent, format_points, format_seconds, known_number
from flows.terminal.processes import DONE
from flows.terminal.progress import put_out
from pipeline.errors import ArchiveError, SceneError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.simulator.scenes.farm.farm_scene import REMOVED_LAW, law_of_key
from storage.archive.archive import Archive
from storage.archive.keys import in_text
from storage.archive.lineage import ABSENT, Catalogue, find_product, flatten
from storage.archive.records import Run
from storage.archive.whole_files import written_aside
from storage.arrays.class_maps import ClassMap, load_class_map
from storage.remote.opening import open_archive

LARGEST_PAIRS = 10
SAVINGS = {  # name in a receipt: words for it, and how it is shown
    "lines": ("lines", format_count),
    "capture_s": ("time of capture", format_seconds),
    "tokens": ("tokens", format_count),
}
NOT_ASKED = ("notes", "out")  # of a receipt's settings
NO_FILES = (None, *BUILT_IN_SCENES, REMOVED_LAW)  # scenes of runs that are no file's


def compare(archive: ArchiveName, old: str, new: str, *, out: OutFolder = None, as_json: AsJson = False) -> int:
    """Compare two runs of one field: classes, where they differ, what was asked and spent, and a picture.

    Parameters
    ----------
    old
        Run A: its name, a folder's below runs, `latest`, or `previous`, the one before it of the same field.
    new
        Run B, likewise.
    out
        Folder for the picture; beside the archive without one.
    """
    opened = open_archive(archive, create=False, write=False)
    folder = opened.around if out is None else check_outside(out, opened.root)
    catalogue = Catalogue.read(opened.root)
    runs = (find_run(catalogue, old), find_run(catalogue, new))
    for run in runs:
        if "class_map" not in run.products:
            raise ArchiveError(f"{run.uri} has no class map to compare: {run.problem or 'it left none'}; see verify")
    if not _is_same_field(*runs):
        scenes = ((run, run.settings.get("scene")) for run in runs)
        fields = (f"{run.uri} is of {_field_key(run) if scene in NO_FILES else scene}" for run, scene in scenes)
        raise SceneError(f"these runs are of different fields: {', '.join(fields)}; give two runs of one field")
    pair = _pair_of([_class_map(catalogue, opened, run) for run in runs])
    content = _comparison(catalogue, runs, pair)
    name = f"compare-{runs[0].folder.name}-{runs[1].folder.name}.png"
    words = [*(panel_words(side) for side in (content["a"], content["b"])), change_words(content["differing"])]
    with written_aside(folder, [name]) as aside:
        (aside / name).write_bytes(draw_difference(pair.maps, words))
    content["picture"] = str(folder / name)
    put_out(content, show_comparison, as_json=as_json)
    return DONE


def find_run(catalogue: Catalogue, text: str) -> Run:
    """A run by its id, `latest` (the newest with a map) or `previous`, of the same field before it (ArchiveError)."""
    mapped = [run for run in catalogue.runs if "class_map" in run.products]
    if text not in ("latest", "previous"):
        found = find_product(catalogue, f"runs/{text.rstrip('/').removeprefix('runs/')}")
        assert isinstance(found, Run)
        return found
    if not mapped:
        raise ArchiveError("no run of this archive has left a class map that can be read; see ls")
    if text == "latest":
        return mapped[-1]
    before = [run for run in mapped[:-1] if _is_same_field(run, mapped[-1])]
    if not before:
        raise ArchiveError(f"there is no run of the field of {mapped[-1].uri} before it; see ls, and give two runs")
    return before[-1]


def _is_same_field(old: Run, new: Run) -> bool:
    """By the scene's key without its bands, or by the scene's file, which may show the field as it is now."""
    files = [run.settings.get("scene") for run in (old, new)]
    same_file = files[0] == files[1] and files[0] not in NO_FILES
    return _field_key(old) == _field_key(new) or same_file


def _field_key(run: Run) -> str:
    """What names the land: not the bands, nor the day and hour at which a farm was looked at."""
    key = str(run.receipt.get("scene", run.uri)).split("/bands=")[0].split("/only=")[0]
    if law_of_key(key) is None:
        return key
    return "/".join(part for part in key.split("/") if not part.startswith(("day=", "hour=")))


def _class_map(catalogue: Catalogue, archive: Archive, run: Run) -> ClassMap:
    address = run.products["class_map"]
    store = in_text(address)
    if store not in catalogue.stores or catalogue.stores[store].problem is not None:
        raise ArchiveError(f"the class map {address} of {run.uri} is missing or damaged; run verify --repair")
    return load_class_map(archive.locate(address))


class _Pair(NamedTuple):
    """Two maps with one list of classes, matched by name, and how often each meets each."""

    maps: MapPair
    joint: NDArray[np.int64]  # (class of A, class of B), last: none
    confidence: list[NDArray[np.float32]]


def _pair_of(found: list[ClassMap]) -> _Pair:
    shapes = [one.classes.shape for one in found]
    if shapes[0] != shapes[1]:
        raise ShapeError(f"the maps are {shapes[0]} and {shapes[1]} px (y, x); give two runs of one field and size")
    names = tuple(dict.fromkeys(name for one in found for name in one.names))
    colours = {name: colour for one in reversed(found) for name, colour in zip(one.names, one.colours, strict=True)}
    numbered = []
    for one in found:
        table = np.full(256, UNLABELLED, np.uint8)
        table[: len(one.names)] = [names.index(name) for name in one.names]
        numbered.append(np.asarray(table[one.classes], np.uint8))
    old, new = numbered
    none, count = len(names), len(names) + 1
    codes = np.minimum(old, none).astype(np.intp) * count + np.minimum(new, none)
    joint = np.bincount(codes.ravel(), minlength=count * count).reshape(count, count)
    palette = np.array([colours[name] for name in names], np.uint8).reshape(-1, 3)
    changed = joint - np.diag(np.diag(joint))
    order = np.argsort(-changed, axis=None, kind="stable")[: np.count_nonzero(changed)]
    numbers = [*range(none), UNLABELLED]
    pairs = [(numbers[i // count], numbers[i % count], int(changed.flat[i])) for i in order.tolist()]
    return _Pair(MapPair(old, new, names, palette, pairs), joint, [one.confidence for one in found])


def _comparison(catalogue: Catalogue, runs: tuple[Run, Run], pair: _Pair) -> dict[str, Any]:
    total, same = pair.maps.old.size, int(np.trace(pair.joint))
    largest = [
        {"from": pair.maps.name(old), "to": pair.maps.name(new), "pixels": count, "share": count / total}
        for old, new, count in pair.maps.pairs[:LARGEST_PAIRS]
    ]
    asked = [{name: value for name, value in run.settings.items() if name not in NOT_ASKED} for run in runs]
    return {
        **{
            side: {
                "run": run.folder.name,
                "created": run.created,
                "scene": run.settings.get("scene"),
                "seed": run.settings.get("seed"),
                **score_of(run.receipt),
            }
            for side, run in zip("ab", runs, strict=True)
        },
        "classes": _classes(runs, pair),
        "differing": {"pixels": total - same, "share": (total - same) / total, "pairs": len(pair.maps.pairs)},
        "largest": largest,
        "confidence": _confidence(*pair.confidence),
        "settings": list(_changes(*(flatten(one) for one in asked))),
        "versions": list(_changes(*(_versions(catalogue, run) for run in runs))),
        "savings": {name: [_spent(run.receipt, name) for run in runs] for name in SAVINGS},
    }


def _classes(runs: tuple[Run, Run], pair: _Pair) -> list[dict[str, Any]]:
    """Area in each map, its change and the agreement of both, for each class that is in one of them."""
    hectares = [known for run in runs if (known := areas_on_ground(run.receipt)) is not None]
    rows, columns, total = pair.joint.sum(axis=1), pair.joint.sum(axis=0), pair.maps.old.size
    found = []
    for number, name in enumerate((*pair.maps.names, "no class")):
        both, pixels = int(pair.joint[number, number]), [int(rows[number]), int(columns[number])]
        either = sum(pixels) - both
        if either:
            row = {"name": name, "pixels": pixels, "share": [count / total for count in pixels], "iou": both / either}
            if len(hectares) == 2 and number < len(pair.maps.names):
                row["ha"] = [float(area.get(name, 0.0)) for area in hectares]
            found.append(row)
    return found


def _confidence(old: NDArray[np.float32], new: NDArray[np.float32]) -> dict[str, float | None]:
    """Mean confidence of both where both have a class, the mean change, and the share of pixels where it rose."""
    known = np.isfinite(old) & np.isfinite(new)
    if not known.any():
        return {"a": None, "b": None, "change": None, "rose": None}
    before, after = old[known].astype(np.float64), new[known].astype(np.float64)
    a, b = float(before.mean()), float(after.mean())
    return {"a": a, "b": b, "change": float(after.mean() - before.mean()), "rose": float(np.mean(after > before))}


def _versions(catalogue: Catalogue, run: Run) -> dict[str, str]:
    """Of software, of each stage that made something, and of the weights by their content."""
    found = {str(name): str(value) for name, value in dict(run.receipt.get("versions", {})).items()}
    for row in run.stages:
        for uri in catalogue.by_key.get(str(row.get("key")), []):
            if uri in catalogue.stores:
                found[f"stage.{row.get('name')}"] = catalogue.stores[uri].version
                if "weights" in catalogue.stores[uri].params:
                    found["weights"] = str(catalogue.stores[uri].params["weights"])
    return found


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for name in sorted(old.keys() | new.keys()):
        if old.get(name, ABSENT) != new.get(name, ABSENT):
            yield {"name": name, "old": old.get(name, ABSENT), "new": new.get(name, ABSENT)}


def _spent(receipt: Mapping[str, Any], name: str) -> float | int | None:
    savings = receipt.get("savings")
    entry = savings.get(name) if isinstance(savings, Mapping) else None
    done = entry.get("done") if isinstance(entry, Mapping) else None
    return done if known_number(done) is not None else None


def panel_words(side: Mapping[str, Any]) -> str:
    """A run and how good it is, in words."""
    scores = (("mIoU", side["miou"]), ("overall", side["overall_accuracy"]))
    return ", ".join([str(side["run"]), *(f"{name} {format_points(one)}" for name, one in scores if one is not None)])


def change_words(differing: Mapping[str, Any]) -> str:
    """How much differs, in words."""
    return f"{format_count(differing['pixels'])} px, {format_percent(differing['share'])}"


def show_comparison(content: dict[str, Any], console: Console) -> None:
    """Print what `compare` found."""

    def say(text: str) -> None:
        console.print(escape(text), soft_wrap=True)

    say(f"A: {panel_words(content['a'])}\nB: {panel_words(content['b'])}")
    classes = content["classes"]
    hectares = ("ha in A", "ha in B") if any("ha" in row for row in classes) else ()
    table = _table("Classes", "class", "px in A", "px in B", "in A", "in B", *hectares, "IoU of A and B", left=1)
    for row in classes:
        cells = [*map(format_count, row["pixels"]), *map(format_percent, row["share"])]
        cells += [f"{area:.4g}" for area in row["ha"]] if "ha" in row else [DASH] * len(hectares)
        table.add_row(escape(row["name"].replace("_", " ")), *cells, format_points(row["iou"]))
    console.print(table)
    say(f"{change_words(content['differing'])} differ")
    if content["largest"]:
        table = _table("Largest changes", "A", "B", "pixels", "share", left=2)
        for row in content["largest"]:
            figures = (format_count(row["pixels"]), format_percent(row["share"]))
            table.add_row(escape(row["from"]), escape(row["to"]), *figures)
        console.print(table)
    sure = content["confidence"]
    if sure["a"] is not None:
        both = f"{sure['a']:.3f} in A, {sure['b']:.3f} in B ({sure['change']:+.3f})"
        say(f"confidence {both}, higher at {format_percent(sure['rose'])} of pixels")
    table = _table("Spent", "cost", "A", "B", left=1)
    for name, (label, show) in SAVINGS.items():
        table.add_row(label, *(show(value) for value in content["savings"][name]))
    console.print(table)
    changes = [(kind, row) for kind in ("settings", "versions") for row in content[kind]]
    if changes:
        table = _table("What was not the same", "what", "name", "A", "B", left=4)
        for kind, row in changes:
            table.add_row(kind.removesuffix("s"), *(escape(str(row[name])) for name in ("name", "old", "new")))
    console.print(table if changes else "settings and versions are the same")
    say(f"  {content['picture']}")


def _table(title: str, *columns: str, left: int) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < left else "right", overflow="fold")
    return table
