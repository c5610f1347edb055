"""A plan flown live: measurements in, commands out, whatever carries them, and a record of both.

A transport hands over what it hears (`hear_odometry`, `hear_range`, `hear_thrusters`) with its
stamp, and calls `LiveMission.tick` every 0.05 s with the time on the same clock. The pilot is that
of the closed loop in simulation.

What is flown by is never old, wrong or of another clock:

- odometry that is not finite, older than `LinkLimits.odometry_s` when it arrives, from the future
  or not newer than what came before is refused;
- so is odometry that is fresh but wrong (`OdometryCheck`): a pose that stands still to the last bit
  while the vehicle is flown, one that jumps, a speed that the vehicle cannot reach, and a velocity
  that is not that of the positions;
- ticks that are farther apart than `LinkLimits.jump_s`, or go back, are a jump of the clock: all
  that was heard before is forgotten;
- an altitude older than `LinkLimits.altitude_s` is not known, which the pilot itself handles.

Without odometry to fly by the thrust is zero (HELD) until it is back, at most `LinkLimits.grace_s`.
After that the mission is given up for good (GIVEN_UP): the vehicle pushes itself up, or its
thrusters stay off, as `LinkLimits.on_loss` has it, until odometry says that it is at the surface,
at most for `PilotLoop.surfacing_s`.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import read_stage, refuse_damage, write_csv
from alice_survey.core.config import VehicleConfig
from alice_survey.core.errors import VehicleError, WorkspaceError, note
from alice_survey.core.frames import Array, attitude_from_rotation, rotation_from_attitude
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.navigation.sensors import DvlSpec
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.command import WATCHED_S, Failure, Pilot
from alice_survey.sim.vehicle.pilot.memory import NONE, REASONS
from alice_survey.sim.vehicle.propulsion import MAX_RPS, electrical_power
from alice_survey.sim.vehicle.rotations import wrap_angle
from alice_survey.sim.vehicle.simulator import TICK_S
from alice_survey.sim.vehicle.steady import top_speed_mps
from alice_survey.sim.vehicle.vehicle import Vehicle
from missions.fly.simulation import (
    FlightSettings,
    max_ascent_s,
    max_mission_s,
    one_dive,
    piloting_of,
)
from missions.route.energy import battery_wh, usable_wh
from missions.values.plan_file import Plan, read_plan

FIRST_S, SILENCE_S = 600.0, 60.0
"""With simulated time nothing ticks without messages: a transport ends after so long without one,
at first (the simulator may have to compile) and later."""
_MAX_STEP_S = 4.0 * TICK_S
"""The pilot's integrals and timers advance by no more in a tick."""
_SAME_S = 1e-6
"""Ticks closer together are the same one: the clock stands still."""
_LATE = 1.5
"""A tick is late when it comes after so many times the usual interval."""
_UNIT = 1e-2
"""How far the norm of a quaternion may be off 1."""
_MAX_TILT_RAD = DvlSpec().max_tilt_rad
"""A beam farther off the vertical is not used."""
_WATCHED_TICKS = round(WATCHED_S / TICK_S)
PHASES = ("dive", "approach", "follow", "ascend", "done", "abort")
"""Names of the guidance's phases, by number."""
RECORD_COLUMNS = (
    "time_s", "state", "phase", "line", "north_m", "east_m", "depth_m", "roll_rad", "pitch_rad",
    "heading_rad", "altitude_m", "glass_north_m", "glass_east_m", "cross_m", "surge_n", "sway_n",
    "heave_n", "roll_nm", "pitch_nm", "yaw_nm",
)  # fmt: skip
"""Columns of the record, followed by `NAME_rps` of each thruster: time on the loop's clock; state
of the loop and phase of the guidance; line of the plan, -1 between lines; what was flown by, empty
without odometry; place of the left port's glass; offset of the path; wrench."""


class LinkState(StrEnum):
    """What the loop does."""

    WAITING = "waiting"
    """No odometry came yet."""
    FLYING = "flying"
    HELD = "held"
    """Thrust is zero until there is odometry to fly by."""
    GIVEN_UP = "given up"
    """For good: odometry was lost for too long."""
    OVER = "over"


