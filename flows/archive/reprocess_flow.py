"""The reprocessing of an archive as a Prefect flow, for a deployment beside the surveys of its fields.

No ``from __future__ import annotations`` here: Prefect reads the signatures.
"""

import re
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy
from prefect.types.entrypoint import EntrypointType

from spectralzoom.flows.archive.reprocess_command import reprocess_fields
from spectralzoom.flows.terminal.progress import on_stderr
from spectralzoom.pipeline.errors import ArchiveError

ONE_AT_A_TIME: dict[str, Any] = {  # options of each deployment that is served
    "concurrency_limit": ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW),
    "version": "1",
    "entrypoint_type": EntrypointType.MODULE_PATH,
}


@flow(name="reprocess", flow_run_name="reprocess-{archive}", persist_result=False)
def reprocess(archive: str, field: str | None = None, weights: str | None = None, dry_run: bool = False) -> str:
    """Survey every field of an archive again: what it holds is found, only what has changed is made anew.

    The parameters are those of the command `spectralzoom reprocess`. Returns how it ended. Raises PipelineError: the
    archive or a parameter cannot be used, or no field could be reprocessed.
    """
    named = None if weights is None else Path(weights)
    rows = reprocess_fields(archive, on_stderr(), field=field, weights=named, dry_run=dry_run)["fields"]
    refused = [f"{row['field']}: {row['message']}" for row in rows if row["state"] == "failed"]
    if refused and len(refused) == len(rows):
        raise ArchiveError(f"no field could be reprocessed: {'; '.join(refused)}")
    warned = [f"Warning: {row['field']}: {one}" for row in rows for one in row["warnings"]]
    return ". ".join([*warned, f"some fields failed: {'; '.join(refused)}" if refused else "done"])


def reprocess_deployment(archive: str) -> Any:
    """Return a deployment of the flow for one archive, named by the archive's address and run on request."""
    return reprocess.to_deployment(
        re.sub(r"[^A-Za-z0-9_.-]+", "-", archive).strip("-."),
        paused=False,
        parameters={"archive": archive},
        description=f"Surveys of {archive} again, with newer weights or stages; on request.",
        **ONE_AT_A_TIME,
    )
