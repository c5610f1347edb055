"""Follow a dive while it is flown: coverage, holes, time left, and lines that close the holes."""
