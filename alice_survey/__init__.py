"""Plan, fly, image, reconstruct and score close-range underwater imaging surveys."""
