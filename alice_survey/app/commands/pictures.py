"""Commands that bring in pictures and logs, and turn them into a model."""

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
    argument,
    option,
)
from alice_survey.core.errors import ConfigError, offer


class ImportImagesCommand(WorkspaceCommand, ThreadsCommand):
    """Bring in real pictures.

    Pictures of one camera, of several or of a rig of up to eight, or videos, with a navigation log,
    GPS from EXIF, or nothing at all.
    """

    name = "import-images"
    advanced = "recursive time_zone vertical_datum triggers split"
    examples = (
        "import-images photos -w reef",
        "import-images --left cam1 --right cam2 --triggers triggers.csv -w reef",
        "import-images --camera bow=B --camera port=P --camera down=D --rig rig.json -w reef",
        "import-images --bag dive.mcap --every 0.5 --rig rig.json --navigation dive.csv -w reef",
        "import-images photos --navigation dive.csv --clock-offset -1.5 --masks masks -w reef",
        "import-images photos --navigation dive.csv --vertical-datum NN2000 -w reef",
        "import-images phone cameras --recursive -w reef",
        "import-images --video GX010042.MP4 --video GX020042.MP4 --overlap 0.7 -w reef",
        "import-images --video CARD --navigation dive.csv --time-zone Europe/Oslo -w reef",
        "import-images --video zed.mp4 --split left-right --rig rig.json -w reef",
    )
    title = "Import pictures"
    offered = (
        "folders", "camera", "bag", "video", "overlap", "every", "recursive", "navigation",
        "clock_offset", "time_zone", "vertical_datum", "rig", "masks", "triggers", "split",
        "replace", "threads",
    )  # fmt: skip
    folders: list[Path] | None = argument(None, "Folders of pictures; videos.", "DIR...")
    left: Path | None = option(None, "Pictures of the left camera.", metavar="DIR")
    right: Path | None = option(None, "Pictures of the right camera.", metavar="DIR")
    camera: list[str] | None = option(
        None, "NAME=FOLDER of a camera, for each of a rig; of a bag NAME=TOPIC."
    )
    bag: Path | None = option(None, "ROS bag with pictures.")
    video: list[Path] | None = option(None, "Videos to take frames from, or a folder of them.")
    overlap: float | None = option(
        None, "Of neighbouring frames; 0.7 without --every.", ge=0.3, le=0.95
    )
    every: float | None = option(None, "Seconds between frames, at a fixed step.", ge=0.01)
    recursive: bool = option(False, "Also take folders inside.")
    navigation: Path | None = option(
        None, "CSV: time or image, position, ...; or ODM's geo.txt.", metavar="FILE"
    )
    clock_offset: float = option(0.0, "Seconds to add to picture times.")
    time_zone: str = option("UTC", "Of times that name none.")
    vertical_datum: str | None = option(None, "What the CSV's depths count from.", metavar="NAME")
    rig: Path | None = option(None, "rig.json of the cameras.", metavar="FILE")
    masks: Path | None = option(None, "Folder of masks; black is left out.", metavar="DIR")
    triggers: Path | None = option(
        None, "CSV: image or number, time_s or time_utc; camera.", metavar="FILE"
    )
    split: Literal["left-right"] | None = option(None, "Cut frames that hold two cameras.")
    replace: bool = option(False, "Replace an earlier import of others.")

    def cameras(self) -> dict[str, Path]:
        """Folder of each camera of a rig, by its name.

        Raises:
            ImageError: one is not NAME=FOLDER, or left is given without right.
        """
        from alice_survey.core.errors import ImageError
        from camera_calib.picture_files import places_of_cameras

        if (self.left is None) != (self.right is None):
            raise ImageError(
                "--left and --right go together; of one camera give the folder, or --camera "
                "NAME=FOLDER"
            )
        pair = {} if self.left is None or self.right is None else {
            "left": self.left, "right": self.right,
        }  # fmt: skip
        named = {} if self.bag is not None else places_of_cameras(self.camera or ())
        return pair | {name: Path(place) for name, place in named.items()}

    def run(self) -> None:
        """Import them."""
        from alice_survey.app.pipeline import only_one
        from camera_calib.picture_files import places_of_cameras
        from reconstruct.pictures.importing import import_images

        cameras = self.cameras()
        with only_one(self.workspace):
            found = import_images(
                self.workspace, self.folders or [], cameras=cameras, bag=self.bag,
                topics={} if self.bag is None else places_of_cameras(self.camera or ()),
                videos=self.video or (), overlap=self.overlap, every_s=self.every,
                recursive=self.recursive, navigation=self.navigation,
                clock_offset_s=self.clock_offset, time_zone=self.time_zone,
                vertical_datum=self.vertical_datum, rig=self.rig, masks=self.masks,
                triggers=self.triggers, split=self.split is not None, overwrite=self.replace,
                executor=self.executor(),
            )  # fmt: skip
        self.show_next(found, self.workspace / "images")


