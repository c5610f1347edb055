"""The Run tab: the stages, and the job that makes them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from alice_survey.app.studio.endpoints.base import Call, Endpoint, Studio
from alice_survey.app.studio.survey_state import survey_state, ways_on
from alice_survey.core.config import Config


class _AskedCommand(Config):
    name: str
    arguments: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True)
class _RunTab:
    studio: Studio

    def state(self, call: Call) -> dict[str, Any]:
        """Everything that the tab shows."""
        state = self.studio.jobs.state()
        last = state["last"]
        if last is not None:
            last["ways"] = ways_on(last["line"]) if last["state"] == "failed" else []
        found = survey_state(self.studio.workspace.folder) | state
        if last is not None and last["name"] == "import-images" and not found["imported"]:
            found["new"] = found["new"] or last["state"] != "done"
        return found

    def job(self, call: Call) -> dict[str, Any]:
        """The job alone."""
        return self.studio.jobs.state()

    def start(self, call: Call) -> dict[str, Any]:
        """Start a command of the list."""
        asked = call.read(_AskedCommand)
        return {"job": self.studio.jobs.start(asked.name, asked.arguments)}

    def stop(self, call: Call) -> dict[str, Any]:
        """End the running job as Ctrl-C would."""
        return {"stopping": self.studio.jobs.stop()}

    def log(self, call: Call) -> dict[str, Any]:
        """Lines of a job's log after those that the page has."""
        after = call.number("after") if "after" in call.query else 0
        return self.studio.jobs.log(int(call.number("job")), int(after))

    def history(self, call: Call) -> dict[str, Any]:
        """Jobs that have ended."""
        return {"jobs": self.studio.jobs.history()}


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """State, start, stop, log and history."""
    run = _RunTab(studio)
    return (
        Endpoint(path="/api/run", answer=run.state),
        Endpoint(path="/api/run/job", answer=run.job),
        Endpoint(path="/api/run/start", answer=run.start, method="POST", writes=True),
        Endpoint(path="/api/run/stop", answer=run.stop, method="POST", writes=True),
        Endpoint(path="/api/run/log", answer=run.log),
        Endpoint(path="/api/run/history", answer=run.history),
    )
