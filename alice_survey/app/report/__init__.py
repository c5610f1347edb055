"""One page of a survey, for screen and print: what was mapped, how well, what to do next."""
