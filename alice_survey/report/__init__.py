"""One page of a survey, for the screen and for print: what was mapped, how well, what to do next."""
