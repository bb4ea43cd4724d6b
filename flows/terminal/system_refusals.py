"""What a machine refuses to a process, in words: memory, threads, disks. No defect, so nothing to report."""

from __future__ import annotations

import resource

from storage.archive.staging import disk_advice

# Of exceptions that are no MemoryError: of torch and of threads; and, where memory is limited, of the loader.
_OF_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread", "cannot allocate memory")
_OF_LIMITED_MEMORY = ("failed to map segment", "could not find/load shared object")


def refusal_words(error: BaseException) -> str | None:
    """What was refused and what to do; None where the error is something else."""
    text, limit = str(error), resource.getrlimit(resource.RLIMIT_AS)[0]
    limited = limit != resource.RLIM_INFINITY
    known = (*_OF_MEMORY, *(_OF_LIMITED_MEMORY if limited else ()))
    if isinstance(error, MemoryError) or any(words in text.lower() for words in known):
        allowed = f"; this process may take {limit / 1e9:.1f} GB (ulimit -v)" if limited else ""
        told = text.partition(". ")[0].rstrip(".") or "the machine has no more"
        return (
            f"memory ran out: {told}{allowed}. Make room or raise the limit, or ask for less: a smaller scene, fewer "
            f"--bands, less --memory, fewer --workers"
        )
    if isinstance(error, OSError) and (advice := disk_advice(error)) is not None:
        where = f" {error.filename}" if error.filename else ""
        return f"the system refused to read or write{where}: {advice}"
    return None
