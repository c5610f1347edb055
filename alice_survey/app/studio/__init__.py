"""A server for this machine alone that shows a workspace: map, mesh and files, however large."""
