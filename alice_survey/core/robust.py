"""Constants of robust statistics."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""
RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a plane vector whose components are normal with unit sigma, sqrt(2 ln 2)."""
CAUCHY_TUNING = 2.385
"""Scale of Cauchy's weights in sigmas, for 95 % efficiency where errors are normal (Rey 1983,
"Introduction to robust and quasi-robust statistical methods")."""
