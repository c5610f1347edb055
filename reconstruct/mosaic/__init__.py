"""The orthomosaic: `mosaic/`, the surface painted by the pictures that see it best."""
