"""The part of a report that shows the planes other than the map's."""

from alice_survey.app.report.held import Held
from alice_survey.core.records import MosaicRecord, PlaneRecord
from alice_survey.kit.document import Figure, Section
from alice_survey.kit.figure import shrunk_png
from alice_survey.kit.words import length


def planes_section(held: Held) -> Section | None:
    """Mosaic, else surface, of every further plane; None where there is none."""
    figures = []
    for stage, what in (("mosaic", "mosaic"), ("dense", "dem")):
        for folder in sorted((held.workspace / stage / "planes").glob("*")):
            picture, about = folder / f"{what}.png", folder / "plane.json"
            painted = held.workspace / "mosaic" / "planes" / folder.name / "mosaic.png"
            if not held.has(stage) or not (picture.is_file() and about.is_file()):
                continue
            if what == "mosaic" or not painted.is_file():
                figures.append(_figure(held, PlaneRecord.read(about), folder.name, what))
    if not figures:
        return None
    return Section(
        name="planes",
        title="Planes",
        text=[
            "The same surface as someone sees it who faces each plane: what is up in a picture is "
            "up the plane. Rasters are in dense/planes/ and mosaic/planes/; plane.json beside them "
            "says where a pixel lies in space."
        ],
        figures=figures,
    )


def _figure(held: Held, plane: PlaneRecord, name: str, what: str) -> Figure:
    if what == "mosaic":
        folder = held.workspace / "mosaic" / "planes" / name
        found = MosaicRecord.read(folder / "mosaic.json")
        wide, high = found.width_px * found.pixel, found.height_px * found.pixel
        size = f", {length(wide, held.unit)} wide and {length(high, held.unit)} high"
        shows, otherwise = f"Mosaic of the plane: {plane.about}{size}.", ""
    else:
        folder = held.workspace / "dense" / "planes" / name
        shows = f"Surface over the plane: {plane.about}."
        otherwise = "Without a mosaic no picture looks at the plane."
    return Figure(
        png=shrunk_png(folder / f"{what}.png"),
        title=f"Plane {plane.name}",
        alt=shows,
        shows=shows,
        good="",
        otherwise=otherwise,
    )
