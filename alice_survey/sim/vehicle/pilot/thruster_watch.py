"""Find thrusters that do not turn as commanded.

A propeller follows its command by a first-order lag, within its greatest speed and outside of its
dead band. One that turns much slower than that for long has failed, or is weak: a weak thruster
follows up to the speed that its share of the greatest thrust, as the square of the speed, leaves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.propulsion import Thruster, turned_speeds

WATCHED_S = 5.0
"""Thrusters are judged over stretches of this length."""
_STRETCHES = 2
"""So many in a row make a failure: a rope that is thrown off again in time is none."""
_MARGIN_RPS = 2.0
"""Speeds that differ by less are measured no better (inferred)."""
_SLOW = 0.7
"""A propeller that turns by less than this share of what it should is slow ..."""
_OFTEN = 0.8
"""... and failing where it is slow for this share of the time that it should turn."""
_MIN_S = 1.0
"""It must be asked to turn for at least this long in a stretch to be judged."""


@dataclass(frozen=True, kw_only=True)
class FoundFailure:
    """A thruster that was found not to do as commanded."""

    time_s: float
    thruster: str
    left: float
    """Share of its greatest thrust that it has left."""
    turns: bool = False
    """Whether it turns as commanded, and gives no thrust."""


class ThrusterWatch:
    """Compares commanded with turned speeds, stretch by stretch."""

    def __init__(self, thrusters: Sequence[Thruster], tick_s: float) -> None:
        self._thrusters, self._tick_s = thrusters, tick_s
        self._slow = np.zeros(len(thrusters), dtype=np.int64)
        self._maximum = np.array([thruster.most_rps for thruster in thrusters])
        self._gone = np.zeros(len(thrusters), dtype=np.bool_)

    def judge(self, end_s: float, command_rps: Array, rps: Array) -> list[FoundFailure]:
        """Failures that a stretch shows, each once.

        Args:
            end_s: time of its end.
            command_rps: (T, n) commanded speeds, tick by tick.
            rps: (T, n) speeds that were turned.
        """
        found = []
        time_s: Array = self._tick_s * np.arange(len(rps), dtype=np.float64)
        for i, thruster in enumerate(self._thrusters):
            if self._gone[i]:
                continue
            asked = turned_speeds(time_s, command_rps[:, i], thruster, float(rps[0, i]))
            turning = np.abs(asked) > thruster.dead_band_rps + _MARGIN_RPS
            if turning.sum() * self._tick_s < _MIN_S:
                continue
            turned = rps[:, i] * np.sign(asked)
            slow = turned[turning] < _SLOW * np.abs(asked[turning])
            self._slow[i] = self._slow[i] + 1 if slow.mean() > _OFTEN else 0
            if self._slow[i] == _STRETCHES:
                self._gone[i] = True
                maximum = float(np.abs(rps[:, i]).max())
                turns = maximum > thruster.dead_band_rps + _MARGIN_RPS
                left = (maximum / thruster.most_rps) ** 2 if turns else 0.0
                found.append(FoundFailure(time_s=end_s, thruster=thruster.name, left=left))
        return found