class JoinCommand(WorkspaceCommand):
    """Bring the pictures of several dives together.

    One workspace whose 'reconstruct' makes one model of all. The dives share one rig.
    """

    name = "join"
    examples = ("join reef reef/revisit/dive -w both", "join day1 day2 day3 -w reef")
    dives: list[Path] = argument(..., "Their workspaces.", "DIVE...")

    def run(self) -> None:
        """Join them."""
        from reconstruct.pictures.importing import join_dives

        found = join_dives(self.workspace, self.dives)
        self.show_next(found, self.workspace / "images")


class ImportControlCommand(WorkspaceCommand):
    """Bring in ground control points of another program.

    Writes control.csv and picks.csv of the workspace, by which the next 'reconstruct' places the
    model.
    """

    name = "import-control"
    examples = (
        "import-control gcp_list.txt --sigma 0.02 -w reef",
        "import-control markers.xml -w reef --overwrite",
    )
    file: Path = argument(..., "ODM's gcp_list.txt, or Metashape's markers XML.")
    sigma: float | None = option(None, "m; of points whose accuracy is not stated.", ge=1e-6)
    sigma_vertical: float | None = option(None, "m; of heights; as --sigma if not given.", ge=1e-6)
    heights: Literal["level", "ellipsoid"] = option(
        "level", "They count from the level of the survey's depths, or from WGS 84's."
    )
    overwrite: bool = option(False, "Replace files that are there.")

    def run(self) -> None:
        """Convert them."""
        from reconstruct.placing.control_command import import_control

        found = import_control(
            self.workspace, self.file, sigma_m=self.sigma, sigma_vertical_m=self.sigma_vertical,
            heights=self.heights, overwrite=self.overwrite,
        )  # fmt: skip
        self.show_next(found, self.workspace)


