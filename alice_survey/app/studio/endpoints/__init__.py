"""What the tabs of the studio ask the server for: one module each, found by its `endpoints`."""
