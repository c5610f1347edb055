"""Where to survey and where the vehicle may be: shapes, files, coordinate systems, bathymetry."""
