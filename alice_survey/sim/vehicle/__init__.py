"""The vehicle: a model of ALICE and SPARUS II, their propulsion, control and navigation."""
