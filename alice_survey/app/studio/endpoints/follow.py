"""The tab that follows a dive: its state, coverage, track, holes, and lines that close these."""

import logging
import math
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import Field

from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio, zipped
from alice_survey.core.config import Config
from alice_survey.core.contents import one_line
from alice_survey.core.edited_files import StaleError
from alice_survey.core.errors import AliceError, NavigationError, known_fault
from missions.exports.options import options_of
from missions.exports.registry import format_names
from missions.exports.write import write_exports
from missions.follow.session import DiveSession

_LOG = logging.getLogger("uvicorn.error")
"""Where the server reports its bugs too."""
_POLL_S, _PUBLISH_S, _ALIVE_S = 0.2, 0.5, 5.0
"""A source is asked five times a second; pages hear of it twice a second at most, and of a silent
one every few seconds."""
_MANY_ROWS = 1000
"""After so many rows at once there are more: a log that is opened late is read without a pause."""
_PROPOSE_S, _BUSY = 5.0, 4.0
"""Lines are looked for by themselves every so many seconds at most, and no more often than after so
many times the time that it took."""
_LOG_FOLDERS = ("", "flight", "logs")
_MAX_LOGS = 50
_HEAD = 4096
_COLOURS = np.zeros((256, 4), np.uint8)
"""Colour and opacity of a cell of the coverage: grey not seen, orange in a picture, blue in stereo,
green at the requested overlap."""
_COLOURS[0] = (60, 60, 60, 60)
for _bits in range(1, 8):
    _COLOURS[_bits] = (0, 158, 115, 150) if _bits & 4 else (
        (86, 180, 233, 150) if _bits & 2 else (230, 159, 0, 150)
    )  # fmt: skip


class _Open(Config):
    log: str
    replay: float | None = Field(None, gt=0, le=1000)
    dive: int | None = Field(None, ge=1)


class _Minutes(Config):
    minutes: float | None = Field(None, gt=0, le=6000)


class _Number(Config):
    number: int


