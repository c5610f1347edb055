"""Figures of a survey, each as a matplotlib `Figure`."""
