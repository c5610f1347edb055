"""Camera calibrations in the files of other tools, in and out.

`convert` does the work; each format has a module that reads a file to a `Rig` and writes one.
"""
