"""The Prefect engine: one flow a survey, one task a stage, references between them, nothing asked of the network.

No ``from __future__ import annotations`` here: Prefect reads the signatures.
"""

import atexit
import os
import secrets
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from flows.survey.survey import STAGES, Products, StageRunner, Step, survey
from flows.terminal.processes import end_with_us, terminable
from pipeline.errors import PipelineError
from pipeline.lazy import deferred
from storage.archive.keys import StageRef
from storage.archive.staging import remove_tree, take_lock

if TYPE_CHECKING:
    import prefect
    import prefect.cache_policies as prefect_cache_policies
    import prefect.context as prefect_context
    import prefect.server.api.server as prefect_server
    import prefect.settings as prefect_settings
else:
    prefect = deferred("prefect")
    prefect_cache_policies = deferred("prefect.cache_policies")
    prefect_context = deferred("prefect.context")
    prefect_server = deferred("prefect.server.api.server")
    prefect_settings = deferred("prefect.settings")

RETRY_DELAY_S = 2.0
PASSWORD = f"spectralzoom:{secrets.token_urlsafe(24)}"  # of the ephemeral server that this process starts
QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_EPHEMERAL_ENABLED": "true",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",  # what fails is told once, in our words
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
    "PREFECT_SERVER_LOGGING_LEVEL": "ERROR",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_CLI_PROMPT": "false",
}


Left = TypeVar("Left")


class EngineUnavailable(RuntimeError):  # noqa: N818 - a state of affairs: the survey goes on without it
    """No Prefect server could be started or reached."""


def survey_with_prefect(runner: StageRunner, finish: Callable[[Step, Products], Left]) -> Left:
    """Run the survey as a Prefect flow on an ephemeral server, or on the one that PREFECT_API_URL names.

    ``finish`` is called in the flow once the map is drawn, with what runs a stage as a task; what it gives is given.
    Raises EngineUnavailable: the server did not start; nothing of the survey has run; PipelineError: from a stage, as
    with the plain engine.
    """
    if inside_flow():
        step = _task_step(runner)
        return finish(step, survey(step))
    with _prefect_home(runner.run.archive.root):
        try:
            from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings
        except ImportError as error:
            raise EngineUnavailable(f"Prefect cannot be imported ({error})") from error
        # The heartbeat thread adds a second to every flow and tells nobody anything on an ephemeral server.
        with temporary_settings(updates={PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None, **_password()}), _guarded_server():
            return _run_flow(runner, finish)


def _password() -> dict[Any, str]:
    """What an ephemeral server and its client need so that it answers this process alone, and no page of a browser."""
    if (
        "PREFECT_API_URL" in os.environ
        or prefect_settings.PREFECT_SERVER_API_AUTH_STRING.value()
        or prefect_settings.PREFECT_API_AUTH_STRING.value()
    ):
        return {}
    known = {
        prefect_settings.PREFECT_API_AUTH_STRING: PASSWORD,
        prefect_settings.PREFECT_SERVER_API_AUTH_STRING: PASSWORD,
    }
    return {**known, prefect_settings.PREFECT_SERVER_CORS_ALLOWED_ORIGINS: "http://127.0.0.1"}


def inside_flow() -> bool:
    """Whether this is the body of a Prefect flow, which then holds the survey's tasks."""
    if "prefect" not in sys.modules:
        return False
    return prefect_context.FlowRunContext.get() is not None