@dataclass(frozen=True, kw_only=True)
class LinkLimits:
    """What the loop takes for good, and what it does without."""

    odometry_s: float = 0.5
    """Greatest age of odometry that is flown by: ALICE goes 0.1 m and turns 7 degrees meanwhile
    (inferred)."""
    altitude_s: float = 2.0
    """Greatest age of an altitude, as of the simulated navigation."""
    ahead_s: float = 0.1
    """How far the stamp of a message may be in the future (inferred)."""
    jump_s: float = 0.5
    """Longest time between ticks (inferred)."""
    grace_s: float = 5.0
    """For how long thrust is zero before the mission is given up (inferred)."""
    on_loss: Literal["surface", "drift"] = "surface"
    """After that: push up, or leave the thrusters off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Odometry:
    """Where the vehicle is and how it moves, as a navigation filter of its own has it."""

    stamp_s: float
    position_ned: Array
    """(3,) of the body's origin, from the plan's datum on the sea surface."""
    quaternion_xyzw: Array
    """(4,) `ned_from_body`."""
    velocity_body: Array
    """(3,) of the origin over ground, m/s."""
    rates_body: Array
    """(3,) rad/s."""
    sigma_m: float = 0.0
    """Standard deviation of the position towards north or east; 0 where it is not stated."""

    @property
    def is_finite(self) -> bool:
        """Whether all is a number, and the quaternion of length 1."""
        total = self.position_ned.sum() + self.velocity_body.sum() + self.rates_body.sum()
        length = float(np.linalg.norm(self.quaternion_xyzw))
        return math.isfinite(total + self.stamp_s) and abs(length - 1.0) < _UNIT


@dataclass(frozen=True, kw_only=True, eq=False)
class Command:
    """What the vehicle is to do until the next tick."""

    time_s: float
    """On the clock of the ticks."""
    state: LinkState
    why: str
    """What is wrong, or how the mission ended; empty while all is well."""
    wrench: Array
    """(6,) N and N m, in the body frame."""
    thrust_n: Array
    """(n,)"""
    rps: Array
    """(n,) thruster speeds."""
    velocity_body: Array
    """(3,) over ground, of the origin: what the pilot's outer loops ask for."""
    heading_rad: float
    """Wanted; NaN where there is none."""


_FASTER = 2.0
"""Over the speed that a vehicle reaches in still water: no current carries it faster (inferred)."""
_SIGMAS = 5.0
_STEP_M = 1.0
"""A position may be corrected by so many of its sigmas, or by so much where it states none
(inferred: fixes of a USBL)."""
_FIT_S, _FIT_MPS = 5.0, 0.1
"""Over so long the velocity's integral must be the way of the positions, to so much (inferred)."""


class OdometryCheck:
    """Finds odometry that is fresh but wrong."""

    def __init__(self, max_speed_mps: float) -> None:
        """A check that has seen nothing.

        Args:
            max_speed_mps: over ground, that the vehicle cannot reach.
        """
        self._max_speed_mps = max_speed_mps
        self.forget()

    def forget(self) -> None:
        """Compare with nothing that was heard until now."""
        self._kept: Odometry | None = None
        self._before: Odometry | None = None
        self._silence_s = 0.0
        self._from_s, self._from_ned, self._way_ned = -math.inf, np.zeros(3), np.zeros(3)
        self._fits = True

    def fault(self, odometry: Odometry, *, is_flown: bool) -> str:
        """What is wrong with new odometry, in words; empty if nothing is.

        Args:
            odometry: finite, and newer than any before.
            is_flown: whether the vehicle is flown by it, and so cannot lie still.
        """
        before, self._before = self._before, odometry
        if before is None or not is_flown:
            self._from_s = -math.inf
        if before is not None:
            self._follow(before, odometry)
        if np.linalg.norm(odometry.velocity_body) > self._max_speed_mps:
            return "odometry is faster than the vehicle can be"
        kept = self._kept
        if is_flown and kept is not None and before is not None:
            if _same_pose(before, odometry):
                return "odometry does not change while the vehicle is flown"
            # While positions are refused the vehicle is not taken to come nearer to them.
            if before is kept:
                self._silence_s = odometry.stamp_s - kept.stamp_s
            reach_m = self._max_speed_mps * self._silence_s + _correction_m(odometry, kept)
            if np.linalg.norm(odometry.position_ned - kept.position_ned) > reach_m:
                return "odometry jumps"
        if not self._fits:
            return "odometry's velocity is not that of its positions"
        self._kept = odometry
        return ""

    def _follow(self, before: Odometry, now: Odometry) -> None:
        """Compare the positions' way with the integral of the velocity, stretch by stretch."""
        step_s = now.stamp_s - before.stamp_s
        turn = Rotation.from_quat(now.quaternion_xyzw)
        self._way_ned += step_s * turn.apply(now.velocity_body)
        taken_s = now.stamp_s - self._from_s
        if taken_s < _FIT_S:
            return
        if math.isfinite(taken_s):
            off_m = np.linalg.norm(now.position_ned - self._from_ned - self._way_ned)
            self._fits = bool(off_m <= _FIT_MPS * taken_s + _correction_m(now, before))
        self._from_s, self._from_ned, self._way_ned = now.stamp_s, now.position_ned, np.zeros(3)


