"""Spots picked in pictures: where they are seen, found again, and measured between."""
