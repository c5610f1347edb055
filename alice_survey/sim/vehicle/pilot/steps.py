"""Columns of the steps of a mission, which compiled code takes as rows of an array."""

(
    KIND, START_N, START_E, END_N, END_E, HEADING, BY_DEPTH, BY_ALTITUDE, DEPTH, ALTITUDE, SPEED,
    TOLERANCE, HOLD_S, LINE,
) = range(14)  # fmt: skip
"""Kind of manoeuvre; where a section starts and where the step ends, m north and east; heading to
hold, rad, NaN where it follows from the way; 1 where heave may be by depth, by altitude (by both:
altitude as soon as there is one); target depth of the origin, m; target altitude of the point
whose altitude the navigation gives, m; speed, m/s; how near to its end it is done, m; how long to
stay there, s; the survey line on which pictures are taken meanwhile, or -1."""
COLUMNS = 14

GOTO, SECTION, KEEP, ANCHOR, FROM_END = 0, 1, 2, 3, 4
"""Kinds: from where the vehicle is; along a straight from its start; hold a place and a heading;
stay about a place, facing it; along the straight from where the step before ends."""
