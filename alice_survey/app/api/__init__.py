"""The additions of the public Python interface to the packages below it: see `alice_survey`."""
