"""From pictures to a measured sea floor."""
