"""Thrust allocation: which thrusters make a wrench.

Both take the matrix B (6, n) of `Vehicle.configuration_matrix`, the wrench wanted (6,), the
bounds of thrust (n,), the weights of axes (6,) and of thrusters (n,), and write the thrust (n,):

- `allocate_exact`: the least weighted miss within the bounds and, of all ways to it, the least
  weighted thrust (`exact`);
- `allocate_rpi`: the redistributed pseudo-inverse of the paper (`rpi`).

An axis of weight 0 is not asked for: of roll and pitch gravity takes care. The others decide what
is given up when not all can be had, by the square of their weights times the square of the miss.
A failed thruster has the bounds 0 and 0. A wrench that is not a number gives thrusts that are none.
"""
