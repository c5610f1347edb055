"""How navigation of a planned survey is expected to err."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from alice_survey.base.config import NavigationConfig
from alice_survey.vehicle.navigation.sensors import CompassSpec, PressureSpec
from reconstruct.placing.correlated_errors import LEAST_WHITE
from reconstruct.placing.generalised_fit import Correlation

# Of ten simulated flights of Caesarea, log minus truth at the stations: rms of the mean and of the
# differences over 4 s to 1500 s.
_DEPTH_SLOW_M, _DEPTH_SLOW_S, _DEPTH_WHITE_M = 0.011, 190.0, 0.0015
_LEVEL_SLOW_M, _LEVEL_SLOW_S, _LEVEL_WHITE_M = 0.05, 60.0, 0.002
_TILT_DEG, _TILT_WHITE_DEG = 0.008, 0.0135
_HEADING_WHITE_DEG = 0.025
_TURN_SHARE = 1.0
"""Positions between fixes turn with the heading."""
_STRETCH = 0.002


@dataclass(frozen=True, kw_only=True)
class ChannelErrors:
    """Sigmas of three independent errors of a channel, metres or radians."""

    constant: float
    slow: float
    slow_s: float
    """Correlation time of the slow one."""
    white: float

    @property
    def sigma(self) -> float:
        """Of their sum."""
        return math.hypot(self.constant, self.slow, self.white)

    @property
    def correlation(self) -> Correlation:
        """The same as the placing has it."""
        varying = math.hypot(self.slow, self.white)
        return Correlation(
            tau=self.slow_s,
            white=max((self.white / varying) ** 2, LEAST_WHITE),
            constant=(self.constant / self.sigma) ** 2,
        )

    def times(self, factor: float) -> "ChannelErrors":
        """All of it so many times as large."""
        return ChannelErrors(
            constant=factor * self.constant, slow=factor * self.slow, slow_s=self.slow_s,
            white=factor * self.white,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NavigationErrors:
    """Errors by group of channels (see `navigation_equations.GROUPS`)."""

    channels: Mapping[str, ChannelErrors]
    turn_rad: float
    """Of the frame of horizontal positions."""
    stretch: float

    @classmethod
    def of(cls, settings: NavigationConfig) -> "NavigationErrors":
        """Of the survey's instruments, as the filter of the simulated vehicle leaves them."""
        pressure, compass = PressureSpec(), CompassSpec()
        bias_rad = math.radians(settings.compass_bias_deg)
        return cls(
            channels={
                "horizontal": ChannelErrors(
                    constant=max(settings.gps_bias_m, 1e-3), slow=_LEVEL_SLOW_M,
                    slow_s=_LEVEL_SLOW_S, white=_LEVEL_WHITE_M,
                ),
                "depth": ChannelErrors(
                    constant=pressure.bias_sigma_m, slow=_DEPTH_SLOW_M, slow_s=_DEPTH_SLOW_S,
                    white=_DEPTH_WHITE_M,
                ),
                "tilt": ChannelErrors(
                    constant=math.radians(_TILT_DEG), slow=0.0, slow_s=1.0,
                    white=math.radians(_TILT_WHITE_DEG),
                ),
                "heading": ChannelErrors(
                    constant=0.0, slow=max(bias_rad, 1e-6), slow_s=compass.bias_correlation_s,
                    white=math.radians(_HEADING_WHITE_DEG),
                ),
            },
            turn_rad=_TURN_SHARE * max(bias_rad, 1e-6),
            stretch=_STRETCH,
        )  # fmt: skip

    def times(self, factor: float) -> "NavigationErrors":
        """All of it so many times as large."""
        return NavigationErrors(
            channels={name: errors.times(factor) for name, errors in self.channels.items()},
            turn_rad=factor * self.turn_rad,
            stretch=factor * self.stretch,
        )
