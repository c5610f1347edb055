"""What all of planning and flight share: areas, lines, legs, footprints, the plan's file."""
