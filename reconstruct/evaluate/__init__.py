"""Scores: against the truth, a reference, another model or an earlier survey."""
