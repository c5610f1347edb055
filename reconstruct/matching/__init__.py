"""Features of pictures, the pairs worth matching, and the matches that one geometry explains."""
