"""The tab that follows a dive: its state, coverage, track, holes, and a plan over these."""

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

from alice_survey.app.pipeline import settings
from alice_survey.app.studio.endpoints.base import (
    Call,
    Content,
    Endpoint,
    FormatRequest,
    Studio,
    zip_files,
)
from alice_survey.core.config import Config
from alice_survey.core.contents import one_line
from alice_survey.core.errors import AliceError, NavigationError, known_fault
from missions.exports.format import options_of
from missions.exports.registry import format_names
from missions.exports.write import write_exports
from missions.follow.dive import FollowedDive

_LOG = logging.getLogger("uvicorn.error")
"""Where the server reports its bugs too."""
_POLL_S, _ALIVE_S = 0.5, 5.0
"""A log is looked at twice a second; pages are sent news of a silent one every few seconds."""
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


class _Since(Config):
    after: float = -1e9
    """Seconds of the last fix that the page has."""


class FollowTab:
    """The dive that a studio follows, if any, with the thread that reads its log."""

    def __init__(self, studio: Studio) -> None:
        """Open the log of the command line, if there is one."""
        self._studio = studio
        self._lock = threading.Lock()
        self._dive: FollowedDive | None = None
        self._ended: threading.Event | None = None
        self._fault: str | None = None
        if studio.log is not None:
            try:
                self._open(studio.log)
            except AliceError as error:
                self._fault = str(error)

    # ---- One dive at a time ----------------------------------------------------------------

    def _open(self, log: str) -> None:
        folder = self._studio.workspace.folder
        self._close()
        followed = FollowedDive(folder, settings(folder, None, needed=False), log)
        ended = threading.Event()
        self._dive, self._ended, self._fault = followed, ended, None
        threading.Thread(target=self._work, args=(followed, ended), daemon=True).start()

    def _close(self) -> None:
        if self._ended is not None:
            self._ended.set()
        self._dive = None

    def _require_dive(self) -> FollowedDive:
        dive = self._dive
        if dive is None:
            raise NavigationError(self._fault or "no dive is followed: choose its log first")
        return dive

    def _work(self, dive: FollowedDive, ended: threading.Event) -> None:
        """Look at the log until another one is opened, or the studio ends."""
        sent_s = -math.inf
        while not (ended.is_set() or self._studio.ending.is_set()):
            try:
                news = dive.update()
                if news and dive.fault is None:
                    self._studio.publish("follow", self._state_of(dive))
                    dive.propose()
            except Exception as error:  # libraries raise known faults as all kinds; a bug is logged
                dive.fault = known_fault(error) or f"{type(error).__name__}: {one_line(error)}"
                if known_fault(error) is None:
                    _LOG.exception("following a dive has failed")
                    ended.set()
                news = True
            if (news or time.monotonic() >= sent_s + _ALIVE_S) and self._dive is dive:
                self._studio.publish("follow", self._state_of(dive))
                sent_s = time.monotonic()
            ended.wait(_POLL_S)

    # ---- What pages ask ----------------------------------------------------------------------

    def state(self, call: Call) -> dict[str, Any]:
        """Figures of the dive, and the logs to choose from."""
        dive = self._dive
        return {
            **({"following": False, "fault": self._fault} if dive is None
               else self._state_of(dive)),
            "logs": self._logs(),
            "formats": format_names(),
        }  # fmt: skip

    def _state_of(self, dive: FollowedDive) -> dict[str, Any]:
        return {**dive.snapshot(), "following": True}

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
        """Follow a log of the workspace."""
        ask = call.read(_Open)
        if ask.log not in self._logs():
            raise FileNotFoundError(ask.log)
        path = self._studio.workspace.file(ask.log.split("/"))
        with self._lock:
            self._open(str(path))
        return self.state(call)

    def end(self, call: Call) -> dict[str, Any]:
        """Follow nothing any more."""
        with self._lock:
            self._close()
        return self.state(call)

    def dive(self, call: Call) -> dict[str, Any]:
        """Fixes since one, lines with their states, and holes, worst first."""
        dive = self._require_dive()
        return {
            "fixes": dive.track(call.ask(_Since).after),
            "lines": dive.lines(),
            "holes": dive.holes(),
        }

    def coverage(self, call: Call) -> Content:
        """What is seen so far as a picture, north up."""
        classes = self._require_dive().coverage_classes()
        bgra = cv2.cvtColor(_COLOURS[classes], cv2.COLOR_RGBA2BGRA)
        return Content(data=cv2.imencode(".png", bgra)[1].tobytes(), kind="image/png")

    def export(self, call: Call) -> Content:
        """The plan over the holes as missions for vehicles: one format or all, zipped."""
        dive = self._require_dive()
        requested = call.ask(FormatRequest).format
        with dive.lock:
            plan = dive.proposal
        if plan is None:
            raise NavigationError("there is no plan over holes to export")
        config = dive.config
        options = options_of(config.camera, config.plan, config.vehicle, config.sea)
        with tempfile.TemporaryDirectory(prefix="alice-survey-") as folder:
            files = write_exports(
                Path(folder), plan, dive.rig,
                formats=[requested] if requested else None, options=options,
            )  # fmt: skip
            name = f"holes{f'_{requested}' if requested else ''}.zip"
            return zip_files(name, {path.name: path for path in files})


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
        Endpoint(path="/api/follow/dive", answer=tab.dive),
        Endpoint(path="/api/follow/coverage", answer=tab.coverage, computes=True),
        Endpoint(path="/api/follow/export", answer=tab.export),
        change("/api/follow/open", tab.open),
        change("/api/follow/end", tab.end),
    )
