"""What everything else stands on: errors, frames, settings, stages, files."""