class ImportLogCommand(ReportCommand):
    """Turn a vehicle's own log into the navigation CSV of import-images.

    ROS 1 and ROS 2 bags (COLA2 and common messages), ArduSub's DataFlash and telemetry logs, PX4's
    .ulg, and JSON of Water Linked's DVLs.
    """

    name = "import-log"
    advanced = "topic datum altitude_offset start_at heading_sigma flip_velocity"
    examples = (
        "import-log sparus2.bag -o navigation.csv",
        "import-log 00000042.BIN --declination 3.4 --tide tides.csv -o navigation.csv",
        "import-log dive.tlog --topic depth=VFR_HUD --vehicle-log vehicle.csv -o navigation.csv",
        "import-log dvl.json --dead-reckon --start-at 43.05 5.92 10 -o navigation.csv",
    )
    log: Path = argument(..., "ROS bag, log of ArduSub or PX4, or JSON of a Water Linked DVL.")
    output: Path = option(..., "CSV to write.", "-o", "--output", metavar="FILE")
    declination: float = option(
        0.0, "Add this declination to headings, degrees; east is positive.", ge=-180, le=180
    )
    tide: str = option("0", "Height of the water above the level of depths: metres, or a CSV.")
    topic: list[str] | None = option(
        None, "Use this topic or message for navigation, depth, attitude, altitude or velocity.",
        metavar="ROLE=NAME",
    )  # fmt: skip
    datum: tuple[float, float] | None = option(
        None, "Origin of the odometry of a bag, or of XKF1.", metavar="LATITUDE LONGITUDE"
    )
    lever_arm: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), "Place on the body that the logged position is of, m.", metavar="X Y Z"
    )
    altitude_offset: float = option(0.0, "Add this to altitudes.", metavar="METRES")
    vehicle_log: Path | None = option(None, "Write a vehicle log too.", metavar="FILE")
    dead_reckon: bool = option(False, "Compute positions from velocities, tied to fixes.")
    start_at: tuple[float, float, float] | None = option(
        None, "Place of the first velocity and its sigma, m.",
        metavar="LATITUDE LONGITUDE SIGMA",
    )  # fmt: skip
    heading_sigma: float = option(1.0, "Constant error of headings in dead reckoning, degrees.")
    flip_velocity: bool = option(False, "Turn the velocities of a DVL round.")

    def run(self) -> Result:
        """Read it and write the CSV."""
        from missions.logs.dead_reckoning import TrackErrors
        from missions.logs.import_log import ImportOptions, import_log

        options = ImportOptions(
            declination_deg=self.declination, tide=self.tide, topics=self.topic or (),
            datum_deg=self.datum, lever_body_m=self.lever_arm,
            altitude_offset_m=self.altitude_offset, vehicle_log=self.vehicle_log,
            start_at=self.start_at, flip_velocity=self.flip_velocity,
            dead_reckon=TrackErrors(heading_deg=self.heading_sigma) if self.dead_reckon else None,
        )  # fmt: skip
        return import_log(self.log, self.output, options)