class FollowTab:
    """The dive that a studio follows, if any, with the thread that reads its source."""

    def __init__(self, studio: Studio) -> None:
        """Open the log of the command line, if there is one."""
        self._studio = studio
        self._lock = threading.Lock()
        self._session: DiveSession | None = None
        self._ended: threading.Event | None = None
        self._fault: str | None = None
        self._is_new = studio.log is not None
        self._number = 0
        """Counts proposals, so that what is accepted is what was shown."""
        self._tried: tuple[int, float] | None = None
        self._again_s = -math.inf
        self._sent_s, self._news = -math.inf, True
        """When pages heard of it, and whether there is something that they have not heard."""
        if self._is_new:  # links are heard from the start, pages or not
            threading.Thread(target=self._current, daemon=True).start()

    # ---- One session at a time -------------------------------------------------------------

    def _open(self, log: str, replay: float | None, dive: int | None) -> None:
        from alice_survey.app.pipeline import settings

        folder = self._studio.workspace.folder
        self._close()
        config = settings(folder, None, needed=False)
        session = DiveSession(folder, config, log, dive=dive, replay=replay)
        ended = threading.Event()
        self._session, self._ended, self._fault, self._tried = session, ended, None, None
        threading.Thread(target=self._work, args=(session, ended), daemon=True).start()

    def _close(self) -> None:
        if self._session is not None and self._ended is not None:
            self._ended.set()
            self._session.close()
        self._session = None

    def _current(self) -> DiveSession | None:
        """The session; that of the command line is opened the first time."""
        with self._lock:
            if self._is_new and self._studio.log is not None:
                self._is_new = False
                try:
                    self._open(self._studio.log, None, None)
                except AliceError as error:
                    self._fault = str(error)
            return self._session

    def _needed(self) -> DiveSession:
        session = self._current()
        if session is None:
            raise NavigationError(self._fault or "no dive is followed: choose its log first")
        return session

    def _work(self, session: DiveSession, ended: threading.Event) -> None:
        """Read the source until another one is opened, or the studio ends."""
        while not (ended.is_set() or self._studio.ending.is_set()):
            came = 0
            try:
                came = session.step()
                self._news = self._news or came > 0 or session.fault is not None
                self._propose_if_new(session)
            except Exception as error:  # libraries raise known faults as all kinds; a bug is logged
                session.fault = known_fault(error) or f"{type(error).__name__}: {one_line(error)}"
                if known_fault(error) is None:
                    _LOG.exception("following a dive has failed")
                self._news = True
            now_s = time.monotonic()
            due_s = self._sent_s + (_PUBLISH_S if self._news else _ALIVE_S)
            if (now_s >= due_s or session.fault is not None) and not ended.is_set():
                self._news = False
                self._studio.publish("follow", self._state_of(session))
                self._sent_s = time.monotonic()  # to find the state may have taken a while
            if session.fault is not None:
                break
            ended.wait(0.0 if came > _MANY_ROWS else _POLL_S)
        session.close()

    def _propose_if_new(self, session: DiveSession) -> None:
        """Look for lines again when holes have changed, every few seconds at most."""
        holes = (len(session.holes), round(sum(hole.area_m2 for hole in session.holes), 1))
        now_s = time.monotonic()
        if holes == self._tried or now_s < self._again_s:
            return
        self._tried = holes
        before = session.proposal
        if (session.propose() or before) is not None:
            self._number += 1
        self._again_s = now_s + max(_PROPOSE_S, _BUSY * (time.monotonic() - now_s))

    # ---- What pages ask ----------------------------------------------------------------------

    def state(self, call: Call) -> dict[str, Any]:
        """Figures of the dive, and the logs to choose from."""
        session = self._current()
        workspace = self._studio.workspace
        return {
            **({"following": False, "fault": self._fault} if session is None
               else self._state_of(session)),
            "has_plan": workspace.has("plan/plan.json"),
            "logs": self._logs(),
            "formats": format_names(),
        }  # fmt: skip

    def _state_of(self, session: DiveSession) -> dict[str, Any]:
        with session.lock:
            state = session.state()
            blocks = session.blocks
            return {
                **state,
                "following": True,
                "number": self._number,
                "hole_key": hash(tuple((*hole.place_ne, hole.area_m2) for hole in session.holes))
                & 0xFFFFFFFF,
                "blocks": [
                    [*block, version, *blocks.bounds(block)]
                    for block, version in sorted(blocks.versions.items())
                ],
            }

    def _logs(self) -> list[str]:
        """Navigation CSVs of the workspace."""
        found: list[str] = []
        root = self._studio.workspace.folder
        for folder in _LOG_FOLDERS:
            for path in sorted((root / folder).glob("*.csv")):
                name = path.relative_to(root).as_posix()
                if len(found) < _MAX_LOGS and self._studio.workspace.has(name) and _is_log(path):
                    found.append(name)
        return found

    def open(self, call: Call) -> dict[str, Any]:
        """Follow a log of the workspace, or replay it."""
        ask = call.read(_Open)
        if ask.log not in self._logs():
            raise FileNotFoundError(ask.log)
        path = self._studio.workspace.file(ask.log.split("/"))
        with self._lock:
            self._is_new = False
            self._open(str(path), ask.replay, ask.dive)
        return self.state(call)

    def end(self, call: Call) -> dict[str, Any]:
        """Follow nothing any more."""
        with self._lock:
            self._is_new = False
            self._close()
        return self.state(call)

    def track(self, call: Call) -> dict[str, Any]:
        """Fixes since one: seconds of the dive, north, east, altitude, heading, depth."""
        session = self._needed()
        after_s = call.number("after") if "after" in call.query else -math.inf
        with session.lock:
            old, tail = session.follower.track, list(session.follower.tail)
        begin_s = tail[0].dive_s if tail else math.inf
        fixes = [fix for fix in old if fix.dive_s < begin_s] + tail
        return {
            "fixes": [
                [round(fix.dive_s, 2), round(fix.north_m, 3), round(fix.east_m, 3),
                 fix.altitude_m, fix.heading_deg, fix.depth_m]
                for fix in fixes if fix.dive_s > after_s
            ],
        }  # fmt: skip

    def lines(self, call: Call) -> dict[str, Any]:
        """Lines of the dive with their states."""
        session = self._needed()
        with session.lock:
            return {"lines": session.follower.lines_json()}

    def holes(self, call: Call) -> dict[str, Any]:
        """Holes behind the vehicle, worst first."""
        return {"holes": self._needed().holes_json()}

    def block(self, call: Call) -> Content:
        """A block of the coverage as a picture."""
        session = self._needed()
        block = call.whole("row"), call.whole("column")
        with session.lock:
            classes = session.blocks.classes(block)
        bgra = cv2.cvtColor(_COLOURS[classes], cv2.COLOR_RGBA2BGRA)
        return Content(data=cv2.imencode(".png", bgra)[1].tobytes(), kind="image/png")

    def propose(self, call: Call) -> dict[str, Any]:
        """Lines that close the holes, within what is to spare or the minutes given."""
        minutes = call.read(_Minutes).minutes
        session = self._needed()
        with session.lock:
            session.may_take_s = None if minutes is None else 60.0 * minutes
            session.propose()
            self._number += 1
            self._news = True
        return self.proposal(call)

    def proposal(self, call: Call) -> dict[str, Any]:
        """The lines that are proposed, and their route."""
        session = self._needed()
        with session.lock:
            found = session.proposal
            return {
                "number": self._number,
                "proposal": None if found is None else found.to_json(),
            }

    def accept(self, call: Call) -> dict[str, Any]:
        """Count on the proposal that is shown: it is flown after the lines that are left."""
        number = call.read(_Number).number
        session = self._needed()
        with session.lock:
            if number != self._number:
                raise StaleError("other lines are proposed by now: look at them first")
            session.accept()
            self._news = True
        return self._state_of(session)

    def allow(self, call: Call) -> dict[str, Any]:
        """Say in how many minutes the vehicle has to be up."""
        minutes = call.read(_Minutes).minutes
        session = self._needed()
        with session.lock:
            session.allow(math.inf if minutes is None else 60.0 * minutes)
            self._news = True
        return self._state_of(session)

    def export(self, call: Call) -> Content:
        """The proposal as missions for vehicles: one format or all of them, zipped."""
        session = self._needed()
        wanted = call.query.get("format", "")
        with session.lock:
            proposal = session.proposal or session.follower.accepted
        if proposal is None:
            raise NavigationError("there is no proposal to export")
        config = session.config
        options = options_of(config.camera, config.plan, config.vehicle, config.sea)
        with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
            files = write_exports(
                Path(folder), proposal.plan, session.rig,
                formats=[wanted] if wanted else None, options=options,
            )  # fmt: skip
            name = f"holes{f'_{wanted}' if wanted else ''}.zip"
            return zipped(name, {path.name: path for path in files})


