"""Prescriptions as ISOXML task data (ISO 11783-10, version 4): TASKDATA.XML and the numbers of its grid.

A grid of type 2: rows from the south-west corner, each cell the dose as a 32 bit whole number in steps of the
dictionary's entity for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from storage.archive.whole_files import written_aside
from storage.export.vector_files import DEGREE_DIGITS

FOLDER, XML, NUMBERS = "TASKDATA", "TASKDATA.XML", "GRD00000.bin"
DESIGNATOR = 32  # letters of a name
MOST_NUMBER = 2**31 - 1
TREATED, UNTREATED = 1, 0  # codes of treatment zones: 0 where there is no cell, no signal, or outside of the field


@dataclass(frozen=True)
class DoseUnit:
    """A unit of doses, and the entity of the ISO 11783-11 dictionary that carries it."""

    name: str
    ddi: int  # number of the entity
    per_unit: int  # of its steps


UNITS = {
    "l/ha": DoseUnit("l/ha", 0x0001, 10_000),  # setpoint volume per area, in 0.01 mm3/m2
    "kg/ha": DoseUnit("kg/ha", 0x0006, 100),  # setpoint mass per area, in 1 mg/m2
}


@dataclass(frozen=True)
class TaskGrid:
    """Doses on a grid of degrees (WGS 84)."""

    south_deg: float
    west_deg: float
    north_step_deg: float  # of a cell
    east_step_deg: float
    doses: NDArray[np.float64]  # (row from the south, column from the west), NaN where there is no field
    unit: DoseUnit


@dataclass(frozen=True)
class TaskWords:
    """What the task is called, and what it is for."""

    task: str
    field: str
    product: str
    version: str  # of this program
    area_m2: float


def write_task_data(folder: Path, grid: TaskGrid, words: TaskWords) -> tuple[Path, Path]:
    """Write ``folder/TASKDATA`` with the task and its grid; gives the paths of both files.

    Raises SettingsError: a dose is larger than the format can hold. ArchiveError: the disk refuses.
    """
    steps = np.rint(np.nan_to_num(grid.doses) * grid.unit.per_unit)
    if steps.max(initial=0) > MOST_NUMBER:
        most = MOST_NUMBER / grid.unit.per_unit
        raise SettingsError(f"task data hold doses up to {most:.0f} {grid.unit.name}, got {np.nanmax(grid.doses):g}")
    numbers = steps.astype("<i4").tobytes()
    place = folder / FOLDER
    with written_aside(place, [NUMBERS, XML]) as aside:
        (aside / NUMBERS).write_bytes(numbers)
        tree = ElementTree.ElementTree(_task_file(grid, words, len(numbers)))
        ElementTree.indent(tree)
        tree.write(aside / XML, encoding="UTF-8", xml_declaration=True)
    return place / XML, place / NUMBERS


def _task_file(grid: TaskGrid, words: TaskWords, length: int) -> ElementTree.Element:
    """One planned task of one field with two treatment zones, one of them the grid's."""
    root = ElementTree.Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="SpectralZoom",
        ManagementSoftwareVersion=words.version[:DESIGNATOR],
        DataTransferOrigin="1",
    )
    field = {"A": "PFD1", "C": words.field[:DESIGNATOR], "D": f"{words.area_m2:.0f}"}
    ElementTree.SubElement(root, "PFD", field)
    ElementTree.SubElement(root, "PDT", {"A": "PDT1", "B": words.product[:DESIGNATOR], "D": "VPN1"})
    zones = {"H": str(UNTREATED), "I": str(UNTREATED), "J": str(UNTREATED)}
    task = ElementTree.SubElement(
        root, "TSK", {"A": "TSK1", "B": words.task[:DESIGNATOR], "E": "PFD1", "G": "1"} | zones
    )
    for code, name in ((UNTREATED, "no treatment"), (TREATED, "by the grid")):
        zone = ElementTree.SubElement(task, "TZN", {"A": str(code), "B": name})
        ElementTree.SubElement(zone, "PDV", {"A": f"{grid.unit.ddi:04X}", "B": "0", "C": "PDT1", "E": "VPN1"})
    ElementTree.SubElement(task, "GRD", _grid_fields(grid, length))
    shown = {"A": "VPN1", "B": "0", "C": f"{1 / grid.unit.per_unit:g}", "D": "2", "E": grid.unit.name}
    ElementTree.SubElement(root, "VPN", shown)
    return root


def _grid_fields(grid: TaskGrid, length: int) -> dict[str, str]:
    rows, columns = grid.doses.shape
    return {
        "A": f"{grid.south_deg:.{DEGREE_DIGITS}f}",
        "B": f"{grid.west_deg:.{DEGREE_DIGITS}f}",
        "C": f"{grid.north_step_deg:.{DEGREE_DIGITS}f}",
        "D": f"{grid.east_step_deg:.{DEGREE_DIGITS}f}",
        "E": str(columns),
        "F": str(rows),
        "G": NUMBERS.removesuffix(".bin"),
        "H": str(length),
        "I": "2",
        "J": str(TREATED),
    }
