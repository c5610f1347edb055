"""One module for each format of export: its file name is the format's, `-` written as `_`.

A module holds `FORMAT`, an `ExportFormat`; the command, its help, `about.txt` and the table of the
documentation find it here.
"""
