"""Maps of a plan: a picture, and a page that works without a network."""
