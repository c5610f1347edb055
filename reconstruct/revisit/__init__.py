"""Weak places of a reconstructed survey, and a dive that cures them."""
