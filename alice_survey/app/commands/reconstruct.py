"""The commands that turn pictures into a model, measure in it, and score it."""

from pathlib import Path
from typing import Literal

import typer

from alice_survey.app.commands.base import (
    DeviceCommand,
    ReportCommand,
    Result,
    SurveyCommand,
    ThreadsCommand,
    WorkspaceCommand,
    option,
)
from alice_survey.core.errors import ConfigError


class ReconstructCommand(DeviceCommand):
    """Turn pictures into a model.

    Camera track, DEM, point cloud, orthomosaic and textured mesh.
    """

    name = "reconstruct"
    examples = (
        "reconstruct -w reef",
        "reconstruct -w reef --threads 2 --json",
        "reconstruct -w reef --scheduler tcp://10.0.0.1:8786",
        "reconstruct -w quay --plane level --plane 'wall=facing 180'",
        "reconstruct -w reef --export undistorted",
        "reconstruct -w reef --crs EPSG:32636",
    )
    title = "Reconstruct the sea floor"
    offered = ("plane", "crs", "export", "threads")
    plane: list[str] | None = option(
        None, "Plane of DEM and mosaic, any number: level, auto (the best one), or 'NAME=facing "
        "DEGREES tilt DEGREES': where the surface faces, and its lean back.",
    )  # fmt: skip
    export: Literal["undistorted"] | None = option(
        None, "Then write for other programs: pictures without refraction and distortion, with "
        "the COLMAP model and nerfstudio's transforms.json.",
    )  # fmt: skip
    crs: str | None = option(
        None, "Then write rasters, cloud, mesh and track in this projected system too.",
        metavar="EPSG:N",
    )  # fmt: skip

    @classmethod
    def stages(cls) -> list[str]:
        """The model's, and the calibration before them."""
        from alice_survey.app.stages import names

        return names("calibrate", "reconstruct")

    def run(self) -> Result:
        """Run the stages, then write for other programs."""
        from alice_survey.app.pipeline import run

        with self.started_executor(self.device) as executor:
            text, values = run(
                self.stages(), self.workspace, self.survey, None, executor, planes=self.plane
            )
            if self.export is not None:
                from reconstruct.export.undistorted import export_undistorted

                more, values[self.export] = export_undistorted(self.workspace, executor)
                text = f"{text}\n{more}"
        if self.crs is not None:
            from reconstruct.export.projected import export_projected

            more, values["crs"] = export_projected(self.workspace, self.crs)
            text = f"{text}\n{more}"
        return text, values


class MeasureCommand(WorkspaceCommand, ReportCommand):
    """Measure between picked pixels, or within polygons.

    The distance of two points with its sigma; of more, their path and the area they enclose. Of
    polygons the area in plan and of the surface, the rugosity, and what each label covers.
    """

    name = "measure"
    examples = (
        "measure reef --points 'left/000012.png:301,255 left/000012.png:640,270' --json",
        "measure reef --polygons colonies.gpkg --label species -o colonies.csv",
    )
    points: str | None = option(
        None, "Two or more pixels: 'IMAGE:x,y', or 'IMAGE:x,y=IMAGE:x,y' where two pictures show "
        "the point.",
    )  # fmt: skip
    polygons: Path | None = option(
        None, "Measure the polygons of a file: GeoJSON, GeoPackage, shapefile or KML.",
        metavar="FILE",
    )  # fmt: skip
    label: str | None = option(
        None, "Attribute that holds the label of each polygon.", metavar="NAME"
    )
    output: Path | None = option(
        None, "Write polygons and figures: .csv or .geojson.", "-o", "--output", metavar="FILE"
    )
    pick_sigma: float = option(0.0, "Sigma of a picked pixel, or of a polygon's corner, px.", ge=0)

    def run(self) -> Result:
        """Measure either."""
        if (self.points is None) == (self.polygons is None):
            raise ConfigError("measure takes either --points or --polygons")
        if self.polygons is not None:
            from reconstruct.measure.polygon_files import measure_polygon_file

            return measure_polygon_file(
                self.workspace, self.polygons, label=self.label, pick_sigma_px=self.pick_sigma,
                output=self.output,
            )  # fmt: skip
        from reconstruct.picking.measure import measure

        return measure(self.workspace, self.points or "", pick_sigma_px=self.pick_sigma)


