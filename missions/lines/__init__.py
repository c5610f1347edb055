"""Survey lines: their direction, the strips they look after, the cells they form, their order."""