def _task_step(runner: StageRunner) -> Step:
    def ref_of(uri: str) -> StageRef:
        return runner.run.archive.ref(*uri.split("/")[1:])

    before: list[dict[str, str]] = []  # what the last task returned: by this very object Prefect knows it again

    def stage(name: str, inputs: dict[str, str], after: list[dict[str, str]]) -> dict[str, str] | None:
        """One stage of the survey: addresses and keys in, an address and a key out; ``after`` draws the time line."""
        ref = runner(name, *map(ref_of, inputs))
        return None if ref is None else {"uri": ref.uri, "key": ref.key}

    def step(name: str, /, *inputs: StageRef) -> StageRef | None:
        """Run a stage as a task of its name, tried again where a device or a disk did not answer."""
        one = prefect.task(
            name=name,
            task_run_name=f"{name}-{runner.run.name}",
            cache_policy=prefect_cache_policies.NO_CACHE,
            persist_result=False,
            retries=STAGES[name].retries,
            retry_delay_seconds=RETRY_DELAY_S,
            # a device or disk may answer the second time; wrong input will not
            retry_condition_fn=lambda task, run, state: isinstance(state.result(raise_on_failure=False), OSError),
        )(stage)
        found = one(name, {ref.uri: ref.key for ref in inputs}, before)
        if found is None:
            return None
        before[:] = [found]
        return ref_of(found["uri"])

    return step


def _run_flow(runner: StageRunner, finish: Callable[[Step, Products], Left]) -> Left:
    started: list[bool] = []
    stopped: list[KeyboardInterrupt] = []
    left: list[Left] = []

    @prefect.flow(
        name="survey", flow_run_name=f"survey-{runner.run.name}", persist_result=False, validate_parameters=False
    )
    def survey_flow(scene: str, seed: int, budget: float) -> None:
        """Sweep coarsely, look again where it changes the map, draw the map."""
        started.append(True)
        with _stopping(stopped):
            step = _task_step(runner)
            left.append(finish(step, survey(step)))

    settings = runner.run.settings
    try:
        survey_flow(settings.scene, settings.seed, settings.budget)
    except PipelineError:
        raise
    except Exception as error:
        if stopped:  # and the server with it, which Prefect could not tell
            raise stopped[0] from error
        if started:
            raise
        raise EngineUnavailable(f"the Prefect server did not start ({error})") from error
    return left[0]


@contextmanager
def _stopping(stopped: list[KeyboardInterrupt]) -> Iterator[None]:
    """Hear SIGTERM as everywhere, and not as Prefect does; note what stops the flow.

    Whoever ends a service ends the server too: Prefect then tries but once to tell it, and not for a minute.
    """
    with terminable():
        try:
            yield
        except KeyboardInterrupt as error:
            stopped.append(error)
            prefect_settings.get_current_settings().client.max_retries = 0
            raise


@contextmanager
def _guarded_server() -> Iterator[None]:
    """Let a server started meanwhile end with this process, also when it is killed: Prefect ends it at exit alone."""
    if "PREFECT_API_URL" in os.environ:
        yield
        return
    start = getattr(prefect_server.SubprocessASGIServer, "_run_uvicorn_command", None)
    if start is None:  # another version of Prefect: its server is ended at exit, not after a kill
        yield
        return

    def guarded(self: prefect_server.SubprocessASGIServer) -> subprocess.Popen[Any]:
        process: subprocess.Popen[Any] = start(self)
        atexit.register(end_with_us(process.pid))  # asked before Prefect asks for its server's end, so called after it
        return process

    prefect_server.SubprocessASGIServer._run_uvicorn_command = guarded  # type: ignore[method-assign]
    try:
        yield
    finally:
        prefect_server.SubprocessASGIServer._run_uvicorn_command = start  # type: ignore[method-assign]


@contextmanager
def _prefect_home(archive: Path) -> Iterator[None]:
    """Keep Prefect's files in the archive (a second survey: a home of its own); a user's server and home are left."""
    home = archive / ".prefect"
    release = take_lock(archive / ".locks" / "prefect.lock", wait=False)
    if release is None:
        home = archive / f".prefect-{os.getpid()}"
        atexit.register(remove_tree, home)  # asked before Prefect asks for its server's end, so called after it
    wanted = {**QUIET, "PREFECT_HOME": str(home)}
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
        if release is not None:
            release()
