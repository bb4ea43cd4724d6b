"""ISOXML task data: another library reads it, and it is checked against ISO's schema."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from isoxml.converter.np_grid import to_numpy_array
from isoxml.models.ddi_entities import DDEntity
from isoxml.util.isoxml_io import isoxml_from_path

from pipeline.errors import SettingsError
from storage.export.map_files import UNITS, TaskGrid, TaskText, write_task_data

DOSES = np.array([[0.0, 2.5, np.nan], [200.0, 0.0, 0.01]])
GRID = TaskGrid(51.960197927, -7.600100835, 2.7e-05, 4.4e-05, DOSES, UNITS["l/ha"])
WORDS = TaskText("spot spraying of the northern field", "north", "weed 2.5 l/ha", "0.1.0", 12_345.6)


def schema_problems(found: Any, of: str = "") -> Iterator[str]:
    """Yield violations of the schema in a parsed file: required values, ranges, lengths, patterns."""
    for one in fields(found):
        value = getattr(found, one.name)
        rule = one.metadata
        name = f"{of}{type(found).__name__}.{one.name}"
        if isinstance(value, list):
            for part in value:
                yield from schema_problems(part, f"{of}{type(found).__name__}.")
        elif value is None:
            yield from [f"{name} is missing"] if rule.get("required") else []
        elif not is_dataclass(value):
            value = value.value if hasattr(value, "value") else value
            text = value if isinstance(value, str | bytes) else str(value)
            if "min_inclusive" in rule and not rule["min_inclusive"] <= value <= rule["max_inclusive"]:
                yield f"{name} is {value}"
            if not rule.get("min_length", 0) <= len(text) <= rule.get("max_length", len(text)):
                yield f"{name} has {len(text)} letters"
            if "length" in rule and len(text) != rule["length"]:
                yield f"{name} has not {rule['length']} letters"
            if "pattern" in rule and not re.fullmatch(rule["pattern"], text):
                yield f"{name} is {text}"


@pytest.mark.parametrize("unit", list(UNITS))
def test_another_library_reads_the_same_doses(tmp_path: Path, unit: str) -> None:
    """Rows start in the south, columns in the west; step and unit are the data dictionary's; NaN becomes 0."""
    write_task_data(tmp_path, replace(GRID, unit=UNITS[unit]), WORDS)
    task_data, numbers = isoxml_from_path(tmp_path / "TASKDATA")
    assert list(schema_problems(task_data)) == []
    (task,) = task_data.tasks
    (grid,) = task.grids
    (zone,) = (zone for zone in task.treatment_zones if zone.code == grid.treatment_zone_code)
    (variable,) = zone.process_data_variables
    entity = DDEntity.from_bytes(variable.process_data_ddi)
    steps = to_numpy_array(numbers[grid.filename], grid)
    per_hectare = {"mm³/m²": 100.0, "mg/m²": 100.0}[entity.unit]  # of a litre, of a kilogram
    assert entity.name.startswith({"l/ha": "Setpoint Volume", "kg/ha": "Setpoint Mass"}[unit])
    doses = steps * entity.bit_resolution / per_hectare
    np.testing.assert_allclose(doses, np.nan_to_num(DOSES), atol=1e-12)
    shown = task_data.value_presentations[0]
    np.testing.assert_allclose(steps * float(shown.scale), doses)
    assert shown.unit_designator == unit


def test_task_grid_has_its_position_and_treatment_zones(tmp_path: Path) -> None:
    """South-west corner and cell sides are in degrees; the dose is 0 outside of the grid and without a position."""
    xml, numbers = write_task_data(tmp_path, GRID, WORDS)
    task_data, _ = isoxml_from_path(xml)
    task = task_data.tasks[0]
    grid = task.grids[0]
    assert (float(grid.minimum_north_position), float(grid.minimum_east_position)) == (GRID.south_deg, GRID.west_deg)
    assert (grid.cell_north_size, grid.cell_east_size) == (GRID.north_step_deg, GRID.east_step_deg)
    assert (grid.maximum_row, grid.maximum_column) == DOSES.shape
    assert grid.filelength == numbers.stat().st_size == 4 * DOSES.size
    codes = (task.default_treatment_zone_code, task.position_lost_treatment_zone_code)
    assert {*codes, task.out_of_field_treatment_zone_code} == {0}
    assert task.treatment_zones[0].process_data_variables[0].process_data_value == 0
    assert task_data.partfields[0].area == 12_346
    assert task.designator == WORDS.task[:32]


def test_a_dose_beyond_the_format_is_refused(tmp_path: Path) -> None:
    """The error states the largest dose of the format; nothing is written."""
    with pytest.raises(SettingsError, match="doses up to 214748 l/ha, got 300000"):
        write_task_data(tmp_path, replace(GRID, doses=np.array([[3e5]])), WORDS)
    assert list(tmp_path.iterdir()) == []
