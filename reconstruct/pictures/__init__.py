"""Pictures before matching: read, imported, assessed, evened out, undistorted."""