def _same_pose(one: Odometry, other: Odometry) -> bool:
    return np.array_equal(one.position_ned, other.position_ned) and np.array_equal(
        one.quaternion_xyzw, other.quaternion_xyzw
    )


def _correction_m(*odometry: Odometry) -> float:
    """By how much a position may be corrected between some odometry."""
    sigma_m = max(one.sigma_m for one in odometry)
    return _SIGMAS * sigma_m if sigma_m > 0.0 else _STEP_M


class PilotLoop:
    """A pilot, and what it has heard so far."""

    def __init__(
        self,
        pilot: Pilot,
        *,
        hull_body_m: Array,
        altimeter_body_m: tuple[float, float, float],
        limits: LinkLimits,
        max_speed_mps: float,
        surfacing_s: float,
    ) -> None:
        """A loop at the start of a mission.

        Args:
            pilot: its guidance's point is followed, and its altitude flown at.
            hull_body_m: (P, 3) points whose clearance is minded.
            altimeter_body_m: place of the altimeter, which looks along the body's down.
            limits: for what is heard.
            max_speed_mps: over ground, that the vehicle cannot reach.
            surfacing_s: for how long it pushes up once the mission is given up.
        """
        self.pilot, self.limits, self.surfacing_s = pilot, limits, surfacing_s
        self._check = OdometryCheck(max_speed_mps)
        self.state, self.failures = LinkState.WAITING, list[Failure]()
        self.refused: Counter[str] = Counter()
        """How many messages were refused, by reason."""
        self.late_ticks, self.ticks, self.jumps = 0, 0, 0
        self.ending = ""
        """How the mission ended, once it is over."""
        self.estimate = np.full(vector.ESTIMATE, np.nan)
        """(14,) what was flown by, at the latest tick."""
        self._altimeter_body = np.array(altimeter_body_m)
        self._low_body = np.vstack([hull_body_m, self._altimeter_body])
        self._odometry: Odometry | None = None
        self._floor: tuple[float, float, float] | None = None
        self._rps: tuple[float, Array] | None = None
        self._stretch: list[tuple[Array, Array]] = []
        self._heading_rad, self._flown_s, self._held_s, self._given_up_s = 0.0, 0.0, 0.0, 0.0
        self._last: Command | None = None
        self._why = "no odometry came yet"

    def hear_odometry(self, odometry: Odometry, now_s: float) -> None:
        """Take odometry, unless it is to be refused."""
        before = self._odometry
        if not odometry.is_finite:
            self.refuse("odometry is not a number")
        elif now_s - odometry.stamp_s > self.limits.odometry_s:
            self.refuse("odometry comes too late")
        elif odometry.stamp_s - now_s > self.limits.ahead_s:
            self.refuse("odometry is from the future")
        elif before is not None and odometry.stamp_s <= before.stamp_s:
            self.refuse("odometry is not newer than before")
        else:
            is_flown = self.state in (LinkState.FLYING, LinkState.HELD)
            fault = self._check.fault(odometry, is_flown=is_flown)
            if fault:
                self.refuse(fault)
            else:
                self._odometry = odometry

    def hear_range(self, stamp_s: float, range_m: float, now_s: float) -> None:
        """Take the range of the altimeter, metres; one that is not finite is no echo."""
        odometry = self._fresh(now_s)
        if not math.isfinite(range_m):
            return
        if not -self.limits.ahead_s <= now_s - stamp_s <= self.limits.altitude_s:
            self.refuse("altitude is not of now")
            return
        if odometry is None:
            return
        turn = Rotation.from_quat(odometry.quaternion_xyzw)
        down = float(turn.apply([0.0, 0.0, 1.0])[2])
        if range_m <= 0.0 or down < math.cos(_MAX_TILT_RAD):
            self.refuse("altitude is not of the bottom")
            return
        depth = odometry.position_ned[2] + turn.apply(self._altimeter_body)[2] + range_m * down
        sigma = math.hypot(DvlSpec().range_noise_m, DvlSpec().range_noise_fraction * range_m)
        self._floor = (stamp_s, float(depth), sigma)

    def hear_thrusters(self, rps: Array, now_s: float) -> None:
        """Take the speeds, (n,) rev/s, at which the thrusters turn."""
        if rps.shape == self.pilot.allocation.command.shape and np.all(np.isfinite(rps)):
            self._rps = (now_s, rps)

    def tick(self, now_s: float) -> Command:
        """The command for now; the one before where the clock stands still."""
        last = self._last
        moved = TICK_S if last is None else now_s - last.time_s
        if last is not None and abs(moved) < _SAME_S:
            return last
        self.ticks += 1
        jumped = not 0.0 < moved <= self.limits.jump_s
        if jumped:
            self.jumps += 1
            self._odometry = self._floor = self._rps = None
            self._check.forget()
            self._why = f"the clock jumped by {moved:.2f} s"
        elif moved > _LATE * TICK_S:
            self.late_ticks += 1
        pushes = self._fly(now_s, TICK_S if jumped else min(moved, _MAX_STEP_S))
        self._last = self._command(now_s, pushes)
        return self._last

    def end(self, how: str) -> None:
        """End the mission from outside, in words."""
        if self.state != LinkState.OVER:
            self.state, self.ending = LinkState.OVER, how

    def _fly(self, now_s: float, step_s: float) -> bool:
        """Steer for a tick; return whether the pilot's thrust counts, or there is none."""
        odometry = self._fresh(now_s)
        if odometry is None and self.state in (LinkState.FLYING, LinkState.HELD):
            self._stretch.clear()
            self.state = LinkState.HELD
            self._held_s += step_s
            if self._held_s > self.limits.grace_s:
                self.state = LinkState.GIVEN_UP
        if self.state == LinkState.GIVEN_UP:
            self.estimate = np.full(vector.ESTIMATE, np.nan)
            if odometry is not None and odometry.position_ned[2] < self.pilot.guidance.surface_m:
                self.end(f"given up: {self._why}")
                return False
            self._given_up_s += step_s
            if self._given_up_s > self.surfacing_s:
                self.end(f"given up: {self._why}; not known to be at the surface")
                return False
            if self.limits.on_loss == "drift":
                return False
            # Without an estimate the pilot pushes the vehicle up.
            self.pilot.steer(self._flown_s, step_s, self.estimate)
            return True
        if self.state == LinkState.OVER or odometry is None:
            return False
        self.state, self._why, self._held_s = LinkState.FLYING, "", 0.0
        self._flown_s += step_s
        self._estimate(odometry, now_s)
        self.pilot.steer(self._flown_s, step_s, self.estimate)
        report = self.pilot.state.report
        if report[slot.PHASE] == slot.DONE or report[slot.AT_SURFACE] == 1.0:
            reason = int(report[slot.REASON])
            self.end("complete" if reason == NONE else f"aborted: {REASONS[reason]}")
            return False
        self._judge(now_s)
        return True

    def _command(self, now_s: float, pushes: bool) -> Command:
        pilot, sees = self.pilot, pushes and self.state == LinkState.FLYING
        velocity = pilot.state.demand[slot.REF_SURGE : slot.REF_YAW]
        none = np.zeros(len(pilot.allocation.thrust))
        return Command(
            time_s=now_s,
            state=self.state,
            why=self.ending or self._why,
            wrench=pilot.wrench.copy() if pushes else np.zeros(6),
            thrust_n=pilot.allocation.thrust.copy() if pushes else none,
            rps=pilot.allocation.command.copy() if pushes else none,
            velocity_body=velocity.copy() if sees else np.zeros(3),
            heading_rad=float(pilot.state.report[slot.TARGET_HEADING]) if sees else math.nan,
        )

    def refuse(self, why: str) -> None:
        """Count a message that is not flown by; the first of a kind is reported."""
        self.refused[why] += 1
        if self.refused[why] == 1:
            note(f"not flown by: {why}")
        if self.state in (LinkState.WAITING, LinkState.HELD):
            self._why = why

    def _fresh(self, now_s: float) -> Odometry | None:
        """The latest odometry, if it can be flown by."""
        if self._odometry is None:
            return None
        age_s = now_s - self._odometry.stamp_s
        if -self.limits.ahead_s <= age_s <= self.limits.odometry_s:
            return self._odometry
        if self.state == LinkState.FLYING:
            self._why = f"the latest odometry is {age_s:.2f} s old"
        return None

    def _estimate(self, odometry: Odometry, now_s: float) -> None:
        """Write what the pilot flies by, as `estimate_vector` has it.

        The sea floor is level at the depth that the latest range met; its sigma is taken off the
        clearance.
        """
        turn = Rotation.from_quat(odometry.quaternion_xyzw)
        roll, pitch, heading = attitude_from_rotation(turn)
        self._heading_rad += wrap_angle(heading - self._heading_rad)
        estimate = self.estimate
        estimate[vector.NORTH : vector.ROLL] = odometry.position_ned
        estimate[vector.ROLL : vector.U] = roll, pitch, self._heading_rad
        estimate[vector.U : vector.P] = odometry.velocity_body
        estimate[vector.P : vector.ALTITUDE] = odometry.rates_body
        estimate[vector.ALTITUDE] = estimate[vector.CLEARANCE] = math.nan
        self.pilot.state.memory[slot.SIGMA_M] = odometry.sigma_m or math.inf
        if self._floor is None or now_s - self._floor[0] > self.limits.altitude_s:
            return
        _, floor_m, sigma_m = self._floor
        point = self.pilot.guidance.point_body_m
        depths = odometry.position_ned[2] + turn.apply(np.vstack([point, self._low_body]))[:, 2]
        estimate[vector.ALTITUDE] = floor_m - depths[0]
        estimate[vector.CLEARANCE] = floor_m - depths.max() - sigma_m

    def _judge(self, now_s: float) -> None:
        """Look for thrusters that do not turn as commanded, where their speeds are heard."""
        if self._rps is None or now_s - self._rps[0] > self.limits.odometry_s:
            self._stretch.clear()
            return
        self._stretch.append((self.pilot.allocation.command.copy(), self._rps[1]))
        if len(self._stretch) == _WATCHED_TICKS:
            commanded, turned = (np.array(rows) for rows in zip(*self._stretch, strict=True))
            self._stretch.clear()
            self.failures += self.pilot.judge(self._flown_s, commanded, turned)


