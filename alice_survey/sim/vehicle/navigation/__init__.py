"""Navigation: instruments, and the filter that weighs them."""
