"""The command line: one verb a function; errors become one message and an exit code."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback

from cyclopts import CycloptsError, UnknownOptionError

from flows.cli.app import GOES_ON, VERBS, build_app, say, stderr
from flows.settings.renamed import FLAGS
from flows.terminal.processes import TERMINATED, Terminated, format_refusal, place_caches, terminable
from pipeline.errors import PipelineError, SettingsError

INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code; an error that the user should read is one message on stderr."""
    # Read when numpy is first imported, which the verbs do. Split among threads, sums are rounded otherwise: the raw
    # light behind one key, and so the receipt of one seed, would differ with the number of cores.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with terminable(last=arguments is None):
        sys.exit(_run(sys.argv[1:] if arguments is None else arguments))


def _run(arguments: list[str]) -> int:
    """Run the verb; gives the exit code, once what went wrong has been said."""
    try:
        place_caches()  # read when numba and matplotlib are first imported
        app = build_app(listed={" ".join(arguments[:1]), " ".join(arguments[:2])}.isdisjoint(VERBS))
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except CycloptsError as error:
        say(_usage(error))
        return SettingsError.exit_code
    except PipelineError as error:
        say(str(error))
        return error.exit_code
    except KeyboardInterrupt as error:
        what, code = ("terminated", TERMINATED) if isinstance(error, Terminated) else ("interrupted", INTERRUPTED)
        goes_on = "; the same command goes on from here" if next(iter(arguments), "") in GOES_ON else ""
        stderr.print(f"{what}{goes_on}", highlight=False)
        return code
    except BrokenPipeError:
        return 1
    except Exception as error:
        if (refused := format_refusal(error)) is not None:
            say(refused)
            return 1
        with tempfile.NamedTemporaryFile("w", prefix="spectralzoom-", suffix=".log", delete=False) as file:
            traceback.print_exc(file=file)
        say(f"{type(error).__name__}: {error}; this is a defect of SpectralZoom: please report {file.name}")
        return 1
    return code if isinstance(code, int) else 0


def _usage(error: CycloptsError) -> str:
    what = str(error).partition(" Available commands:")[0]  # cut off in the middle: the help has them all
    verb = " ".join(("spectralzoom", *(error.command_chain or ())))
    if isinstance(error, UnknownOptionError):
        word = (error.token.keyword or error.token.value).partition("=")[0]
        now = FLAGS.get(word.removeprefix("--"))
        what = what if now is None else f"Unknown option: {word}; {now}"
    return f"{what.rstrip('.')}; see {verb} --help"


if __name__ == "__main__":
    main()
