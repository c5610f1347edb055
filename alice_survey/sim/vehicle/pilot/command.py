"""From an estimate to thruster speeds and fins: guidance, control, allocation, failures found."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import (
    AllocationScratch,
    allocate_exact,
    allocate_rpi,
    allocation_scratch,
    preference_weights,
)
from alice_survey.sim.vehicle.fins import MAX_RAD, Fins, write_fin_matrix
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
from alice_survey.sim.vehicle.pilot.mission import NO_MISSION
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.safety import THRUSTER_LOST
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.propulsion import Propulsion, speeds_for, thrust_limits
from alice_survey.sim.vehicle.vehicle import Vehicle

Without = Callable[[Mapping[str, float]], tuple[Gains, Guidance]]
"""How to fly with what thrusters have left; a `VehicleError`: not at all."""


class Allocation(NamedTuple):
    """Settings of the allocation from wrench to n thrusts and m angles of fins."""

    exact: bool
    propulsion: Propulsion
    """Propulsion as the allocation assumes it."""
    fins: Fins
    matrix: Array
    """B, (6, n + m): of the thrusters; and of the fins, per angle, at the speed of the tick."""
    axes: Array
    """(6,) weight of each axis; 0 of one that is not requested."""
    health: Array
    """(n,) 1 of an intact thruster, 0 of a failed one, see `weakened`."""
    lower: Array
    upper: Array
    """(n + m,) N, and rad."""
    weights: Array
    thrust: Array
    """(n + m,) thrusts, and angles of fins."""
    command: Array
    """(n + m,) speeds, and angles of fins."""
    known: Array
    """(6,) velocity that thrusters are believed to meet."""
    scratch: AllocationScratch


def new_allocation(vehicle: Vehicle, health: Array, *, exact: bool, axes: Array) -> Allocation:
    """An allocation to the thrusters and fins of a vehicle.

    Args:
        vehicle: as the allocation assumes it.
        health: (n,) share of its greatest thrust that each thruster has left.
        exact: by `allocate_exact`; else by `allocate_rpi`.
        axes: (6,) weight of each axis.
    """
    n, thrusters, fins = vehicle.actuators, len(vehicle.thrusters), vehicle.plant.fins
    matrix, upper = np.zeros((6, n)), np.zeros(n)
    matrix[:, :thrusters] = vehicle.configuration_matrix
    upper[thrusters:] = fins.drives[:, MAX_RAD]
    return Allocation(
        exact, vehicle.plant.propulsion, fins, matrix, axes.copy(), health,
        lower=-upper, upper=upper, weights=np.ones(n), thrust=np.zeros(n),
        command=np.zeros(n), known=np.zeros(6), scratch=allocation_scratch(n),
    )  # fmt: skip


@kernel
def allocate(wrench: Array, estimate: Array, allocation: Allocation) -> None:
    """Write the thrusts and the thruster speeds, and angles of fins, that make a wrench.

    Args:
        wrench: (6,) requested, N and N m.
        estimate: of the navigation: its velocity counts; rest where it is not a number.
        allocation: is written.
    """
    # The flow past the hull is not measured: the velocity over ground stands for it.
    known = allocation.known
    for i in range(6):
        speed = estimate[vector.U + i]
        known[i] = speed if math.isfinite(speed) else 0.0
    lower, upper = allocation.lower, allocation.upper
    thrust_limits(allocation.propulsion, allocation.health, known, lower, upper)
    preference_weights(allocation.propulsion, known[0], allocation.weights)
    thrusters = allocation.propulsion.table.shape[0]
    write_fin_matrix(allocation.fins, known, allocation.matrix, thrusters)
    if allocation.exact:
        allocate_exact(
            allocation.matrix, wrench, lower, upper,
            allocation.axes, allocation.weights, allocation.thrust, allocation.scratch,
        )  # fmt: skip
    else:
        allocate_rpi(
            allocation.matrix, wrench, lower, upper,
            allocation.axes, allocation.weights, allocation.thrust, allocation.scratch,
        )  # fmt: skip
    speeds_for(allocation.propulsion, allocation.thrust, known, allocation.command)
    for i in range(thrusters, allocation.thrust.shape[0]):
        allocation.command[i] = allocation.thrust[i]


class Pilot:
    """A pilot on a path, who goes on without thrusters that are found to have failed."""

    def __init__(
        self,
        vehicle: Vehicle,
        path: Path,
        gains: Gains,
        guidance: Guidance,
        *,
        exact_allocation: bool = True,
        believed: Vehicle | None = None,
        known_health: Mapping[str, float] | None = None,
        without: Without | None = None,
        tick_s: float,
    ) -> None:
        """A pilot at the start of a mission.

        Args:
            vehicle: with all its thrusters.
            path: to follow.
            gains: of the inner loops.
            guidance: settings.
            exact_allocation: or by the redistributed pseudo-inverse.
            believed: vehicle that the allocation assumes; `vehicle` if not given.
            known_health: what it knows to be left of thrusters.
            without: how to go on once failures are found; not looked for if None.
            tick_s: time between ticks.

        Raises:
            VehicleError: a thruster that is named is not one of the vehicle's.
        """
        self.path, self.gains, self.guidance = path, gains, guidance
        self.state, self.wrench = new_pilot(), np.zeros(6)
        self.known = dict(known_health or {})
        self.allocation = new_allocation(
            believed or vehicle,
            vehicle.health_of(self.known),
            exact=exact_allocation,
            axes=gains.axis_weights,
        )
        self._vehicle, self._without = vehicle, without
        self._sees = ThrusterWatch(vehicle.thrusters, tick_s)
        # What fins do is not in its model of the forces.
        self._feels = None if vehicle.fins else ThrustWatch(believed or vehicle, tick_s)

    def steer(self, time_s: float, dt_s: float, estimate: Array) -> None:
        """Write the wrench and the allocation of a tick, for an estimate of the navigation."""
        steer(
            time_s, dt_s, estimate, self.path, NO_MISSION, self.guidance, self.gains, self.state,
            self.wrench,
        )  # fmt: skip
        allocate(self.wrench, estimate, self.allocation)

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
        if self._without is None:
            return []
        found = self._sees.judge(end_s, command_rps, rps)
        if self._feels is not None and navigated is not None:
            for failure in found:
                self._feels.known_gone(failure.thruster)
            found += self._feels.judge(end_s, navigated, rps)
        for failure in found:
            self.known[failure.thruster] = min(failure.left, self.known.get(failure.thruster, 1.0))
        if found:
            self.allocation.health[:] = self._vehicle.health_of(self.known)
            try:
                before, (self.gains, self.guidance) = self.gains, self._without(self.known)
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
