"""What the public Python interface adds to the packages below it: see `alice_survey`."""