def _is_log(path: Path) -> bool:
    """Whether the header of a CSV names times and places."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD).split(b"\n")[0].decode("utf-8-sig", "replace")
    except OSError:
        return False
    names = {name.strip() for name in head.split(",")}
    return bool(names & {"time_s", "time_utc"}) and {"latitude_deg", "longitude_deg"} <= names


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """What the tab asks for."""
    tab = FollowTab(studio)

    def change(path: str, answer: Any) -> Endpoint:
        return Endpoint(path=path, answer=answer, method="POST", writes=True, max_bytes=4096)

    return (
        Endpoint(path="/api/follow/state", answer=tab.state),
        Endpoint(path="/api/follow/track", answer=tab.track),
        Endpoint(path="/api/follow/lines", answer=tab.lines),
        Endpoint(path="/api/follow/holes", answer=tab.holes),
        Endpoint(path="/api/follow/block/{row}/{column}", answer=tab.block),
        Endpoint(path="/api/follow/proposal", answer=tab.proposal),
        Endpoint(path="/api/follow/export", answer=tab.export),
        change("/api/follow/open", tab.open),
        change("/api/follow/end", tab.end),
        change("/api/follow/propose", tab.propose),
        change("/api/follow/accept", tab.accept),
        change("/api/follow/allow", tab.allow),
    )
