"""From a plan to a track."""
