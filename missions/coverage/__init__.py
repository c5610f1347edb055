"""What was or would be seen of an area: footprints, overlap, the certificate, holes."""
