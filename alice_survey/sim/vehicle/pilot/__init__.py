"""The pilot: path, guidance, inner loops, gains and safety."""
