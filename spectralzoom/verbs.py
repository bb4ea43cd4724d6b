"""Offer the verbs of the command line as functions, with keywords for settings and a callback for progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import SettingsError
from pipeline.lazy import deferred
from spectralzoom.opened import OpenedRun

if TYPE_CHECKING:
    import threadpoolctl
    from rich.console import Console

    import flows.archive.plan_command as plan_command
    import flows.archive.reprocess_command as reprocess_command
    import flows.evaluate.command as evaluate_command
    import flows.evaluate.frames as evaluate_frames
    import flows.publish.survey_command as survey_command
    import flows.settings.load as settings_load
    import flows.terminal.processes as processes
    import flows.terminal.progress as terminal_progress
    import flows.training.train as train_command
    import flows.training.train_scenes as train_scenes
    import models.training.train as models_training
    import spectralzoom.opened as opened
    from flows.settings.survey_settings import Settings
else:
    threadpoolctl = deferred("threadpoolctl")
    plan_command = deferred("flows.archive.plan_command")
    reprocess_command = deferred("flows.archive.reprocess_command")
    evaluate_command = deferred("flows.evaluate.command")
    evaluate_frames = deferred("flows.evaluate.frames")
    survey_command = deferred("flows.publish.survey_command")
    settings_load = deferred("flows.settings.load")
    processes = deferred("flows.terminal.processes")
    terminal_progress = deferred("flows.terminal.progress")
    train_command = deferred("flows.training.train")
    train_scenes = deferred("flows.training.train_scenes")
    models_training = deferred("models.training.train")
    opened = deferred("spectralzoom.opened")

Asked = str | Path | Mapping[str, Any] | None  # a settings file, a table of settings, or keywords alone
Told = Callable[[str, float, float], None]
USUAL = {"engine": "plain"}  # a Prefect server starts only on request
TOKENS = ("dim", "layers", "heads", "mlp_ratio")
MADE_HERE = ("dataset", "choices", "tokens", "settings", "command", "camera")  # of requests
FILES = ("weights",)
LISTS = (*FILES, "fractions", "policies", "frames")
OF_ONE_SCENE = ("labels", "bands", "wavelengths", "train_mask", "mask_classes")


def survey(settings: Asked = None, *, progress: Told | None = None, quiet: bool = True, **flags: Any) -> OpenedRun:
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
    """
    asked = _settings(settings, flags)
    with _working(progress, quiet=quiet) as console:
        published = survey_command.run_survey(asked, console)
    return opened.open(asked.out)[published.folder.name]


def plan(settings: Asked = None, *, preview: str | Path | None = None, **flags: Any) -> dict[str, Any]:
    """Return the plan of a `survey` with the same arguments; nothing is captured or written.

    Parameters
    ----------
    settings, flags
        As for `survey`.
    preview
        A PNG to draw the sweeps into.

    Returns
    -------
    dict
        The content of `spectralzoom plan --json`: ``field``, ``stages`` with state, reason, seconds and bytes, their
        sums, and the uniform ``scans`` of the weights' record.

    Raises
    ------
    Error
        The survey is not possible.
    """
    asked, picture = _settings(settings, flags), None if preview is None else Path(preview)
    with _working(None):
        content: dict[str, Any] = plan_command.plan_content(asked, picture)
    return content


def evaluate(dataset: str | Path | OpenedRun, *, progress: Told | None = None, **flags: Any) -> dict[str, Any]:
    """Evaluate weights on scenes that they were not trained on, or the map of a run against labels.

    Parameters
    ----------
    dataset
        A data set of `spectralzoom evaluate`, with ``weights`` (one or several files). Or a run, to which the accuracy
        is added; ``labels`` and ``controls`` replace those of its survey.
    progress
        As for `survey`.
    flags
        Those of `spectralzoom evaluate`, lists as Python's: ``fractions=[0.1, 0.2]``, ``out="judged"``.

    Returns
    -------
    dict
        For weights the content of `spectralzoom evaluate --json`, for a run the ``accuracy`` of its receipt.

    Raises
    ------
    Error
        A value or a file is not valid.
    """
    if isinstance(dataset, OpenedRun):
        return _judge(dataset, progress, **flags)
    kind, asked = evaluate_frames.EvaluateRequest, {**flags}
    choices = _taken(asked, OF_ONE_SCENE)
    _check_known(asked, kind, "evaluate", also=[])
    if "weights" not in asked:
        raise SettingsError("evaluate needs weights=FILE to judge them on a data set, or a run to judge its map")
    for name in LISTS:
        if name in asked:
            asked[name] = tuple(Path(one) if name in FILES else one for one in _several(asked[name]))
    if asked.get("out") is not None:
        asked["out"] = Path(asked["out"])
    with _working(progress):
        request = kind(str(dataset), **asked, choices=choices)
        content: dict[str, Any] = evaluate_command.evaluate_weights(
            request, lambda what, done, words: _tell(progress, what, done)
        )
    return content


