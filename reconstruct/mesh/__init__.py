"""The textured mesh: `mesh/`."""
