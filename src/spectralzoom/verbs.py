"""Offer the verbs of the command line as functions, with keywords for settings and a callback for progress."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import threadpoolctl
from pydantic import TypeAdapter, ValidationError

import spectralzoom.opened as opened
from spectralzoom.flows.archive.plan_command import plan_content
from spectralzoom.flows.opening.recorded_field import usual_of_recording
from spectralzoom.flows.settings.load import unnested
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.terminal.processes import place_caches, send_no_analytics
from spectralzoom.flows.terminal.progress import Listener, heard_by, on_stderr
from spectralzoom.opened import OpenedRun
from spectralzoom.pipeline.errors import SettingsError

if TYPE_CHECKING:
    from rich.console import Console


Asked = str | Path | Mapping[str, Any] | None  # a settings file, a table of settings, or keywords alone


def survey(settings: Asked = None, *, progress: Listener | None = None, quiet: bool = True, **flags: Any) -> OpenedRun:
    """Survey a field as `spectralzoom survey` does, publish the run and return it.

    Stores in the archive are reused, so that the same call continues a stopped survey.

    Parameters
    ----------
    settings
        A settings file (TOML), or its content as a dictionary. Keywords win over it.
    progress
        Called as ``progress(stage, done, total)`` at each step of a stage; ``done / total`` is its fraction.
    quiet
        False prints the output of the command on stderr.
    flags
        Every setting by its name: ``budget=0.5``, ``camera={"exposure_ms": 50}``. ``engine`` is ``"plain"`` by
        default.

    Raises
    ------
    Error
        The survey failed; captured lines are kept.
    SurveyStopped
        The keyword ``until`` stops the survey before its class map; ``uri`` names the store.
    """
    from spectralzoom.flows.survey_command import run_survey

    asked = _settings(settings, flags)
    with _working(progress, quiet=quiet) as console:
        published = run_survey(asked, console)
    return opened.open(asked.out)[published.folder.name]


def plan(settings: Asked = None, **flags: Any) -> dict[str, Any]:
    """Return the plan of a `survey` with the same arguments; nothing is captured or written.

    Parameters
    ----------
    settings, flags
        As for `survey`.

    Returns
    -------
    dict
        The content of `spectralzoom plan --json`: ``field``, ``stages`` with their state, ``estimate`` and ``scans``.
        The estimate has seconds, bytes, multiply-adds and mIoU. Scans are the uniform ones taken and referred to.

    Raises
    ------
    Error
        The survey is not possible.
    """
    asked = _settings(settings, flags)
    with _working(None):
        content: dict[str, Any] = plan_content(asked)
    return content


def evaluate(dataset: str | Path, *, progress: Listener | None = None, **flags: Any) -> dict[str, Any]:
    """Evaluate weights on scenes that they were not trained on.

    Parameters
    ----------
    dataset
        A data set of `spectralzoom evaluate`, with ``weights`` (one or several files).
    progress
        As for `survey`.
    flags
        Those of `spectralzoom evaluate`, lists as Python's: ``fractions=[0.1, 0.2]``, ``out="judged"``.

    Returns
    -------
    dict
        The content of `spectralzoom evaluate --json`.

    Raises
    ------
    Error
        A value or a file is not valid.
    """
    from spectralzoom.flows.evaluate.command import evaluate_weights
    from spectralzoom.flows.settings.model_flags import EvaluateFlags

    if "weights" not in flags:
        raise SettingsError("evaluate needs weights=FILE, the weights to judge on the data set")
    weights = flags.pop("weights")
    files = tuple(map(Path, [weights] if isinstance(weights, str | Path) else weights))
    asked = _flags(EvaluateFlags, "evaluate", flags, weights=files)
    with _working(progress):
        content: dict[str, Any] = evaluate_weights(
            str(dataset), asked, lambda what, done, figure: None if progress is None else progress(what, done, 1.0)
        )
    return content


def train(
    dataset: str | Path, out: str | Path, *, progress: Listener | None = None, quiet: bool = True, **flags: Any
) -> Path:
    """Train weights on a data set as `spectralzoom train` does, and return their file.

    The state is kept beside the weights, so that the same call continues a stopped training.

    Parameters
    ----------
    dataset
        ``farm``, a folder with images, labels and a scene.toml, or one scene file.
    out
        File of weights to write (.safetensors).
    progress, quiet
        As for `survey`.
    flags
        Those of `spectralzoom train`, lists as Python's: ``steps=500``, ``hold_out=["059"]``.

    Raises
    ------
    Error
        A value or a file is not valid.
    """
    from spectralzoom.flows.cli.model_verbs import run_training
    from spectralzoom.flows.settings.model_flags import TrainFlags

    arguments = [repr(Path(dataset).name), *(f"{name}={value!r}" for name, value in flags.items())]
    asked = _flags(TrainFlags, "train", flags)
    with _working(progress, quiet=quiet) as console:
        run_training(str(dataset), Path(out), asked, f"spectralzoom.train({', '.join(arguments)})", console)
    return Path(out)


def _settings(given: Asked, flags: Mapping[str, Any]) -> Settings:
    """Return the settings of a file or a table; keywords win over them."""
    path = None if given is None or isinstance(given, Mapping) else given
    if not isinstance(given, str | Path | Mapping | None):
        raise SettingsError(f"settings must be a settings file or a table of settings, got {given!r}")
    asked = unnested(given if isinstance(given, Mapping) else {}) | unnested(flags)

    def usual(stated: Mapping[str, Any]) -> dict[str, Any]:
        """Return other defaults: a Prefect server starts only on request."""
        return {"engine": "plain", **usual_of_recording(stated)}

    return load_settings(path, {str(key): _plain(value) for key, value in asked.items()}, usual=usual)


def _plain(value: Any) -> Any:
    """Return paths as text, and NumPy's numbers and arrays and ranges as Python's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value) if isinstance(value, Path) else list(value) if isinstance(value, range) else value


@contextmanager
def _working(progress: Listener | None, *, quiet: bool = True) -> Iterator[Console]:
    """Set up caches, progress, no analytics and one BLAS thread as for a command, and yield a console."""
    send_no_analytics()
    place_caches()
    console = on_stderr()
    console.quiet = quiet
    # With several threads, rounding of sums and so the content of stores would depend on the number of cores.
    with heard_by(progress), threadpoolctl.threadpool_limits(1, user_api="blas"):
        yield console


def _flags(kind: type[Any], verb: str, given: Mapping[str, Any], **more: Any) -> Any:
    """Return the flags of a verb from keywords, with lists as text.

    Raises SettingsError: an unknown keyword, or a value of another type.
    """
    known = [one.name for one in fields(kind)]
    for name, value in given.items():
        if name not in known:
            raise SettingsError(f"{verb} has no {name!r}; it has {', '.join(sorted(known))}")
        more[name] = ",".join(map(str, value)) if isinstance(value, list | tuple) else value
    try:
        return TypeAdapter(kind).validate_python(more)
    except ValidationError as error:
        wrong = error.errors()[0]
        raise SettingsError(f"{verb}: {wrong['loc'][0]} = {wrong['input']!r}: {wrong['msg']}") from None
