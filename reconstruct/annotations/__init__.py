"""What people mark on a mosaic or in pictures: colonies, animals, damages, by label."""
