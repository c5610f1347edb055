"""The pilot's loop: measurements in, commands out, whatever carries them.

A transport hands over what it hears (`hear_odometry`, `hear_range`, `hear_thrusters`) with its
stamp, and calls `tick` every 0.05 s with the time on the same clock. The pilot is that of the
closed loop in simulation.

What is flown by is never old, wrong or of another clock:

- odometry that is not finite, older than `LinkLimits.odometry_s` when it arrives, from the future
  or not newer than what came before is refused;
- ticks that are farther apart than `LinkLimits.jump_s`, or go back, are a jump of the clock: all
  that was heard before is forgotten;
- an altitude older than `LinkLimits.altitude_s` is not known, which the pilot itself handles.

Without odometry to fly by the thrust is zero (HELD) until it is back, at most `LinkLimits.grace_s`.
After that the mission is given up for good (GIVEN_UP): the vehicle pushes itself up, or its
thrusters stay off, as `LinkLimits.on_loss` has it, until odometry says that it is at the surface.
"""

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array, attitude_from_rotation
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.navigation.sensors import DvlSpec
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.command import Pilot
from alice_survey.sim.vehicle.pilot.failures import WATCHED_S, FoundFailure
from alice_survey.sim.vehicle.pilot.memory import DONE
from alice_survey.sim.vehicle.pilot.safety import NONE, REASONS
from alice_survey.sim.vehicle.rotations import wrap_angle
from alice_survey.sim.vehicle.simulator import TICK_S

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

    @property
    def is_finite(self) -> bool:
        """Whether all is a number, and the quaternion of length 1."""
        total = float(
            self.position_ned.sum() + self.velocity_body.sum() + self.rates_body.sum()
            + self.stamp_s
        )  # fmt: skip
        length = float(np.linalg.norm(self.quaternion_xyzw))
        return math.isfinite(total) and abs(length - 1.0) < _UNIT


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


