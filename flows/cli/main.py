"""Run the command line; errors become one message and an exit code."""

from __future__ import annotations

import gc
import io
import os
import sys

from cyclopts import CycloptsError

from spectralzoom.flows.cli.app import GOES_ON, VERBS, build_app
from spectralzoom.flows.terminal.processes import TERMINATED, Terminated, format_failure, place_caches, terminable
from spectralzoom.flows.terminal.progress import say, stderr
from spectralzoom.pipeline.errors import SettingsError

INTERRUPTED = 130


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
    gc.set_threshold(10_000, 20, 20)  # with Python's own, garbage collection takes a third of the time of imports
    with terminable(last=arguments is None):
        sys.exit(_run(sys.argv[1:] if arguments is None else arguments))


def _run(arguments: list[str]) -> int:
    """Run the verb, print its error if there is one, and return the exit code."""
    try:
        place_caches()  # before numba and matplotlib are imported
        app = build_app(listed={" ".join(arguments[:1]), " ".join(arguments[:2])}.isdisjoint(VERBS))
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except CycloptsError as error:
        what = str(error).partition(" Available commands:")[0].rstrip(".")  # the help lists all commands
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


if __name__ == "__main__":
    main()
