"""From an estimate to thruster speeds and fins: guidance, control, allocation, failures found."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import allocate, new_allocation
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.failures import (
    FoundFailure,
    NavigatedStretch,
    ThrusterWatch,
    ThrustWatch,
)
from alice_survey.sim.vehicle.pilot.gains import INNER, SWAY, Gains
from alice_survey.sim.vehicle.pilot.guidance import steer
from alice_survey.sim.vehicle.pilot.memory import PilotState, new_pilot
from alice_survey.sim.vehicle.pilot.mission import NO_MISSION, PilotMission
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.safety import THRUSTER_LOST
from alice_survey.sim.vehicle.pilot.settings import Guidance, Tick
from alice_survey.sim.vehicle.vehicle import Vehicle

Without = Callable[[Mapping[str, float]], tuple[Gains, Guidance]]
"""How to fly with what thrusters have left; a `VehicleError`: not at all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Piloting:
    """How a vehicle flies a plan, at sea or simulated."""

    vehicle: Vehicle
    """With all its thrusters."""
    path: Path
    gains: Gains
    guidance: Guidance
    mission: PilotMission = NO_MISSION
    """What is flown instead of the path, by the law of another vehicle's software."""
    exact_allocation: bool = True
    """Or by the redistributed pseudo-inverse."""
    believed: Vehicle | None = None
    """Vehicle that the allocation assumes, with as many thrusters; the vehicle itself if not
    given."""
    known_health: Mapping[str, float] | None = None
    """Share left of thrusters that are known not to be intact."""
    without: Without | None = None
    """How to go on once failures are found; not looked for if None."""


class Pilot:
    """A pilot on a path, who goes on without thrusters that are found to have failed."""

    def __init__(self, flies: Piloting, tick_s: float) -> None:
        """A pilot at the start of a mission.

        Args:
            flies: how.
            tick_s: time between ticks.

        Raises:
            VehicleError: a thruster that is named is not one of the vehicle's.
        """
        self._flies, self.gains, self.guidance = flies, flies.gains, flies.guidance
        self.state, self.wrench = new_pilot(), np.zeros(6)
        self.known, believed = dict(flies.known_health or {}), flies.believed or flies.vehicle
        self.allocation = new_allocation(
            believed,
            flies.vehicle.health_of(self.known),
            exact=flies.exact_allocation,
            axes=flies.gains.axis_weights,
        )
        self._sees = ThrusterWatch(flies.vehicle.thrusters, tick_s)
        # What fins do is not in its model of the forces.
        self._feels = None if flies.vehicle.fins else ThrustWatch(believed, tick_s)

    def tick(self, dt_s: float, estimate: Array) -> Tick:
        """A tick for compiled code, of an estimate of the navigation."""
        return Tick(dt_s, estimate, self._flies.path, self.guidance, self.gains, self.state)

    def steer(self, time_s: float, dt_s: float, estimate: Array) -> None:
        """Write the wrench and the allocation of a tick, for an estimate of the navigation."""
        steer(time_s, self.tick(dt_s, estimate), NO_MISSION, self.wrench)
        allocate(self.wrench, estimate[vector.U :], self.allocation)

    def judge(
        self,
        end_s: float,
        command_rps: Array,
        rps: Array,
        navigated: NavigatedStretch | None = None,
    ) -> list[FoundFailure]:
        """Look for failures in a stretch of `WATCHED_S`, and go on without what has failed.

        Args:
            end_s: time of its end.
            command_rps: (T, n) commanded speeds, tick by tick.
            rps: (T, n) speeds that were turned.
            navigated: motion, which shows what pushes nothing; speeds alone count without it.
        """
        if self._flies.without is None:
            return []
        found = self._sees.judge(end_s, command_rps, rps)
        if self._feels is not None and navigated is not None:
            for failure in found:
                self._feels.known_gone(failure.thruster)
            found += self._feels.judge(end_s, navigated, rps)
        for failure in found:
            self.known[failure.thruster] = min(failure.left, self.known.get(failure.thruster, 1.0))
        if found:
            self.allocation.health[:] = self._flies.vehicle.health_of(self.known)
            try:
                before, (self.gains, self.guidance) = self.gains, self._flies.without(self.known)
                _carry_over(self.state, before, self.gains)
            except VehicleError:
                report = self.state.report
                if report[slot.PHASE] != slot.ABORT:
                    report[slot.PHASE], report[slot.REASON] = slot.ABORT, THRUSTER_LOST
        return found


def _carry_over(pilot: PilotState, before: Gains, after: Gains) -> None:
    """Let the pilot's memory mean the same with other gains, in place.

    Integrals are kept as speeds, of which the inner loops make accelerations: what holds against
    the current goes on. That of yaw has learned of what the lost thruster left undone.
    """
    pilot.memory[slot.YAW_SUM] = 0.0
    inner = after.axes[SWAY, INNER]
    factor = before.axes[SWAY, INNER] / inner if inner > 0.0 else 0.0
    pilot.memory[[slot.SWAY_SUM_N, slot.SWAY_SUM_E]] *= factor
