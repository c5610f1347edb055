"""Survey lines: their direction, the strips they cover, the cells they form, their order."""