class PilotLoop:
    """A pilot, and what it has heard so far."""

    def __init__(
        self,
        pilot: Pilot,
        *,
        hull_body_m: Array,
        altimeter_body_m: tuple[float, float, float],
        limits: LinkLimits | None = None,
    ) -> None:
        """A loop at the start of a mission.

        Args:
            pilot: its guidance's point is followed, and its altitude flown at.
            hull_body_m: (P, 3) points whose clearance is minded.
            altimeter_body_m: place of the altimeter, which looks along the body's down.
            limits: for what is heard.
        """
        self.pilot, self.limits = pilot, limits or LinkLimits()
        pilot.state.memory[slot.SIGMA_M] = math.inf  # odometry is not asked for its sigma
        self.state, self.failures = LinkState.WAITING, list[FoundFailure]()
        self.refused: Counter[str] = Counter()
        """How many messages were refused, by reason."""
        self.late_ticks, self.ticks, self.jumps = 0, 0, 0
        self.estimate = np.full(vector.ESTIMATE, np.nan)
        """(14,) what was flown by, at the latest tick."""
        self._altimeter_body = np.array(altimeter_body_m)
        self._low_body = np.vstack([hull_body_m, self._altimeter_body])
        self._odometry: Odometry | None = None
        self._floor: tuple[float, float, float] | None = None
        self._rps: tuple[float, Array] | None = None
        self._stretch: list[tuple[Array, Array]] = []
        self._heading_rad, self._flown_s, self._held_s = 0.0, 0.0, 0.0
        self._last: Command | None = None
        self._ending, self._why = "", "no odometry came yet"

    @property
    def ending(self) -> str:
        """How the mission ended, once it is over."""
        return self._ending

    def hear_odometry(self, odometry: Odometry, now_s: float) -> None:
        """Take odometry, unless it is to be refused."""
        before = self._odometry
        if not odometry.is_finite:
            self._refuse("odometry is not a number")
        elif now_s - odometry.stamp_s > self.limits.odometry_s:
            self._refuse("odometry comes too late")
        elif odometry.stamp_s - now_s > self.limits.ahead_s:
            self._refuse("odometry is from the future")
        elif before is not None and odometry.stamp_s <= before.stamp_s:
            self._refuse("odometry is not newer than before")
        else:
            self._odometry = odometry

    def hear_range(self, stamp_s: float, range_m: float, now_s: float) -> None:
        """Take the range of the altimeter, metres; one that is not finite is no echo."""
        odometry = self._fresh(now_s)
        if not math.isfinite(range_m):
            return
        if not -self.limits.ahead_s <= now_s - stamp_s <= self.limits.altitude_s:
            self._refuse("altitude is not of now")
            return
        if odometry is None:
            return
        turn = Rotation.from_quat(odometry.quaternion_xyzw)
        down = float(turn.apply([0.0, 0.0, 1.0])[2])
        if range_m <= 0.0 or down < math.cos(_MAX_TILT_RAD):
            self._refuse("altitude is not of the bottom")
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
            self._why = f"the clock jumped by {moved:.2f} s"
        elif moved > _LATE * TICK_S:
            self.late_ticks += 1
        self._last = self._command(now_s, TICK_S if jumped else min(moved, _MAX_STEP_S))
        return self._last

    def end(self, how: str) -> None:
        """End the mission from outside, in words."""
        if self.state != LinkState.OVER:
            self.state, self._ending = LinkState.OVER, how

    def _command(self, now_s: float, step_s: float) -> Command:
        odometry = self._fresh(now_s)
        if self.state == LinkState.OVER:
            return self._off(now_s)
        if self.state == LinkState.GIVEN_UP:
            return self._given_up(now_s, step_s, odometry)
        if odometry is None:
            if self.state == LinkState.WAITING:
                return self._off(now_s)
            self._stretch.clear()
            self.state = LinkState.HELD
            self._held_s += step_s
            if self._held_s > self.limits.grace_s:
                self.state = LinkState.GIVEN_UP
                return self._given_up(now_s, step_s, None)
            return self._off(now_s)
        self.state, self._why, self._held_s = LinkState.FLYING, "", 0.0
        self._flown_s += step_s
        self._estimate(odometry, now_s)
        self.pilot.steer(self._flown_s, step_s, self.estimate)
        report = self.pilot.state.report
        if report[slot.PHASE] == DONE or report[slot.AT_SURFACE] == 1.0:
            reason = int(report[slot.REASON])
            self.end("complete" if reason == NONE else f"aborted: {REASONS[reason]}")
            return self._off(now_s)
        self._judge(now_s)
        return self._make_command(now_s)

    def _given_up(self, now_s: float, step_s: float, odometry: Odometry | None) -> Command:
        self.estimate = np.full(vector.ESTIMATE, np.nan)
        if odometry is not None and odometry.position_ned[2] < self.pilot.guidance.surface_m:
            self.end(f"given up: {self._why}")
        if self.state == LinkState.OVER or self.limits.on_loss == "drift":
            return self._off(now_s)
        # Without an estimate the pilot pushes the vehicle up.
        self.pilot.steer(self._flown_s, step_s, self.estimate)
        return self._make_command(now_s)

    def _make_command(self, now_s: float) -> Command:
        pilot, demand = self.pilot, self.pilot.state.demand
        blind = self.state != LinkState.FLYING
        return Command(
            time_s=now_s,
            state=self.state,
            why=self._why,
            wrench=pilot.wrench.copy(),
            thrust_n=pilot.allocation.thrust.copy(),
            rps=pilot.allocation.command.copy(),
            velocity_body=np.zeros(3) if blind else demand[slot.REF_SURGE : slot.REF_YAW].copy(),
            heading_rad=math.nan if blind else float(pilot.state.report[slot.TARGET_HEADING]),
        )

    def _off(self, now_s: float) -> Command:
        """No thrust."""
        none = np.zeros(len(self.pilot.allocation.thrust))
        return Command(
            time_s=now_s, state=self.state, why=self._ending or self._why, wrench=np.zeros(6),
            thrust_n=none, rps=none.copy(), velocity_body=np.zeros(3), heading_rad=math.nan,
        )  # fmt: skip

    def _refuse(self, why: str) -> None:
        self.refused[why] += 1
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
