"""Constants of robust statistics."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""
CAUCHY_TUNING = 2.385
"""Scale of Cauchy's weights in sigmas, for 95 % efficiency where errors are normal (Rey 1983,
"Introduction to robust and quasi-robust statistical methods")."""
