"""Pictures on their way in: read, imported, judged, evened out, taken through their lens."""
