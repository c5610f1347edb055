"""Survey planning and flight."""
