"""How a run reports: progress, events, interrupts, resources."""
