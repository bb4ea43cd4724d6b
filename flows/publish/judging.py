"""When a map is judged: once its run is published, so that nothing that is lost then is the map.

The accuracy is then added to the run. A survey that was stopped meanwhile goes on with the run that it had published.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from flows.publish.receipt import is_pending
from flows.publish.run_folder import Published, add_accuracy, asked_settings, publish_run
from flows.settings.survey_settings import OF_THE_MACHINE
from flows.survey.run import SurveyRun
from flows.survey.survey import STAGES, Products, StageRunner, Step, judge
from storage.archive.keys import canonical_json
from storage.archive.records import Run, read_run
from storage.archive.run_folders import RunDraft
from storage.archive.whole_files import to_json

JUDGE = STAGES["evaluate"]
NOT_ASKED = ("notes", "out", "engine", *OF_THE_MACHINE)  # of a receipt's settings: no byte depends on them


def publish_and_judge(
    runner: StageRunner, step: Step, products: Products, started: str, tell: Callable[[str], None]
) -> Published:
    """Publish the run of a map, then judge the map and add its accuracy to the run.

    Where there is nothing to judge by, or the archive holds the accuracy, the run is published once, with all of it.

    Parameters
    ----------
    step
        What runs the stage that judges.
    started
        When the survey began, ISO 8601.
    tell
        Is given a line once the run is there and the map is about to be judged.
    """
    run = runner.run
    draft = _draft_of_stopped(runner)
    if draft is None and not _takes_time(run, products):
        return publish_run(runner, judge(step, products), started)
    if draft is not None:
        tell(f"published before: {draft.published}; its accuracy is added to it")
    else:
        published = publish_run(runner, products, started)
        tell(f"published: {published.folder}; its accuracy is judged now and added to it")
        draft = run.archive.extend_run(published.folder.name)
        assert draft is not None
    with draft:
        judged = judge(step, products)
        return add_accuracy(run, draft, judged, runner.records[JUDGE.name])


def _takes_time(run: SurveyRun, products: Products) -> bool:
    """Whether there is a map to judge, and no stored accuracy of it."""
    if not run.scene.labelled or not run.settings.accuracy:
        return False
    try:
        wanted = JUDGE(run, *products.there(JUDGE.of))
        return wanted is not None and JUDGE.find(run.archive, wanted) is None
    except Exception:  # what is wrong is said when the map is judged: until then it is published
        return True


def _draft_of_stopped(runner: StageRunner) -> RunDraft | None:
    """The run that the same survey published before it was stopped; None where there is none, or it is being judged."""
    archive = runner.run.archive
    for folder in reversed(archive.runs()):
        if _is_stopped(runner, read_run(folder, {})):
            draft = archive.extend_run(folder.name, wait=False)
            if draft is None:
                continue
            if _is_stopped(runner, read_run(folder, {})):  # and not judged since
                return draft
            draft.abandon()
    return None


def _is_stopped(runner: StageRunner, run: Run) -> bool:
    """Whether a run waits for its accuracy, and is of this survey: the same settings, the same stores."""
    if run.problem is not None or not is_pending(run.receipt):
        return False
    stores = {name: one.key for name, one in runner.records.items()}
    found = {str(row.get("name")): row.get("key") for row in run.stages}
    return found == stores and _told(run.settings) == _told(asked_settings(runner.run))


def _told(settings: Mapping[str, Any]) -> str:
    """Settings as a receipt tells them, in one text."""
    plain = json.loads(to_json({name: value for name, value in settings.items() if name not in NOT_ASKED}))
    return canonical_json(plain)
