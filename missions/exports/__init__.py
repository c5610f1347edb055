"""Plans in the files that vehicles and planners load."""
