"""Run the command line: each verb is loaded on demand, and errors become one message and an exit code."""

from __future__ import annotations

import ast
import gc
import importlib.metadata
import importlib.resources
import io
import logging
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from functools import partial

from cyclopts import App, CoercionError, CycloptsError, UnknownOptionError

from spectralzoom.flows.terminal.processes import (
    TERMINATED,
    Terminated,
    answered,
    format_failure,
    place_caches,
    send_no_analytics,
    terminable,
)
from spectralzoom.flows.terminal.progress import say, stderr
from spectralzoom.pipeline.errors import SettingsError

INTERRUPTED = 130
SENT_WITHIN_S = 3.0
STOPPING = "stopping after the present block; what is stored is kept"
VERBS = {  # verb: module of its function, loaded on demand
    "survey": "spectralzoom.flows.cli.survey_verbs",
    "simulate": "spectralzoom.flows.cli.simulate_command",
    "rig check": "spectralzoom.flows.cli.rig_commands",
    "plan": "spectralzoom.flows.archive.plan_command",
    "ls": "spectralzoom.flows.archive.commands",
    "explain": "spectralzoom.flows.archive.explain_command",
    "verify": "spectralzoom.flows.archive.commands",
    "gc": "spectralzoom.flows.archive.commands",
    "push": "spectralzoom.flows.archive.bucket_commands",
    "pull": "spectralzoom.flows.archive.bucket_commands",
    "export": "spectralzoom.flows.archive.export_command",
    "reprocess": "spectralzoom.flows.archive.reprocess_command",
    "serve": "spectralzoom.flows.cli.serve_command",
    "init": "spectralzoom.flows.training.init_command",
    "train": "spectralzoom.flows.cli.model_verbs",
    "evaluate": "spectralzoom.flows.cli.model_verbs",
    "tradeoff": "spectralzoom.flows.tradeoff",
}
GOES_ON = ("survey", "train", "export", "reprocess", "simulate", "serve", "push", "pull")  # verbs that resume


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; an error is one message on stderr."""
    # Sums that are split among threads round differently: results of one seed would depend on the number of cores.
    # numpy reads the variable when a verb first imports it.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in ("stdin", "stdout", "stderr"):
        if (stream := getattr(sys, name)) is None:  # closed: its descriptor must not become that of a file
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: PTH123, SIM115
        elif isinstance(stream, io.TextIOWrapper) and stream.writable():  # a terminal may lack a character
            stream.reconfigure(errors="replace")
    logging.raiseExceptions = False  # else Prefect prints each log that a lost server does not take
    gc.set_threshold(10_000, 20, 20)  # with Python's own, garbage collection takes a third of the time of imports
    with terminable(last=arguments is None), answered(partial(stderr.print, STOPPING, highlight=False)):
        code = _run(sys.argv[1:] if arguments is None else arguments)
    if arguments is None and "prefect.events.worker" in sys.modules:
        _leave_server(code)
    sys.exit(code)


def _leave_server(code: int) -> None:
    """Send Prefect's last events and logs; exit at once with a code where its server does not take them."""
    from spectralzoom.flows.local_server import sent

    if not sent(SENT_WITHIN_S):  # Python would wait for Prefect's threads, which try for minutes
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(code)


def _run(arguments: list[str]) -> int:
    """Run the verb, print its error if there is one, and return the exit code."""
    try:
        send_no_analytics()
        place_caches()  # before numba and matplotlib are imported
        app = build_app(listed={" ".join(arguments[:1]), " ".join(arguments[:2])}.isdisjoint(VERBS))
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except CycloptsError as error:
        what = str(error).partition(" Available commands:")[0].rstrip(".")  # the help lists all commands
        verb = next(iter(error.command_chain or ()), "")
        if isinstance(error, UnknownOptionError) and verb in ("survey", "plan", "simulate"):
            flags = _of_tables(error.token.value)
            what = (
                f"{what.partition('.')[0]}. Settings of tables have the name of the table: {flags}" if flags else what
            )
        if isinstance(error, CoercionError) and error.argument is not None:
            what = f"{what}. {_help_of(error.argument.name, app, error.command_chain or ())}"
        say(f"{what}; see {' '.join(('spectralzoom', *(error.command_chain or ())))} --help")
        return SettingsError.exit_code
    except KeyboardInterrupt as error:
        what, code = ("terminated", TERMINATED) if isinstance(error, Terminated) else ("interrupted", INTERRUPTED)
        resumes = next(iter(arguments), "") in GOES_ON and not any("train-temporal" in word for word in arguments)
        stderr.print(what + ("; run the same command to resume" if resumes else ""), highlight=False)
        return code
    except BrokenPipeError:
        return 1
    except Exception as error:
        message, code = format_failure(error)
        say(message)
        return code
    return code if isinstance(code, int) else 0


def _help_of(flag: str, app: App, verb: Iterable[str]) -> str:
    """Return a flag of a verb with its help, which says what it may be."""
    for word in verb:
        app = app[word]
    described = app.assemble_argument_collection(parse_docstring=True)
    text = next((str(one.parameter.help) for one in described if one.name == flag), "")
    return f"{flag}: {text.rstrip('.')}"


def _of_tables(word: str) -> str:
    """Return the flags of a table, or of the keys of tables, that a word such as ``--exposure-ms`` names."""
    from spectralzoom.flows.settings.flags import KEYS
    from spectralzoom.flows.settings.load import flag_of

    own = word.lstrip("-").partition("=")[0].replace("-", "_")
    return ", ".join(flag_of(key) for key in KEYS if "." in key and own in key.split("."))


def build_app(*, listed: bool) -> App:
    """Return the application; with ``listed`` its help has a line for each verb, read without importing the verb."""
    app = App(
        name="spectralzoom",
        version=lambda: importlib.metadata.version("spectralzoom"),
        help="Survey a field with a hyperspectral line scanner: class map, receipt and report.",
        suppress_keyboard_interrupt=False,  # main reports it
    )
    rig = App(name="rig", help="Check the hardware.")
    app.command(rig)
    for verb, module in VERBS.items():
        group = rig if verb.startswith("rig ") else app
        name = verb.split()[-1]
        summary = {"help": _summary(module, name)} if listed else {}  # replaces all of the verb's own help
        group.command(f"{module}:{name}", name=name, **summary)
    app.register_install_completion_command(name="completion", add_to_startup=False)
    return app


def _summary(module: str, function: str) -> str:
    """Return the first paragraph of a function's docstring, from the source."""
    package, _, name = module.rpartition(".")
    parts = ast.parse(importlib.resources.files(package).joinpath(f"{name}.py").read_bytes()).body
    own = next(part for part in parts if isinstance(part, ast.FunctionDef) and part.name == function)
    return (ast.get_docstring(own) or "").partition("\n\n")[0]


if __name__ == "__main__":
    main()
