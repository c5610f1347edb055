"""Commands on cameras behind flat ports: `alice-survey camera ...`."""

from pathlib import Path

from alice_survey.app.commands.base import ReportCommand, Result, argument, option


class CameraCommand(ReportCommand):
    """Convert and judge cameras behind ports; by itself, show index and attenuation of water."""

    name = "camera"
    examples = (
        "camera --temperature 24 --salinity 39 --depth 15",
        "camera --jerlov 3C --json",
        "camera convert --help",
    )
    temperature: float = option(20.0, "Temperature of the water, C.")
    salinity: float = option(35.0, "Salinity of the water, psu; 0 is fresh.")
    depth: float = option(10.0, "Depth below the surface, m.")
    jerlov: str = option("II", "Type of the water: I, II, III; coastal 1C to 9C.")

    def run(self) -> Result:
        """Compute them."""
        from camera_calib.water import water_report

        return water_report(self.temperature, self.salinity, self.depth, self.jerlov)


class ConvertCommand(ReportCommand):
    """Convert between tools.

    OpenCV, COLMAP, Refractive COLMAP, Kalibr, ROS, Metashape, rig.json; from EuRoC, ORB-SLAM, ZED
    and Matisse. Nothing is lost silently.
    """

    name = "camera convert"
    advanced = "unit_m names dome_centre n_glass water mount lever drop_covariance"
    examples = (
        "camera convert rig.json cameras.xml --drop-port --drop-covariance",
        "camera convert rig.json model --to colmap --water 1.5 3 --drop-covariance",
        "camera convert rig.json model --to refractive --drop-covariance",
        "camera convert camchain.yaml rig.json --port-distance 20 --glass 10 --n-water 1.34",
        "camera convert gopro.yml rig.json --dome-radius 60 --dome-centre 0 0 5 --n-water 1.34",
        "camera convert intrinsics.yml rig.json --extrinsics extrinsics.yml --image-size 640 480",
        "camera convert rig.json left.yaml --to ros --camera left --drop-port --drop-covariance",
        "camera convert rig.json mounted.json --mount nadir-bow-up --lever 0.55 -0.05 0.08",
        "camera convert pool.json sea.json --n-water 1.342",
    )
    source: Path = argument(..., "File, or folder of a model.", "IN")
    target: Path = argument(..., "File, or folder.", "OUT")
    source_format: str | None = option(
        None, "Found from the file if not given.", "--from", metavar="FORMAT"
    )
    target_format: str | None = option(
        None, "rig, opencv, colmap, refractive, kalibr, ros or metashape.", "--to",
        metavar="FORMAT",
    )  # fmt: skip
    image_size: tuple[int, int] | None = option(None, "Pixels, when IN states none.", metavar="W H")
    extrinsics: Path | None = option(None, "OpenCV file of R and T.", metavar="FILE")
    unit_m: float = option(1.0, "Metres in one unit of IN's translations.")
    camera: str | None = option(None, "Convert this camera alone.")
    lens: str | None = option(
        None, "fisheye or opencv: of an OpenCV file of 4 coefficients that does not say."
    )
    names: str | None = option(None, "New names, such as left,right.")
    port_distance: float | None = option(None, "Entrance pupil to inner glass, mm.", ge=0)
    dome_radius: float | None = option(None, "A dome's outer radius, mm.", ge=1)
    dome_centre: tuple[float, float, float] | None = option(
        None, "The dome's, from the pupil: right, down, forward, mm.", metavar="X Y Z"
    )
    glass: float | None = option(None, "Thickness, mm.", ge=0)
    n_glass: float | None = option(None, "Index; if new 1.52, of a dome 1.49.", ge=1)
    n_water: float | None = option(None, "Index of the water.", ge=1)
    water: tuple[float, float] | None = option(
        None, "m: fit cameras without port for these distances.", metavar="NEAR FAR"
    )
    mount: str | None = option(
        None, "How the rig sits on its vehicle: nadir-bow-up, -right, -down, -left; forward, aft, "
        "port, starboard; forward+30: 30 degrees down; or a file of a pose or of a rig.",
    )  # fmt: skip
    lever: tuple[float, float, float] | None = option(
        None, "First camera's glass: forward, right, down, m.", metavar="X Y Z"
    )
    drop_port: bool = option(False, "Cameras as in air.")
    drop_covariance: bool = option(False, "Leave it out where OUT cannot hold it.")
    overwrite: bool = option(False, "Replace OUT.")

    def run(self) -> Result:
        """Read, change and write."""
        from camera_calib.formats.convert import Conversion, convert
        from camera_calib.formats.rigs import ReadOptions
        from camera_calib.ports.dome import DomePort

        centre_mm = self.dome_centre or (None, None, None)
        lengths = zip(
            (*DomePort.places, "outer_radius_m", "port_distance_m", "glass_thickness_m"),
            (*centre_mm, self.dome_radius, self.port_distance, self.glass), strict=True,
        )  # fmt: skip
        port = {name: None if mm is None else mm / 1e3 for name, mm in lengths}
        port |= {"n_glass": self.n_glass, "n_water": self.n_water}
        task = Conversion(
            source=self.source, target=self.target, source_format=self.source_format,
            target_format=self.target_format,
            reading=ReadOptions(
                image_size=self.image_size, extrinsics=self.extrinsics,
                metres_per_unit=self.unit_m, camera=self.camera, lens=self.lens,
            ),
            names=tuple(self.names.split(",")) if self.names else (),
            port={name: value for name, value in port.items() if value is not None},
            mount=self.mount, lever_m=self.lever, water=self.water,
            drop_port=self.drop_port, drop_covariance=self.drop_covariance,
            overwrite=self.overwrite,
        )  # fmt: skip
        return convert(task)


class UncertaintyCommand(ReportCommand):
    """Show what a calibration's sigmas mean.

    For pixels over the frame, for triangulated points and for lengths, against distance.
    """

    name = "camera uncertainty"
    examples = ("camera uncertainty rig.json", "camera uncertainty rig.json --range 2 --json")
    rig: Path = argument(..., "rig.json with its covariance.", "RIG")
    ranges: list[float] | None = option(None, "Distances to look at, m.", "--range")
    near: float = option(1.0, "Nearest of what poses are found from, m.")
    far: float = option(3.0, "Farthest, m.")
    noise: float = option(0.1, "Sigma of a coordinate, px.", ge=0)

    def run(self) -> Result:
        """Propagate the covariance."""
        from camera_calib.judge.uncertainty import uncertainty_report

        return uncertainty_report(self.rig, self.ranges, self.near, self.far, self.noise)
