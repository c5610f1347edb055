"""A dive that is followed, with its source: what the command line and the studio show."""

import json
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import need_stage
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import NavigationError, PlanError
from alice_survey.kit.words import share
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate
from missions.coverage.holes import Hole
from missions.exports.write import counted
from missions.fly.check import rig_of
from missions.fly.refly import write_refly
from missions.follow.blocks import CoverageBlocks
from missions.follow.follower import DiveFollower, Fix
from missions.follow.links import (
    UDP_PORT,
    MavlinkSource,
    RosSource,
    UdpSource,
    altimeter_from_glass,
)
from missions.follow.proposal import Budget, Proposal
from missions.follow.rows import NavigationSource
from missions.follow.tail import NavigationTail, ReplayedLog
from missions.route.energy import craft_of
from missions.values.plan_file import Plan, read_plan

_BUSY = 4.0
"""Holes are looked for no more often than after so many times the time that it took."""
_MIN_S = 1.0
_MAX_LISTED = 200
_WINDOW_S = 1.0
"""News are late by what is waited for packets to be in order."""


def open_source(name: str, plan: Plan, rig: Rig, config: SurveyConfig) -> NavigationSource:
    """The source of a name.

    Args:
        name: a navigation CSV; `udp`, `udp:PORT` or `udp:ADDRESS:PORT`; `mavlink:URL` of pymavlink;
            `ros` or `ros:TOPIC`.
        plan: for its datum.
        rig: for the altimeter's place from the glass.
        config: for the altimeter's place.

    Raises:
        NavigationError: the name cannot be used.
        VehicleError: what it needs is not installed, or cannot be opened.
    """
    kind, _, rest = name.partition(":")
    if kind == "udp":
        host, _, port = rest.rpartition(":")
        number = port or str(UDP_PORT)
        if not (number.isdecimal() and int(number) < 65536):
            raise NavigationError(f"{name}: {number!r} is no port: give udp:{UDP_PORT}")
        return UdpSource(plan.datum, int(number), host or "127.0.0.1")
    place = altimeter_from_glass(rig, config.camera.dvl_position_body_m)
    if kind == "mavlink":
        return MavlinkSource(rest or "udpin:127.0.0.1:14550", plan.datum, place)
    if kind == "ros":
        vehicle = craft_of(config.vehicle).name
        return RosSource(plan.datum, place, vehicle, **({"odometry": rest} if rest else {}))
    if Path(name).is_dir():
        raise NavigationError(f"{name}: is a folder: give the navigation CSV that grows")
    return NavigationTail(Path(name))


