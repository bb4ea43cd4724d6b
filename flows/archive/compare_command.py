"""Compare two runs of one field: the verb `compare`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from flows.cli.app import ArchiveName, AsJson, OutFolder, check_outside
from flows.publish.receipt import hectares_of_classes
from flows.publish.receipt_table import BYTE_LABELS, COST_LABELS
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.tasks.scores import score_of
from flows.terminal.figures import (
    format_area,
    format_count,
    format_megabytes,
    format_percent,
    format_points,
    known_number,
)
from flows.terminal.processes import DONE
from flows.terminal.progress import put_out, table
from pipeline.errors import ArchiveError, SceneError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.lazy import deferred
from pipeline.simulator.scenes.built_in import is_built_in_key
from storage.archive.archive import Archive
from storage.archive.keys import in_text
from storage.archive.lineage import ABSENT, Catalogue, find_product, flatten
from storage.archive.records import Run
from storage.archive.whole_files import written_aside
from storage.arrays.class_maps import ClassMap, load_class_map
from storage.remote.opening import open_archive

if TYPE_CHECKING:
    import flows.publish.panels as panels
else:
    panels = deferred("flows.publish.panels")  # matplotlib

MOST_CHANGES = 10
NOT_ASKED = ("notes", "out")  # of a receipt's settings
NO_FILES = (None, *BUILT_IN_SCENES)  # scenes that are no files


def compare(archive: ArchiveName, old: str, new: str, *, out: OutFolder = None, as_json: AsJson = False) -> int:
    """Compare two runs of one field: classes, settings and costs, and a picture of the differences.

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
        fields = (f"{run.uri} shows {_field_key(run) if scene in NO_FILES else scene}" for run, scene in scenes)
        raise SceneError(f"these runs are of different fields: {', '.join(fields)}; give two runs of one field")
    maps = _by_one_list([_class_map(catalogue, opened, run) for run in runs])
    content = _comparison(runs, maps)
    name = f"compare-{runs[0].folder.name}-{runs[1].folder.name}.png"
    with written_aside(folder, [name]) as aside:
        titles = (
            content["a"]["run"],
            content["b"]["run"],
            f"{format_percent(content['differing']['fraction'])} differ",
        )
        panels.draw_difference(aside / name, maps, titles)
    content["picture"] = str(folder / name)
    put_out(content, show_comparison, as_json=as_json)
    return DONE


def find_run(catalogue: Catalogue, text: str) -> Run:
    """Return a run by its id, `latest` (the newest with a map) or `previous` (the one of the same field before it).

    Raises ArchiveError: there is no such run.
    """
    if text not in ("latest", "previous"):
        found = find_product(catalogue, f"runs/{text.rstrip('/').removeprefix('runs/')}")
        assert isinstance(found, Run)
        return found
    mapped = [run for run in catalogue.runs if "class_map" in run.products]
    if not mapped:
        raise ArchiveError("no run of this archive has a class map that can be read; see ls")
    if text == "latest":
        return mapped[-1]
    before = [run for run in mapped[:-1] if _is_same_field(run, mapped[-1])]
    if not before:
        raise ArchiveError(f"there is no run of the field of {mapped[-1].uri} before it; see ls, and give two runs")
    return before[-1]


def _is_same_field(old: Run, new: Run) -> bool:
    """Return whether two runs have the same scene by its key, the same scene file, or files and the same name."""
    (old_file, new_file), (old_name, new_name) = (
        [run.settings.get(what) for run in (old, new)] for what in ("scene", "name")
    )
    of_files = old_file not in NO_FILES and new_file not in NO_FILES
    same = of_files and (old_file == new_file or (old_name is not None and old_name == new_name))
    return same or _field_key(old) == _field_key(new)


def _field_key(run: Run) -> str:
    """Return the key of a run's scene without light, bands, and the day and hour of a farm."""
    key = re.split("/(?:light|bands|only)=", str(run.receipt.get("scene", run.uri)))[0]
    return re.sub("/(?:day|hour)=[^/]*", "", key) if is_built_in_key(key) else key


def _class_map(catalogue: Catalogue, archive: Archive, run: Run) -> ClassMap:
    address = run.products["class_map"]
    store = catalogue.stores.get(in_text(address) or "")
    if store is None or store.problem is not None:
        raise ArchiveError(f"the class map {address} of {run.uri} is missing or damaged; run verify --repair")
    return load_class_map(archive.locate(address))


def _by_one_list(found: list[ClassMap]) -> list[ClassMap]:
    """Return both maps with their classes numbered by one list of names; 255 stays no class."""
    shapes = [one.classes.shape for one in found]
    if shapes[0] != shapes[1]:
        raise ShapeError(f"the maps are {shapes[0]} and {shapes[1]} px (y, x); give two runs of one field and size")
    colours = {name: colour for one in reversed(found) for name, colour in zip(one.names, one.colours, strict=True)}
    names = tuple(dict.fromkeys(name for one in found for name in one.names))
    palette = np.array([colours[name] for name in names], np.uint8).reshape(-1, 3)
    numbered = []
    for one in found:
        number = np.full(256, UNLABELLED, np.uint8)
        number[: len(one.names)] = [names.index(name) for name in one.names]
        numbered.append(ClassMap(number[one.classes], one.confidence, names, palette))
    return numbered