def train(
    dataset: str | Path, out: str | Path, *, progress: Told | None = None, quiet: bool = True, **flags: Any
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
        Those of `spectralzoom train`, lists as Python's: ``steps=500``, ``hold_out=["059"]``, ``dim=64``.

    Raises
    ------
    Error
        A value or a file is not valid.
    """
    kind, how, asked = train_scenes.TrainRequest, models_training.TrainingSettings, {**flags}
    command = f"spectralzoom.train({', '.join([repr(Path(dataset).name), *(f'{k}={v!r}' for k, v in asked.items())])})"
    sizes, choices = _taken(asked, TOKENS), _taken(asked, OF_ONE_SCENE)
    own = _taken(asked, [one.name for one in fields(how)])
    own.setdefault("crop", train_command.usual_crop(str(dataset)))
    if "hold_out" in asked:
        asked["hold_out"] = tuple(_several(asked["hold_out"]))
    _check_known(asked, kind, "train", also=[*(one.name for one in fields(how)), *TOKENS])
    request = kind(
        str(dataset), Path(out), **asked, tokens=sizes, choices=choices, settings=how(**own), command=command
    )
    with _working(progress, quiet=quiet) as console:
        train_command.run_train(request, console)
    return Path(out)


def _settings(given: Asked, flags: Mapping[str, Any]) -> Settings:
    """Return the settings of a file or a table; keywords win over them."""
    path = None if given is None or isinstance(given, Mapping) else given
    table = _by_key(given) if isinstance(given, Mapping) else {}
    return settings_load.load_settings(path, table | _by_key(flags), usual=USUAL)


def _by_key(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by their keys, such as ``camera.exposure_ms``, with paths as text."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        inner = {f"{name}.{key}": one for key, one in value.items()} if isinstance(value, Mapping) else {name: value}
        found |= {key: str(one) if isinstance(one, Path) else one for key, one in inner.items()}
    return found


@contextmanager
def _working(progress: Told | None, *, quiet: bool = True) -> Iterator[Console]:
    """Set up caches, progress and one BLAS thread as for a command, and yield a console."""
    processes.place_caches()
    console = terminal_progress.on_stderr()
    console.quiet = quiet
    # With several threads, rounding of sums and so the content of stores would depend on the number of cores.
    with terminal_progress.heard_by(progress), threadpoolctl.threadpool_limits(1, user_api="blas"):
        yield console


def _judge(
    run: OpenedRun, progress: Told | None, labels: str | Path | None = None, controls: bool | None = None
) -> dict[str, Any]:
    """Add the accuracy to a run, and return it."""
    asked = None if labels is None else str(labels)
    with _working(progress) as console:
        receipt = reprocess_command.run_judge(run.archive_name, run.name, console, controls=controls, labels=asked)
    return dict(receipt["accuracy"])


def _tell(progress: Told | None, what: str, done: float) -> None:
    if progress is not None:
        progress(what, done, 1.0)


def _several(value: Any) -> Sequence[Any]:
    """Return a list of one value or of several."""
    return [value] if isinstance(value, str | Path | float | int) else list(value)


def _taken(flags: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Remove some keywords and return them."""
    return {name: flags.pop(name) for name in names if name in flags}


def _check_known(flags: Mapping[str, Any], kind: Any, verb: str, *, also: Sequence[str]) -> None:
    """Raise SettingsError for a keyword that the verb does not have."""
    own = [one.name for one in fields(kind) if one.name not in MADE_HERE]
    for name in flags:
        if name not in own:
            raise SettingsError(f"{verb} has no {name!r}; it has {', '.join(sorted({*own, *also, *OF_ONE_SCENE}))}")