class DiveSession:
    """A dive, its source and what was found; for any number of threads."""

    def __init__(
        self, workspace: Path, config: SurveyConfig, source_name: str, *,
        dive: int | None = None, replay: float | None = None,
    ) -> None:  # fmt: skip
        """Open a source; nothing is read yet.

        Args:
            workspace: with the plan.
            config: the survey.
            source_name: as of `open_source`.
            dive: which dive of the plan, from 1 on; None: found by its lines.
            replay: a finished CSV again, so many times as fast as it was flown.

        Raises:
            AliceError: there is no plan, or the source cannot be opened.
        """
        self.config, self.workspace = config, workspace
        self.plan = read_plan(need_stage(workspace, "plan", "plan") / "plan.json")
        self.rig = rig_of(workspace, config.camera, config.water)
        self.follower = DiveFollower(self.plan, self.rig, config, dive)
        self.source: NavigationSource
        if replay is None:
            self.source = open_source(source_name, self.plan, self.rig, config)
        else:
            if not Path(source_name).is_file():
                raise NavigationError(f"{source_name}: is no file: give a finished navigation CSV")
            self.source = ReplayedLog(Path(source_name), replay)
        self.blocks = CoverageBlocks(self.follower.coverage)
        self.lock = threading.RLock()
        self.proposal: Proposal | None = None
        self.may_take_s: float | None = None
        """What lines over holes may take; None: what the dive has to spare."""
        self.fault: str | None = None
        """Why nothing more can come."""
        self._heard_wall_s: float | None = None
        self._expected: Certificate | None = None
        self.holes: tuple[Hole, ...] = ()
        self._look_wall_s, self._is_current = -math.inf, False

    def close(self) -> None:
        """Let go of the source."""
        with self.lock:
            self.source.close()

    def step(self, wall_s: float | None = None) -> int:
        """Take what has come, and look for holes where it is time.

        Args:
            wall_s: time of this machine's steady clock.

        Returns:
            How many rows have come.
        """
        wall_s = time.monotonic() if wall_s is None else wall_s
        with self.lock:
            if self.fault is not None:
                return 0
            try:
                pieces = self.source.poll(wall_s)
            except NavigationError as error:
                self.fault = str(error)
                return 0
            came = sum(len(piece.rows) for piece in pieces)
            for window in self.follower.add(pieces):
                self.blocks.touch(window)
            if came:
                self._heard_wall_s, self._is_current = wall_s, False
            is_due = self.follower.fix is not None and wall_s >= self._look_wall_s
            if is_due and not self._is_current:
                self.look(wall_s)
            return came

    def read_all(self) -> None:
        """Take all that a file holds now."""
        while self.step():
            pass
        self.look(time.monotonic())

    def look(self, wall_s: float) -> None:
        """Find what will be seen, and the holes that are left."""
        with self.lock:
            began = time.perf_counter()
            self._expected, self.holes = self.follower.expected()
            took_s = time.perf_counter() - began
            self._look_wall_s = wall_s + max(_MIN_S, _BUSY * took_s)
            self._is_current = True

    def propose(self) -> Proposal | None:
        """Lines that close the holes, in `may_take_s` or what the dive has to spare."""
        with self.lock:
            budget = self.follower.to_spare()
            if self.may_take_s is not None:
                budget = Budget(time_s=self.may_take_s, energy_wh=budget.energy_wh)
            self.proposal = self.follower.propose(budget)
            return self.proposal

    def accept(self) -> Proposal:
        """Follow the proposal from now on.

        Raises:
            PlanError: there is none.
        """
        with self.lock:
            if self.proposal is None:
                raise PlanError("there is no proposal to accept: look for one first")
            proposal, self.proposal = self.proposal, None
            self.follower.accept(proposal)
            self.look(time.monotonic())
            return proposal

    def allow(self, seconds: float) -> None:
        """Say in how many seconds the vehicle has to be up."""
        with self.lock:
            limits = self.follower.limits
            until_s = self.follower.elapsed_s + seconds
            self.follower.limits = replace(limits, dive_s=until_s)

    def write_proposal(self, folder: Path) -> str:
        """Write the proposal as a workspace with exports.

        Returns:
            What it takes, in words.

        Raises:
            PlanError: there is none.
        """
        with self.lock:
            proposal = self.proposal or self.follower.accepted
        if proposal is None:
            raise PlanError("there is no proposal to write")
        return write_refly(
            folder, proposal.plan, self.rig, self.config.camera, self.config.water,
            self.config.plan,
        )[0]  # fmt: skip

    def state(self, wall_s: float | None = None) -> dict[str, Any]:
        """All figures, as JSON values; NaN and infinite ones are None."""
        wall_s = time.monotonic() if wall_s is None else wall_s
        with self.lock:
            return _finite(self._state(wall_s))

    def _state(self, wall_s: float) -> dict[str, Any]:
        follower, progress = self.follower, self.follower.progress
        heard = self._heard_wall_s
        age_s = None if heard is None else wall_s - heard
        patience_s = follower.pictures.longest_gap_s + _WINDOW_S
        finish, spare = follower.to_finish(), follower.to_spare()
        coverage, tally = follower.coverage, follower.pictures.tally
        pace, pace_sigma, _ = progress.pace.fitted()
        lines = follower.lines_json()
        expected = self._expected
        return {
            "source": self.source.name,
            "fault": self.fault,
            "phase": follower.phase,
            "silent_s": age_s,
            "patience_s": patience_s,
            "is_silent": age_s is not None and age_s > patience_s,
            "fix": None if follower.fix is None else _fix_json(follower.fix),
            "planned_altitude_m": self.plan.altitude_m,
            "dive": {"number": progress.dive + 1, "of": len(self.plan.dives)},
            "lines": {
                "done": sum(line["state"] == "done" for line in lines),
                "left": sum(line["state"] != "done" for line in lines),
                "now": progress.line + 1 if progress.line >= 0 else None,
            },
            "elapsed_s": follower.elapsed_s,
            "pace": {"ratio": pace, "sigma": pace_sigma, "parts": progress.pace.parts},
            "finish": {
                "time_s": finish.time_s, "sigma_s": finish.sigma_s, "energy_wh": finish.energy_wh
            },
            "spent_wh": progress.spent_wh(),
            "limit": {
                "dive_s": follower.limits.dive_s, "usable_wh": follower.limits.usable_wh
            },
            "spare": {"time_s": spare.time_s, "energy_wh": spare.energy_wh},
            "coverage": {
                "seen": coverage.covered_share,
                "stereo": coverage.stereo_share,
                "at_overlap": coverage.share_at_overlap,
                "expected_at_overlap": None if expected is None else expected.share_at_overlap,
                "planned_at_overlap": follower.planned_share,
                "area_m2": self.plan.area.survey.area,
            },
            "holes": {
                "count": len(self.holes),
                "area_m2": sum(hole.area_m2 for hole in self.holes),
                "unseen_m2": sum(hole.unseen_m2 for hole in self.holes),
            },
            "pictures": {
                "counted": coverage.stations,
                "triggered": tally.triggered,
                "lost_in_gaps": tally.lost,
                "without_range": tally.no_range,
                "too_high": tally.high,
                "below": tally.below,
            },
            "left_out": {**self.source.left_out, **follower.left_out},
            "gaps": follower.gap_count,
            "proposal": None if self.proposal is None else _short(self.proposal),
            "accepted": None if follower.accepted is None else _short(follower.accepted),
        }  # fmt: skip

    def holes_json(self) -> list[dict[str, Any]]:
        """The holes with their outlines, worst first."""
        with self.lock:
            holes = self.holes[:_MAX_LISTED]
        return [
            {
                **hole.to_json(),
                "rings_ne": [
                    np.round(np.asarray(part.exterior.coords), 3).tolist()
                    for part in hole.outline.geoms
                ],
            }
            for hole in holes
        ]


