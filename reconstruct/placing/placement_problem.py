"""Normal equations and likelihood of a model's place under correlated errors of navigation."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from reconstruct.placing.correlated_errors import correlated_share, whiten
from reconstruct.placing.navigation_equations import GROUP_OF, PARAMETERS, NavigationEquations


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """How the errors of a group of channels are correlated in time."""

    tau: float
    """Correlation time of the varying part, in the unit of the epochs' time."""
    white: float
    """Share of the varying part's variance that is white."""
    constant: float = 0.0
    """Share of all variance that one constant error has."""
    factor: float = 1.0
    """Factor by which the stated sigmas are too small."""
    restart: float = 0.0
    """Constant error of each dive over what the constant share allows; 0: errors outlast gaps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Extra:
    """Independent further equations, made white: misfit + jacobian x change = N(0, 1)."""

    misfit: Array
    """(E,) misfits."""
    jacobian: Array
    """(E, P) their slopes."""


def no_extra(columns: int = PARAMETERS) -> Extra:
    """No further equations, in so many parameters."""
    return Extra(misfit=np.zeros(0), jacobian=np.zeros((0, columns)))


def frame_sigma(bound: float, time: Array, how: Correlation) -> float:
    """Sigma of a turn or stretch of navigation's own frame, from that of errors that last."""
    share = correlated_share(time, how.tau, how.white)
    share = how.constant + (1.0 - how.constant) * share
    return max(bound * how.factor * float(np.sqrt(share)), 1e-9)


