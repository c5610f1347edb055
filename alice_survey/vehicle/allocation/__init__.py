"""Thrust allocation: which thrusters make a wrench.

Both take the matrix B (6, n) of `Vehicle.configuration_matrix`, the wrench wanted (6,), the
bounds of thrust (n,), the weights of axes (6,) and of thrusters (n,), and write the thrust (n,):

- `allocate_exact`: the least weighted miss within the bounds and, of all ways to it, the least
  weighted thrust (`exact`);
- `allocate_rpi`: the redistributed pseudo-inverse of the paper (`rpi`).

An axis of weight 0 is not requested: gravity handles roll and pitch. The others decide what
is given up when not all is attainable, by the square of their weights times the squared miss.
A failed thruster has the bounds 0 and 0. A wrench that is not a number gives NaN thrusts.
"""
