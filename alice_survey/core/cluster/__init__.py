"""Tasks on a Dask cluster: many machines that share one file system."""