class ControlCommand(WorkspaceCommand, ThreadsCommand, ReportCommand):
    """Find coded markers and prepare the picking of control points, or scale by a known length.

    Known points, bars and markers stand in WORKSPACE/control.csv; the next 'reconstruct' places
    and scales the model by those for control, and scores those for check. One length between two
    points of the model, given by --points and --length, scales a model without control.
    """

    name = "control"
    examples = (
        "control -w reef",
        "control -w reef --dictionary DICT_5X5_250",
        "control -w reef --points 'left/001.png:512,300 left/001.png:930,312' --length 0.5",
    )
    title = "Find coded markers, or scale a model"
    offered = ("dictionary", "points", "length", "threads")
    dictionary: str | None = option(
        None, "Dictionary of the coded markers; without it all are tried (slow).", metavar="NAME"
    )
    points: str | None = option(
        None, "Two points of a known distance, each as IMAGE:x,y or, in two pictures, as "
        "IMAGE:x,y=IMAGE:x,y.",
        metavar="POINTS",
    )  # fmt: skip
    length: float | None = option(
        None, "Distance between the two points of --points.", metavar="METRES", ge=1e-6
    )

    def run(self) -> Result:
        """Do either."""
        from reconstruct.picking.measure import scale_model
        from reconstruct.placing.control_command import survey_control

        if self.points is None and self.length is None:
            return survey_control(
                self.workspace, dictionary=self.dictionary, executor=self.executor()
            )
        if self.points is None or self.length is None:
            raise typer.BadParameter("--points and --length go together: give both, or neither")
        text = scale_model(self.workspace, self.points, self.length)
        return text, {"text": text}


class QualityCommand(WorkspaceCommand, ThreadsCommand, ReportCommand):
    """Judge the pictures.

    Sharpness, exposure, turbidity and overlap of each; the bad ones by name, with the reason.
    """

    name = "quality"
    examples = ("quality -w reef", "quality -w reef --json")
    title = "Judge the pictures"
    offered = ("threads",)

    def run(self) -> Result:
        """Read them all."""
        from reconstruct.pictures.quality import quality_report

        return quality_report(self.workspace, self.executor())


class EvaluateCommand(SurveyCommand, ThreadsCommand):
    """Score a survey.

    A simulated one against its truth: camera track, surface, mosaic, mesh. A real one against
    a reference, or against an earlier survey: what has changed, with its significance and volume.
    """

    name = "evaluate"
    examples = (
        "evaluate -w reef",
        "evaluate -w reef --reference laser.laz",
        "evaluate -w reef --against last_year --json",
    )
    title = "Score the survey"
    offered = ("reference", "against", "threads")
    reference: Path | None = option(
        None, "A cloud (LAZ, LAS, PLY) or DEM (GeoTIFF) instead.", metavar="FILE"
    )
    free_scale: bool | None = option(
        None, "Fit the scale to the reference too.", "--free-scale/--hold-scale"
    )
    against: Path | None = option(
        None, "Workspace of an earlier survey of the site.", metavar="DIR"
    )
    output: Path | None = option(
        None, "Directory to write the comparison to.", "-o", "--output", metavar="DIR"
    )

    def run(self) -> Result:
        """Compare it with the one or the other."""
        if self.reference is not None:
            from reconstruct.evaluate.reference import evaluate_reference

            return evaluate_reference(
                self.workspace, self.reference, free_scale=self.free_scale, out=self.output
            )
        if self.against is not None:
            from reconstruct.evaluate.change import evaluate_against

            return evaluate_against(self.workspace, self.against, self.output)
        from alice_survey.app.pipeline import run

        return run(["evaluate"], self.workspace, self.survey, None, self.executor())


class MosaicTilesCommand(WorkspaceCommand, ReportCommand):
    """Cut the mosaic for annotation tools.

    Tiles that TagLab, BIIGLE and others take, each with a world file; tiles.csv lists their scale.
    """

    name = "mosaic-tiles"
    examples = (
        "mosaic-tiles -w reef -o tiles",
        "mosaic-tiles -w reef -o tiles --side 32767 --kind tif",
    )
    output: Path = option(..., "Folder to write.", "-o", "--output", metavar="DIR")
    side: int = option(8192, "Side of a tile, px.", ge=256, le=32_767)
    overlap: int = option(0, "Overlap of neighbours, px.", ge=0)
    kind: Literal["png", "jpg", "tif"] = option("png", "Format.")
    scale_bar: bool = option(False, "Draw one into every tile.")

    def run(self) -> Result:
        """Cut it."""
        from reconstruct.mosaic.annotation import mosaic_tiles

        return mosaic_tiles(
            self.workspace, self.output, side_px=self.side, overlap_px=self.overlap,
            kind=self.kind, scale_bar=self.scale_bar,
        )  # fmt: skip