def plan_to_fly(workspace: Path, dive: int | None, *, edited: bool = False) -> Plan:
    """The plan of a workspace, or one dive of it, from 1 on; an edited one only on request.

    Raises:
        PlanError: the plan lacks that dive.
        WorkspaceError: it is not as it was planned.
    """
    folder = workspace / "plan"
    if not edited:
        try:
            refuse_damage(folder, read_stage(folder))
        except WorkspaceError as error:
            raise WorkspaceError(f"{error}, or fly it as it is with --edited") from None
    return one_dive(read_plan(folder / "plan.json"), dive)


def need_thrusters_alone(vehicle: Vehicle) -> None:
    """Refuse a vehicle whose fins no message commands.

    Raises:
        VehicleError: it has fins.
    """
    if vehicle.fins:
        raise VehicleError(
            f"{vehicle.name} is steered by fins, and thrusters alone are commanded over ROS 2 and "
            "MAVLink: fly it with 'alice-survey fly'"
        )


@dataclass(eq=False)
class LiveMission:
    """A plan with the loop that flies it, and a row for each tick."""

    plan: Plan
    loop: PilotLoop
    vehicle: str
    thrusters: tuple[str, ...]
    rows: list[tuple[float | str, ...]] = field(default_factory=list)

    def tick(self, now_s: float) -> Command:
        """The command for now; it is recorded."""
        ticks = self.loop.ticks
        command = self.loop.tick(now_s)
        if self.loop.ticks > ticks:
            self.rows.append(self._row(command))
        return command

    @property
    def line(self) -> int:
        """Line of the plan that is being flown, -1 between lines."""
        report = self.loop.pilot.state.report
        flying = self.loop.state == LinkState.FLYING and report[slot.PHASE] == slot.FOLLOW
        return int(report[slot.LINE]) if flying else -1

    @property
    def phase(self) -> str:
        """Phase of the guidance."""
        return PHASES[int(self.loop.pilot.state.report[slot.PHASE])]

    def write_record(self, path: Path) -> None:
        """Write the record as CSV, `RECORD_COLUMNS`."""
        header = (*RECORD_COLUMNS, *(f"{name}_rps" for name in self.thrusters))
        write_csv(path, header, self.rows)

    def summary(self) -> tuple[str, dict[str, Any]]:
        """How the mission went, in a line for each thing to know, and as JSON values."""
        loop = self.loop
        lines = [loop.ending or f"ended while {loop.state}"]
        if loop.ticks:
            lines[0] += f"; {loop.ticks} ticks, {loop.late_ticks} late, {loop.jumps} clock jumps"
        lines += [f"refused {count} times: {why}" for why, count in sorted(loop.refused.items())]
        lines += [
            f"{one.thruster} did not turn as commanded: {one.left:.0%} of its thrust was counted on"
            for one in loop.failures
        ]
        return "\n".join(lines), {
            "ending": loop.ending,
            "complete": loop.ending == "complete",
            "ticks": loop.ticks,
            "late_ticks": loop.late_ticks,
            "clock_jumps": loop.jumps,
            "refused": dict(loop.refused),
            "failures_found": [one.thruster for one in loop.failures],
        }

    def _row(self, command: Command) -> tuple[float | str, ...]:
        estimate, pilot = self.loop.estimate, self.loop.pilot
        pose = estimate[vector.NORTH : vector.U]
        glass = pose[:3] + rotation_from_attitude(*pose[3:]).apply(pilot.guidance.point_body_m)
        return (
            command.time_s, str(command.state), self.phase, self.line, *pose.tolist(),
            float(estimate[vector.ALTITUDE]), *glass[:2].tolist(),
            float(pilot.state.report[slot.CROSS]), *command.wrench.tolist(), *command.rps.tolist(),
        )  # fmt: skip


