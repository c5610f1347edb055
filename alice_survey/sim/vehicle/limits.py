"""Limits of turns on the spot and sway steps: shared by planner, exports and pilot."""

import math

SPOT_RAD_S = math.radians(15.0)
"""Rate of a turn on the spot: half of the fastest that gains.py lets a vehicle ask for (inferred).
"""
STEP_MPS = 0.15
"""Speed of a sway step (inferred: what ALICE swayed at in the paper's turns, section VI)."""


def spot_rate_rad_s(turn_rate_limit_deg_s: float) -> float:
    """Rate of turns on the spot under a survey's limit; a vehicle that can do less turns slower.

    Args:
        turn_rate_limit_deg_s: the setting `plan.turn_rate_limit_deg_s`.
    """
    return min(SPOT_RAD_S, math.radians(turn_rate_limit_deg_s))