def follow_report(
    workspace: Path,
    config: SurveyConfig,
    log: str,
    *,
    every_s: float | None = None,
    dive: int | None = None,
    out: Path | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """`alice-survey plan follow`: the state of a dive, once or again and again.

    Args:
        workspace: with the plan.
        config: the survey.
        log: as of `open_source`.
        every_s: seconds between states; None: once, of what a file holds now.
        dive: which dive of the plan, from 1 on.
        out: folder for a plan over the holes with its exports, written where there are some.

    Yields:
        Text, and the same as JSON values.

    Raises:
        AliceError: there is no plan, the source cannot be used, or a link is looked at once.
    """
    session = DiveSession(workspace, config, log, dive=dive)
    try:
        if every_s is None:
            if not isinstance(session.source, NavigationTail):
                raise NavigationError(f"{log}: a link has to be listened to: give --every")
            session.read_all()
            yield _report_of(session, out)
            return
        due_s = time.monotonic()
        while session.fault is None:
            session.step()
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + every_s
                yield _report_of(session, out)
            time.sleep(min(0.2, every_s))
        yield _report_of(session, out)
    finally:
        session.close()


def _report_of(session: DiveSession, out: Path | None) -> tuple[str, dict[str, Any]]:
    if session.fault is not None:
        raise NavigationError(session.fault)
    if session.follower.fix is not None:
        session.propose()
    state = session.state()
    state["hole_list"] = session.holes_json()
    text = state_text(state)
    if out is not None and session.proposal is not None:
        words = session.write_proposal(out)
        state["written"] = str(out)
        text += f"\n{out}: {words}"
    return text, state


def state_text(state: dict[str, Any]) -> str:
    """The state in a few lines."""
    fix = state["fix"]
    if fix is None:
        return f"{state['source']}: no position yet{_counts(state)}"
    finish, spare, coverage = state["finish"], state["spare"], state["coverage"]
    lines, holes = state["lines"], state["holes"]
    left = f"{_minutes(finish['time_s'])} +- {_minutes(finish['sigma_s'])} to the surface"
    spared = [
        _minutes(spare["time_s"]) if spare["time_s"] is not None else "",
        f"{spare['energy_wh']:.0f} Wh" if spare["energy_wh"] is not None else "",
    ]
    rows = [
        f"{state['source']}: {state['phase']}, {_minutes(state['elapsed_s'])} under water"
        + (f"; no news for {state['silent_s']:.0f} s" if state["is_silent"] else ""),
        f"  lines: {lines['done']} done, {lines['left']} left; {left}, "
        f"{finish['energy_wh']:.0f} Wh; to spare: {' and '.join(filter(None, spared))}",
        f"  seen {share(coverage['seen'], 1)}, in stereo {share(coverage['stereo'], 1)}, at the "
        f"requested overlap {share(coverage['at_overlap'], 1)}; "
        f"{share(coverage['expected_at_overlap'] or 0.0, 1)} when the lines left are flown",
        f"  holes behind it: {holes['count']}, {holes['area_m2']:.2f} m2, of which "
        f"{holes['unseen_m2']:.2f} m2 in no picture{_counts(state)}",
    ]
    proposal = state["proposal"]
    if proposal is not None:
        rows.append(
            f"  proposed: {counted(proposal['lines'], 'line')} more, "
            f"{_minutes(proposal['extra_s'])} and {proposal['extra_wh']:.1f} Wh, for "
            f"{proposal['gain_m2']:.2f} m2: then {share(proposal['share_at_overlap'], 1)}"
        )
    return "\n".join(rows)


def _counts(state: dict[str, Any]) -> str:
    left_out = {why: count for why, count in state["left_out"].items() if count}
    if not left_out:
        return ""
    return "\n  left out: " + "; ".join(f"{count} {why}" for why, count in left_out.items())


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(abs(seconds)), 60)
    return f"{'-' if seconds < 0 else ''}{minutes}:{rest:02d} min"


def _short(proposal: Proposal) -> dict[str, Any]:
    data = proposal.to_json()
    return {**data, "lines": len(proposal.plan.lines), "route_ne": None}


def _fix_json(fix: Fix) -> dict[str, float]:
    return {name: getattr(fix, name) for name in Fix.__dataclass_fields__}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Values in which numbers that are not finite are None."""
    found: dict[str, Any] = json.loads(json.dumps(values), parse_constant=lambda _: None)
    return found
