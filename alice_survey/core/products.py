"""The rasters that a workspace may hold: what each is, said once for all who write or show them.

Writers take file, type and band from here, maps title, palette and limits, exports the resampling,
the documentation the table. A new raster is an entry here, and the code that computes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Literal

LENGTH = "length"
"""A unit: that of the model's lengths."""


@dataclass(frozen=True, kw_only=True)
class Raster:
    """A raster of a workspace."""

    file: str
    """Path from the workspace."""
    title: str
    about: str
    """What it shows, for the reader of a map."""
    band: str = ""
    """Description of its band; `{over}` is what heights are above, `{unit}` the unit of lengths."""
    unit: str = ""
    """Of its values; none of counts and colours."""
    dtype: str = "float32"
    """Of its values; NaN marks unknown ones of floats, which are resampled bilinearly."""
    palette: str = ""
    """Of matplotlib, safe for the colour-blind; none of a raster that is no layer of a map."""
    limits: Literal["middle", "from zero", "around zero", "counts"] = "middle"
    """Of the palette, from the values; zero means unseen of counts."""
    small: bool = False
    """Shown in thousandths of the unit."""
    shaded: bool = False
    listed: str = ""
    """What lists of products call it; none of one that they leave out."""

    @property
    def path(self) -> PurePath:
        """Path from the workspace."""
        return PurePath(self.file)

    @property
    def name(self) -> str:
        """Name of its file without the ending."""
        return self.path.stem

    def shown_unit(self, length: str) -> tuple[float, str]:
        """Factor from its values to those that people read, and their unit.

        Args:
            length: unit of the model's lengths.
        """
        if self.unit != LENGTH:
            return 1.0, self.unit
        return (1e3, "mm") if self.small and length == "m" else (1.0, length)


DEM = Raster(
    file="dense/dem.tif", title="Height", unit=LENGTH, band="height {over}",
    about="Height of the surface, shaded from the upper left.", palette="viridis", shaded=True,
    listed="elevation model (GeoTIFF)",
)  # fmt: skip
SIGMA = Raster(
    file="dense/sigma.tif", title="Sigma of height", unit=LENGTH, small=True,
    band="standard deviation of the height ({unit})", palette="cividis", limits="from zero",
    about="How far off a height may be within the survey, one sigma.",
    listed="sigma of its heights",
)  # fmt: skip
ERROR = Raster(
    file="evaluation/error.tif", title="Error of height", unit=LENGTH, small=True,
    band="height minus true height (m)", palette="PuOr", limits="around zero",
    about="Height minus the true height, after a rigid alignment of the cameras.",
)  # fmt: skip
STATIONS = Raster(
    file="dense/stations.tif", title="Stations", dtype="uint8", palette="cividis", limits="counts",
    band="stations that the height rests on (255: or more); 0 where a small gap was bridged",
    about="Stations that see a spot: from 3 on, heights check one another.",
)  # fmt: skip
MOSAIC = Raster(
    file="mosaic/mosaic.tif", title="Mosaic", unit="red, green, blue", dtype="uint8",
    about="What the cameras saw, each spot from the picture that sees it best; where no depth is "
    "known, on a surface that is interpolated (third band of coverage.tif).",
    listed="orthomosaic (cloud-optimised GeoTIFF)",
)  # fmt: skip
RASTERS = (
    DEM,
    SIGMA,
    ERROR,
    Raster(
        file="dense/slope.tif", title="Slope", unit="degrees", band="steepest slope (degrees)",
        about="Steepness of the surface.", palette="magma", limits="from zero",
    ),
    STATIONS,
    Raster(
        file="dense/count.tif", title="Views", dtype="uint16",
        band="views that the height rests on; 0 where a small gap was bridged",
        about="Views that a height rests on; 0 with a height marks a gap of at most 3 cells that "
        "was bridged.",
    ),
    Raster(
        file="dense/surfaces.tif", title="Surfaces", dtype="uint8",
        band="surfaces over each other, of which the height is the uppermost's; 0 where a small "
        "gap was bridged",
        about="Surfaces over each other in a cell, such as an overhang above the floor; 0 where "
        "nothing is known or a gap was bridged.",
    ),
    Raster(
        file="dense/lower.tif", title="Lowest surface", unit=LENGTH,
        band="height of the lowest of several surfaces {over}; unknown where there is one",
        about="Height of the lowest surface where there are several.",
    ),
    Raster(
        file="mosaic/coverage.tif", title="Pictures", dtype="uint16",
        about="Pictures that see a cell; a second band counts stations, a third has the sigma of "
        "places where the surface is interpolated between its rims.",
    ),
    MOSAIC,
)  # fmt: skip
"""In the order in which a map lists them."""


def rasters_in(folder: str) -> tuple[Raster, ...]:
    """The rasters of a stage's folder."""
    return tuple(one for one in RASTERS if one.path.parent.name == folder)


def listed_in(folder: str) -> Mapping[str, str]:
    """The rasters that lists of a stage's products name, by the names of their files."""
    return {one.path.name: one.listed for one in rasters_in(folder) if one.listed}
