"""The notebooks: every cell runs from top to bottom, and is stored with its outputs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from tests.flows.conftest import stages
from tests.prior_work import without_effects

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NAMES = ("first_survey", "season")
MOST_BYTES = 200_000


@pytest.fixture
def drawing() -> Iterator[None]:
    """Draw without a display and close all figures at the end."""
    plt.switch_backend("Agg")
    yield
    plt.close("all")


def cells(name: str, kind: str) -> list[dict[str, Any]]:
    """Return the cells of a notebook of one kind."""
    content = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in content["cells"] if cell["cell_type"] == kind]


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("name", NAMES)
def test_every_cell_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The cells run in this process, like a page's blocks: a kernel and its imports take longer than the surveys."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": name}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with without_effects():
        for number, cell in enumerate(cells(name, "code")):
            text = re.sub(r'("size": "|"samples": )\d+', r"\g<1>64", "".join(cell["source"]))
            exec(compile(text, f"{name}.ipynb, cell {number}", "exec", dont_inherit=True), names)
            shown = [output for output in cell["outputs"] if output.get("name") == "stdout"]
            assert bool(capsys.readouterr().out) == bool(shown), f"cell {number} prints other than what is shown of it"
    drawn = [axes for number in plt.get_fignums() for axes in plt.figure(number).axes]
    assert all(axes.images or any(len(line.get_xdata()) for line in axes.lines) or axes.collections for axes in drawn)
    assert len(drawn) >= 3


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_stored_with_its_outputs(name: str) -> None:
    """`make notebooks` rendered it: small, cells in order, no errors, two pictures, and links to existing files."""
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MOST_BYTES
    code = cells(name, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"stream", "display_data"}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert "/tmp/" not in json.dumps(outputs)
    # stages of the survey and of its control
    ran = {stage for one in outputs for line in one.get("text", ()) if " > " in line for stage in line.split()[::2]}
    assert {name.removeprefix("control_") for name in ran} <= set(stages())
    assert bool(ran) == (name == "first_survey")
    text = "".join("".join(cell["source"]) for cell in cells(name, "markdown"))
    targets = re.findall(r"\]\(([^)#]+)", text)
    assert [one for one in targets if not (FOLDER / one).exists()] == []
