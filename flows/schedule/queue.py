"""What of a schedule stands in Prefect: one flow run a due time, made once, and taken back where it is accounted for.

Prefect's own scheduler is not used: it makes runs of a new deployment late, and knows nothing of what the ledger has
already.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from flows.schedule.ledger_state import moment_words, read_moment

SKIPPED = "Skipped"  # the name of the state of what was taken back here, not by a person
MOST_RUNS = 200  # that wait, looked at in one go; the server gives no more
MOST_TRIES = 3  # flow runs of one due time that ended without a beginning in the ledger


@dataclass
class FlowRuns:
    """The flow runs of one field, by the due times that they were made for."""

    name: str
    tries: dict[datetime, int] = field(default_factory=dict)
    known: bool = False  # to Prefect: the runner that was just started tells it of the field in some seconds

    def settle(
        self, client: Any, wanted: Mapping[datetime, int], now: datetime, spared: Collection[datetime] = ()
    ) -> list[datetime]:
        """Have a flow run for each due time that is wanted, by how often it was begun, and none for any other.

        Those of ``spared`` are neither made nor taken back. Gives the due times whose run somebody cancelled.
        """
        waiting = self._waiting(client)
        for due in waiting.keys() - wanted.keys() - set(spared):
            self._take_back(client, due, waiting[due], now, "it is accounted for already, or not served any more")
        self.tries = {due: number for due, number in self.tries.items() if due in wanted}
        missing = [due for due in wanted if due not in waiting and due not in spared]
        deployment = self._deployment(client)
        self.known = deployment is not None
        return [due for due in missing if self.known and not self._plan(client, deployment, due, wanted[due])]

    def stop(self, client: Any, now: datetime) -> None:
        """Take back all that has not begun."""
        for due, runs in self._waiting(client).items():
            self._take_back(client, due, runs, now, "the schedule was stopped")

    def give_up(self, client: Any, due: datetime) -> None:
        """A due time's run whose process is gone before it began: another is made at the next look."""
        from prefect.states import Crashed

        for run in self._waiting(client).get(due, []):
            if run.state is not None and run.state.is_pending():
                client.set_flow_run_state(run.id, Crashed(message="it never began"), force=True)

    def _deployment(self, client: Any) -> Any | None:
        from prefect.exceptions import ObjectNotFound

        try:
            return client.read_deployment_by_name(f"survey/{self.name}").id
        except ObjectNotFound:
            return None

    def _plan(self, client: Any, deployment: Any, due: datetime, begun: int) -> bool:
        """Make a due time's flow run: asked again Prefect gives the same one. False where somebody cancelled it."""
        from prefect.states import Scheduled

        while (number := self.tries.setdefault(due, 0)) < MOST_TRIES:
            run = client.create_flow_run_from_deployment(
                deployment,
                parameters={"due": moment_words(due)},
                state=Scheduled(scheduled_time=due),
                name=f"survey-{self.name}",
                idempotency_key=f"{self.name} {moment_words(due)} {begun} {number}",
            )
            if run.state is None or not run.state.is_final():
                return True
            if run.state.is_cancelled() and run.state.name != SKIPPED:
                return False
            self.tries[due] = number + 1
        return True

    def _take_back(self, client: Any, due: datetime, runs: Iterable[Any], now: datetime, why: str) -> None:
        """No process is started for these any more. Of those to come nothing is left: they may be planned again."""
        from prefect.states import Cancelled

        for run in runs:
            if run.state is None or not run.state.is_scheduled():
                continue  # a process was started for it, and finds out by itself
            if due > now:
                client.delete_flow_run(run.id)
            else:
                client.set_flow_run_state(run.id, Cancelled(name=SKIPPED, message=why))

    def _waiting(self, client: Any) -> dict[datetime, list[Any]]:
        """Flow runs of the field that have not begun, by the due times that they were made for."""
        from prefect.client.schemas.filters import (
            DeploymentFilter,
            DeploymentFilterName,
            FlowFilter,
            FlowFilterName,
            FlowRunFilter,
            FlowRunFilterState,
            FlowRunFilterStateType,
        )
        from prefect.client.schemas.objects import StateType

        of_type = FlowRunFilterStateType(any_=[StateType.SCHEDULED, StateType.PENDING])
        found = client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=["survey"])),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[self.name])),
            flow_run_filter=FlowRunFilter(state=FlowRunFilterState(type=of_type)),
            limit=MOST_RUNS,
        )
        runs: dict[datetime, list[Any]] = {}
        for run in found:
            due = read_moment(run.parameters.get("due"))
            if due is None and run.auto_scheduled:  # an earlier version left it to Prefect
                due = run.expected_start_time
            if due is not None:
                runs.setdefault(due, []).append(run)
        return runs