class _Normal(NamedTuple):
    """Normal equations and likelihood of a group."""

    matrix: Array
    vector: Array
    square: float
    log_det: float
    rows: int

    def plus(self, other: "_Normal") -> "_Normal":
        return _Normal(
            self.matrix + other.matrix,
            self.vector + other.vector,
            self.square + other.square,
            self.log_det + other.log_det,
            self.rows + other.rows,
        )

    def solve(self) -> tuple[Array, Array]:
        """Parameters and their covariance."""
        size = np.sqrt(np.diag(self.matrix))
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv(self.matrix / np.outer(size, size), rcond=1e-14, hermitian=True)
        covariance = inverse / np.outer(size, size)
        return -covariance @ self.vector, covariance


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementProblem:
    """What a place is solved from, whatever the correlation of navigation's errors."""

    time: Array
    """(M,) times, not decreasing."""
    found: NavigationEquations
    free: NDArray[np.int64]
    """Parameters to solve for."""
    extra: Extra
    frame_bounds: Mapping[int, float]
    """Sigmas of nuisances of navigation's own frame if its position errors lasted throughout."""
    widened: Mapping[str, float]
    """Groups whose stated sigmas are too small by this factor or more."""
    dives: NDArray[np.int64]
    """(M,) number of the dive of each time."""
    cache: dict[Any, _Normal] = field(default_factory=dict)

    def group(self, group: str, used: NDArray[np.bool_], correlation: Correlation) -> _Normal:
        """Normal equations of one group.

        Constant errors of variance 1 with columns C add `C C'` to the covariance matrix: its
        inverse is that of the varying part minus a product (Woodbury 1950).
        """
        key = group, used.tobytes(), replace(correlation, factor=1.0)
        if key not in self.cache:
            self.cache[key] = self._unscaled(group, used, correlation)
        found, square = self.cache[key], correlation.factor**2
        return _Normal(
            matrix=found.matrix / square,
            vector=found.vector / square,
            square=found.square / square,
            log_det=found.log_det + found.rows * float(np.log(square)),
            rows=found.rows,
        )

    def _unscaled(self, group: str, used: NDArray[np.bool_], correlation: Correlation) -> _Normal:
        size = len(self.free)
        total = _Normal(
            matrix=np.zeros((size, size)), vector=np.zeros(size), square=0.0, log_det=0.0, rows=0
        )
        for channel in channels_of(group):
            rows = used[:, channel]
            if not rows.any():
                continue
            product, log_det, count = self._products(channel, rows, correlation)
            matrix, steady = product[: size + 1, : size + 1], product[: size + 1, size + 1 :]
            inner = np.eye(steady.shape[1]) + product[size + 1 :, size + 1 :]
            kept = matrix - steady @ np.linalg.solve(inner, steady.T)
            total = total.plus(
                _Normal(
                    matrix=kept[:-1, :-1],
                    vector=kept[:-1, -1],
                    square=float(kept[-1, -1]),
                    log_det=log_det + float(np.linalg.slogdet(inner)[1]),
                    rows=count,
                )
            )
        return total

    def _products(
        self, channel: int, rows: NDArray[np.bool_], correlation: Correlation
    ) -> tuple[Array, float, int]:
        """Products of all white columns, the last those of constant errors; log det; readings."""
        varying, constants = self.shares(channel, rows, correlation)
        misfit = self.found.misfit[:, channel]
        columns = np.column_stack([self.found.jacobian[:, channel][:, self.free], misfit])
        even, log_det = self.whitened(
            channel, rows, correlation, varying, np.column_stack([columns, constants])
        )
        return even.T @ even, log_det + 2.0 * float(np.log(varying[rows]).sum()), int(rows.sum())

    def whitened(
        self,
        channel: int,
        rows: NDArray[np.bool_],
        how: Correlation,
        varying: Array,
        columns: Array,
    ) -> tuple[Array, float]:
        """Columns (M, C) over the stated sigma, made white; log det of what is used."""
        columns = np.where(rows[:, None], columns / varying[:, None], 0.0)
        sigma = varying * self.found.sigma[:, channel]
        return whiten(self.times(how), sigma, rows, columns, how.tau, how.white)

    def times(self, how: Correlation) -> Array:
        """(M,) times; dives where errors restart are too far apart for any correlation."""
        if not how.restart:
            return self.time
        apart = 100.0 * how.tau + float(np.ptp(self.time))
        return self.time + apart * self.dives

    def shares(
        self, channel: int, rows: NDArray[np.bool_], correlation: Correlation
    ) -> tuple[Array, Array]:
        """Sigmas of the varying (M,) and the constant parts (M, D) over the stated one.

        The constant part is as large as the least of the stated sigmas allows.
        """
        sigma = self.found.sigma[:, channel]
        constant = np.sqrt(correlation.constant) * sigma[rows].min() / sigma
        constant = np.minimum(constant, np.sqrt(correlation.constant))
        own = np.ones((len(sigma), 1))
        if correlation.restart:
            own = correlation.restart * np.eye(self.dives[-1] + 1)[self.dives]
        return np.sqrt(1.0 - constant**2), constant[:, None] * own

    def rest(self, correlation: Mapping[str, Correlation]) -> _Normal:
        """Normal equations of what is not navigation, and of the turn of navigation's frame."""
        jacobian, misfit = self.extra.jacobian[:, self.free], self.extra.misfit
        matrix, vector = jacobian.T @ jacobian, jacobian.T @ misfit
        if "horizontal" in correlation:
            how = correlation["horizontal"]
            for parameter, bound in self.frame_bounds.items():
                at = np.flatnonzero(self.free == parameter)
                matrix[at, at] += frame_sigma(bound, self.time, how) ** -2
        return _Normal(
            matrix=matrix, vector=vector, square=float(misfit @ misfit), log_det=0.0, rows=0
        )

    def total(self, used: NDArray[np.bool_], correlation: Mapping[str, Correlation]) -> _Normal:
        """Normal equations of all."""
        total = self.rest(correlation)
        for group, how in correlation.items():
            total = total.plus(self.group(group, used, how))
        return total


def channels_of(group: str) -> list[int]:
    """Numbers of a group's channels among the six."""
    return [k for k, name in enumerate(GROUP_OF) if name == group]
