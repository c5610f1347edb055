"""One kit for all reports: values, words, figure style, HTML page, map and PDF."""