def _surfacing_s(plan: Plan, settings: VehicleConfig, vehicle: Vehicle) -> float:
    """For how long a vehicle that is lost may push itself up.

    Three climbs at the slowest rate, and no longer than the reserve of its battery lasts at full
    power.
    """
    propulsion, count = vehicle.plant.propulsion, len(vehicle.thrusters)
    full_w = np.zeros(count)
    electrical_power(propulsion, propulsion.table[:, MAX_RPS].copy(), np.zeros(6), full_w)
    reserve_j = 3600.0 * (battery_wh(settings) - usable_wh(settings))
    return min(max_ascent_s(plan), reserve_j / float(full_w.sum()))


def mission_of(
    plan: Plan,
    settings: FlightSettings,
    limits: LinkLimits,
    altimeter_body_m: tuple[float, float, float] | None = None,
) -> LiveMission:
    """A mission that flies a plan.

    Args:
        plan: what to fly.
        settings: vehicle, cameras and controller.
        limits: for what is heard.
        altimeter_body_m: place of the altimeter; that of the DVL if not given.

    Raises:
        VehicleError: a setting does not fit the vehicle, it cannot fly the plan, or has fins.
    """
    flies = piloting_of(plan, settings, max_mission_s(plan))
    need_thrusters_alone(flies.vehicle)
    loop = PilotLoop(
        Pilot(flies, TICK_S),
        hull_body_m=flies.vehicle.hull.points_body_m,
        altimeter_body_m=altimeter_body_m or settings.camera.dvl_position_body_m,
        limits=limits,
        max_speed_mps=_FASTER * top_speed_mps(flies.vehicle),
        surfacing_s=_surfacing_s(plan, settings.vehicle, flies.vehicle),
    )
    thrusters = tuple(thruster.name for thruster in flies.vehicle.thrusters)
    return LiveMission(plan, loop, flies.vehicle.name, thrusters)


def pilot_report(
    workspace: Path,
    settings: FlightSettings,
    limits: LinkLimits,
    fly: Callable[[LiveMission], None],
    *,
    altimeter_body_m: tuple[float, float, float] | None,
    record: Path | None,
    edited: bool = False,
) -> tuple[str, dict[str, Any]]:
    """Fly the plan of a workspace with a vehicle outside this program.

    Args:
        workspace: that holds the plan.
        settings: of the survey.
        limits: for what is heard.
        fly: flies the mission to its end: a transport.
        altimeter_body_m: place of the altimeter; that of the DVL if not given.
        record: CSV of what was flown by and commanded, if wanted.
        edited: take the plan as it is, though it is not as it was planned.

    Returns:
        How it went, as text and as JSON values.

    Raises:
        VehicleError: the transport is not installed, or the vehicle cannot fly the plan.
        WorkspaceError: there is no plan.
    """
    plan = plan_to_fly(workspace, settings.vehicle.dive, edited=edited)
    mission = mission_of(plan, settings, limits, altimeter_body_m)
    try:
        fly(mission)
    finally:
        if record is not None:
            mission.write_record(record)
    return mission.summary()