class ReconstructCommand(DeviceCommand):
    """Turn pictures into a model.

    Camera track, DEM, point cloud, orthomosaic and textured mesh. With -o from a folder of pictures
    to the report; 'import-images' takes navigation, rigs and videos.
    """

    name = "reconstruct"
    examples = (
        "reconstruct photos -o dive",
        "reconstruct -w reef",
        "reconstruct -w reef --threads 2 --json",
        "reconstruct -w reef --scheduler tcp://10.0.0.1:8786",
        "reconstruct -w quay --plane level --plane 'wall=facing 180'",
        "reconstruct -w reef --export undistorted",
        "reconstruct -w reef --crs EPSG:32636",
    )
    title = "Reconstruct the sea floor"
    offered = ("plane", "crs", "export", "threads")
    output: Path | None = option(
        None, "Take WORKSPACE for a folder of pictures of one camera: import them into this new "
        "one, and end with the report.", "-o", "--output", metavar="DIR",
    )  # fmt: skip
    plane: list[str] | None = option(
        None, "Plane of DEM and mosaic, any number: level, auto (the best one), or 'NAME=facing "
        "DEGREES tilt DEGREES': where the surface faces, and its lean back.",
    )  # fmt: skip
    export: Literal["undistorted", "ply-obj"] | None = option(
        None, "Then write for other programs: pictures without refraction and distortion, with "
        "the COLMAP model; or the cloud as PLY and the mesh as OBJ.",
    )  # fmt: skip
    crs: str | None = option(
        None, "Then write rasters, cloud and mesh in this projected system too.",
        metavar="EPSG:N",
    )  # fmt: skip

    @classmethod
    def stages(cls) -> list[str]:
        """The model's, and the calibration before them."""
        from alice_survey.app.stages import names

        return names("calibrate", "reconstruct")

    def run(self) -> Result:
        """Run the stages, then write for other programs."""
        from alice_survey.app.pipeline import run, stage_states

        if self.crs is not None:
            from reconstruct.export import export_projected, projected_system

            projected_system(self.crs)  # before hours of work
        stages, workspace = self.stages(), self.output or self.workspace
        if self.output is not None:
            if self.output.resolve() == self.workspace.resolve():
                raise ConfigError(f"-o {self.output} holds the pictures: name a new folder")
            shared = {"workspace": workspace, "threads": self.threads}
            ImportImagesCommand(folders=[self.workspace], quiet=True, **shared).run()
            stages.append("report")
        with self.started_executor(self.device) as executor:
            changes = {"reconstruct": {"planes": self.plane}}
            text, values = run(stages, workspace, self.survey, executor, changes)
            if self.export is not None:
                from reconstruct.export import export_copies, export_undistorted

                if self.export == "undistorted":
                    more, values[self.export] = export_undistorted(workspace, executor)
                else:
                    more, values[self.export] = export_copies(workspace)
                text = f"{text}\n{more}"
        if self.crs is not None:
            more, values["crs"] = export_projected(workspace, self.crs)
            text = f"{text}\n{more}"
        if stage_states(workspace, self.settings())["report"].startswith("stale"):
            text += f"\nthe report is out of date: {offer('report', '-w', workspace)}"
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
    points: list[str] | None = option(
        None, "Two or more pixels in quotes, or one each time: 'IMAGE:x,y IMAGE:x,y', or "
        "IMAGE:x,y=IMAGE:x,y where two pictures show the point.", metavar="POINTS",
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
    pick_sigma: float = option(0.5, "Sigma of a pick by eye, or of a polygon's corner, px.", ge=0)

    def run(self) -> Result:
        """Measure either."""
        if (self.points is None) == (self.polygons is None):
            raise ConfigError("measure takes either --points or --polygons")
        if self.polygons is not None:
            from reconstruct.measure.shapes import measure_polygon_file

            return measure_polygon_file(
                self.workspace, self.polygons, label=self.label, pick_sigma_px=self.pick_sigma,
                output=self.output,
            )  # fmt: skip
        from reconstruct.picking.lengths import measure

        return measure(self.workspace, " ".join(self.points or ()), pick_sigma_px=self.pick_sigma)


class ControlCommand(WorkspaceCommand, ThreadsCommand, ReportCommand):
    """Find coded markers in the pictures, or scale a model by a known length.

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
    points: list[str] | None = option(
        None, "Two points of a known distance, in quotes or one each time: 'IMAGE:x,y IMAGE:x,y' "
        "or, in two pictures, IMAGE:x,y=IMAGE:x,y.", metavar="POINTS",
    )  # fmt: skip
    length: float | None = option(
        None, "Distance between the two points of --points.", metavar="METRES", ge=1e-6
    )

    def run(self) -> Result:
        """Do either."""
        from reconstruct.picking.lengths import scale_model
        from reconstruct.placing.control_command import survey_control

        if self.points is None and self.length is None:
            return survey_control(
                self.workspace, dictionary=self.dictionary, executor=self.executor()
            )
        if self.points is None or self.length is None:
            raise typer.BadParameter("--points and --length go together: give both, or neither")
        text = scale_model(self.workspace, " ".join(self.points), self.length)
        return text, {"text": text}


class QualityCommand(WorkspaceCommand, ThreadsCommand, ReportCommand):
    """Judge the pictures.

    Sharpness, exposure and turbidity of each; the bad ones by name, with the reason.
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

        return run(["evaluate"], self.workspace, self.survey, self.executor())


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

    def run(self) -> Result:
        """Cut it."""
        from reconstruct.mosaic.exports import mosaic_tiles

        return mosaic_tiles(
            self.workspace, self.output, side_px=self.side, overlap_px=self.overlap,
            kind=self.kind,
        )  # fmt: skip