def _comparison(runs: tuple[Run, Run], maps: list[ClassMap]) -> dict[str, Any]:
    names = [*(name.replace("_", " ") for name in maps[0].names), "no class"]
    old, new = (np.minimum(one.classes, len(names) - 1).ravel().astype(np.intp) for one in maps)
    joint = np.bincount(old * len(names) + new, minlength=len(names) ** 2).reshape(len(names), -1)  # (class A, class B)
    changed = joint - np.diag(np.diag(joint))
    order = np.argsort(-changed, axis=None, kind="stable")[: min(np.count_nonzero(changed), MOST_CHANGES)]
    settings = [flatten({name: one for name, one in run.settings.items() if name not in NOT_ASKED}) for run in runs]
    made = [
        {**part_of(run.receipt, "versions"), **{f"stage.{row.get('name')}": row.get("key") for row in run.stages}}
        for run in runs
    ]
    sides = {
        side: {
            "run": run.folder.name,
            **{name: run.settings.get(name) for name in ("scene", "seed")},
            "created": run.created,
            "training_scene": run.receipt.get("training_scene"),
            **score_of(run.receipt),
        }
        for side, run in zip("ab", runs, strict=True)
    }
    return {
        **sides,
        "classes": _classes(runs, joint, names),
        "differing": {"pixels": int(changed.sum()), "fraction": float(changed.sum() / old.size)},
        "largest": [
            {
                "from": names[i],
                "to": names[j],
                "pixels": int(changed[i, j]),
                "fraction": float(changed[i, j] / old.size),
            }
            for i, j in (divmod(int(one), len(names)) for one in order)
        ],
        "settings": _changes(*settings),
        "made": _changes(*made),
        "savings": {
            name: [known_number(part_of(run.receipt, "savings", name).get("done")) for run in runs]
            for name in COST_LABELS
        },
        "data_bytes": {
            name: [known_number(part_of(run.receipt, "data_bytes").get(name)) for run in runs] for name in BYTE_LABELS
        },
    }


def _classes(runs: tuple[Run, Run], joint: NDArray[np.int64], names: list[str]) -> list[dict[str, Any]]:
    """Return the area of each class in both maps and their agreement; hectares where both maps have them."""
    areas = [known for run in runs if (known := hectares_of_classes(run.receipt)) is not None]
    hectares = [{str(name).replace("_", " "): float(area) for name, area in one.items()} for one in areas]
    found = []
    for number, name in enumerate(names):
        both, pixels = int(joint[number, number]), [int(joint[number].sum()), int(joint[:, number].sum())]
        if either := sum(pixels) - both:
            row: dict[str, Any] = {"name": name, "pixels": pixels, "iou": both / either}
            row["fraction"] = [count / int(joint.sum()) for count in pixels]
            if len(hectares) == 2 and number < len(names) - 1:
                row["ha"] = [area.get(name, 0.0) for area in hectares]
            found.append(row)
    return found


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[dict[str, Any]]:
    both = ((name, old.get(name, ABSENT), new.get(name, ABSENT)) for name in sorted(old.keys() | new.keys()))
    return [{"name": name, "old": before, "new": after} for name, before, after in both if before != after]


def part_of(receipt: Mapping[str, Any], *path: str) -> Mapping[str, Any]:
    """Return a table within a receipt; an empty one where there is none."""
    found: Any = receipt
    for name in path:
        found = found.get(name) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def show_comparison(content: dict[str, Any], console: Console) -> None:
    """Print a comparison."""
    figures = (("run", str), ("miou", format_points), ("overall_accuracy", format_points))
    rows = [[name.replace("_", " "), *(escape(show(content[side][name])) for side in "ab")] for name, show in figures]
    if any(content[side]["training_scene"] for side in "ab"):
        rows.append(["scene of the training", *(str(content[side]["training_scene"] or "no") for side in "ab")])
    rows += [[label, *map(cost, content["savings"][name])] for name, (label, cost) in COST_LABELS.items()]
    rows += [[label, *map(format_megabytes, content["data_bytes"][name])] for name, label in BYTE_LABELS.items()]
    changed = [*content["settings"], *content["made"]]
    rows += [[escape(str(row[part])) for part in ("name", "old", "new")] for row in changed]
    console.print(table(("", "A", "B"), rows))
    rows = []
    for row in content["classes"]:
        cells = map(format_area, row["ha"]) if "ha" in row else map(format_count, row["pixels"])
        rows.append([escape(row["name"]), *cells, *map(format_percent, row["fraction"]), format_points(row["iou"])])
    console.print(table(("class", "px in A", "px in B", "in A", "in B", "IoU of A and B"), rows))
    differing = content["differing"]
    console.print(f"{format_count(differing['pixels'])} px, {format_percent(differing['fraction'])} differ")
    for row in content["largest"]:
        console.print(escape(f"  {row['from']} to {row['to']}: {format_count(row['pixels'])} px"), soft_wrap=True)
    console.print(escape(f"  {content['picture']}"), soft_wrap=True)
