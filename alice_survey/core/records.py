"""Contents of the JSON files of finished stages: one type each, for writers and readers.

A type names the values that programs read; others are kept as they are. Types of files that need
more than numbers are with their algorithms: the plan (`missions.values.plan_file`), the rig
(`camera_calib.rig`), frame and lenses of a model (`reconstruct.views`), light
(`reconstruct.light`), the manifest (`alice_survey.core.manifest`).
"""

from typing import Any, ClassVar, Literal

from pydantic import Field

from alice_survey.core.artefacts import JsonRecord

Notes = tuple[str, ...]


class BoardRecord(JsonRecord):
    """`pool/board.json`: a flat chessboard by its inner corners."""

    path: ClassVar = "pool/board.json"
    columns: int = 11
    rows: int = 8
    """Inner corners along x and along y."""
    square_m: float = 0.04


class PlaceRecord(JsonRecord):
    """Origin of the local frame, WGS 84."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-360, le=360)
    height_m: float = Field(0.0, gt=-1e5, lt=1e5)


class PicturesRecord(JsonRecord):
    """`images/survey.json`: origin of the pictures, and the datum of their positions."""

    path: ClassVar = "images/survey.json"
    source: Literal["simulated", "imported"]
    datum: PlaceRecord | None = None
    vertical_datum: str | None = None
    notes: Notes = ()


class OnLines(JsonRecord):
    """How well a vehicle kept to its lines."""

    cross_track_rms_m: float | None
    cross_track_worst_m: float | None = None
    believed_cross_track_rms_m: float | None
    heading_rms_deg: float | None


class InTurns(JsonRecord):
    """Motion of a vehicle between its lines."""

    roll_worst_deg: float | None


class Covered(JsonRecord):
    """Shares of the area that pictures show."""

    covered_share: float
    every_camera_share: float
    share_at_overlap: float


class MissionFlown(JsonRecord):
    """A mission file that was flown instead of the plan's route."""

    file: str
    follower: str
    """Autopilot by whose law it was flown."""
    line_ends: int
    line_ends_overshot: int
    planned: Covered
    """What the plan's certificate promises of its lines."""


class OutsideAllowed(JsonRecord):
    """How a flight kept within the allowed area."""

    share_of_time: float
    worst_m: float
    allowed_m: float | None = None
    """As far as a picture may be off its line, and what an autopilot's law is expected to add."""


class FlightRecord(JsonRecord):
    """`flight/flight.json`."""

    path: ClassVar = "flight/flight.json"
    vehicle: str
    controller: str
    ending: str
    """`complete`, or why it ended early."""
    duration_s: float
    stations: int
    stations_planned: int
    stations_off_line: int = 0
    allowed_cross_track_m: float | None = None
    min_clearance_m: float | None = None
    """Of hull, port and DVL above the sea floor."""
    outside_allowed: OutsideAllowed | None = None
    on_lines: OnLines
    in_turns: InTurns
    navigation_error_rms_m: float | None
    energy_wh: dict[str, float]
    """Energy by thruster."""
    coverage: Covered
    mission: MissionFlown | None = None


class CalibrationRecord(JsonRecord):
    """`calibration/calibration.json`."""

    path: ClassVar = "calibration/calibration.json"
    views: int
    rms_px: float
    worst_px: float
    parameters: tuple[str, ...] = ()
    correlation: tuple[tuple[float, ...], ...] = ()
    """Correlations of the parameters, square."""


class CalibrationVerdict(JsonRecord):
    """One line of a calibration report."""

    level: Literal["good", "look", "bad"]
    text: str


class CalibratedValue(JsonRecord):
    """A parameter of a calibrated rig."""

    name: str
    value: float
    sigma: float | None
    """Standard deviation; None or 0 where it was held."""
    unit: str


class CalibrationReportRecord(JsonRecord):
    """`calibration/report.json`."""

    path: ClassVar = "calibration/report.json"
    views: int = 0
    rms_px: float = 0.0
    verdicts: tuple[CalibrationVerdict, ...] = ()
    parameters: tuple[CalibratedValue, ...] = ()


class RangeRecord(JsonRecord):
    """Distances from the cameras at which the scene lies."""

    near_m: float
    far_m: float
    source: str


class RefractionRecord(JsonRecord):
    """How the keypoints of a mapping converged to where refraction puts them."""

    moved_px: tuple[float, ...] = ()
    """Largest shift of a keypoint in every round."""
    corrected_px: float = 0.0
    """Root mean square of the whole shift from the warped keypoints."""
    removed: int = 0
    """Observations that the exact keypoints showed to be wrong."""
    added: int = 0
    """Observations that they let in."""
    settled: bool
    """Whether the last shift was negligible."""


class BendRecord(JsonRecord):
    """Sag of a model along one direction, against navigation."""

    length_m: float
    """Length of the block along the direction."""
    sag_m: float
    """How far the middle is off against the ends."""
    sag_sigma_m: float
    straightened_per_m: float = 0.0
    """Curvature that navigation took out of the model before."""
    curvature_per_m: float = 0.0
    """Second derivative of the model's height error: positive where ends are too high."""
    sigma_per_m: float = 0.0

    def is_significant(self, pixel_m: float) -> bool:
        """Whether it is beyond three sigmas and larger than a ground pixel."""
        return abs(self.sag_m) > max(3.0 * self.sag_sigma_m, pixel_m)


class ScaleOfPairs(JsonRecord):
    """Lengths of the model over those of its stations' own stereo, over the survey."""

    mean: float
    """1 when they agree."""
    mean_sigma: float


class DomingRecord(JsonRecord):
    """Evidence of a bent model; what could not be measured is None."""

    along: BendRecord | None = None
    across: BendRecord | None = None
    """Perpendicular to the block's longest axis; None for a single line."""
    scale: ScaleOfPairs | None = None
    notes: Notes = ()
    pixel_m: float | None = None
    """Ground pixel, metres."""

    @property
    def bends(self) -> dict[str, BendRecord]:
        """Known bends, by direction."""
        ways = {"along": self.along, "across": self.across}
        return {way: bend for way, bend in ways.items() if bend is not None}


class FarStation(JsonRecord):
    """A station that is not where navigation places it."""

    station: int
    image: str
    off_m: float
    sigmas: float
    """Its distance over the usual one."""


class AcceptanceRecord(JsonRecord):
    """Signs that a mapping is wrong: against its rig and navigation."""

    notes: Notes = ()
    checked: int = 0
    """Stations with a position."""
    far: tuple[FarStation, ...] = ()
    """Stations off navigation, the farthest first."""
    rig_error: float | None = None
    """Relative error of the rig in the finished model."""


class WarpRecord(JsonRecord):
    """How well a pinhole stands in for a camera."""

    offset_m: float
    """Largest distance by which rays of the frame miss the pinhole's centre."""
    contraction: float
    """Change of a pixel's shift with the pixel, over the distances: below 1 the warp is one to one.
    """
    cut_share: float
    """Share of the frame that the pinhole's picture leaves out."""


class MappingRecord(JsonRecord):
    """`mapping/mapping.json`."""

    path: ClassVar = "mapping/mapping.json"
    registered: int = 0
    total: int = 0
    models: tuple[int, ...] = ()
    """Pictures in each model that was found."""
    scaled: bool = False
    baseline: float | None = None
    rig_factor: float | None = None
    distances: RangeRecord | None = None
    refraction: RefractionRecord | None = None
    warps: dict[str, WarpRecord] = Field(default_factory=dict)
    gauge: str = ""
    """Digest of the model: a known length applies to this one alone."""
    notes: Notes = ()


class PortRecord(JsonRecord):
    """`sparse/port.json`: the rig as refined by the survey's own pictures."""

    path: ClassVar = "sparse/port.json"
    stations: int
    observations: int
    parameters: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    prior_sigmas: tuple[float | None, ...]
    sigmas: tuple[float | None, ...]
    correlation: tuple[tuple[float, ...], ...]
    contradiction: str | None = None
    """What the pictures say against the calibration, in words."""
    sigma_px: float | None = None
    """Sigma of one coordinate of a keypoint."""


class MountRecord(JsonRecord):
    """How the rig is mounted, where the survey found it."""

    words: str
    body_from_rig: dict[str, Any] = Field(default_factory=dict)
    turn_sigma_deg: tuple[float, ...] = ()
    """About the vehicle's axes forward, right, down."""
    lever_sigma_m: tuple[float, ...] = ()


class NuisanceRecord(JsonRecord):
    """What was found of an error of the installation or of navigation's own frame."""

    value: float
    sigma: float


class GeoreferenceRecord(JsonRecord):
    """`sparse/georeference.json`: residuals of navigation, and sigmas of the placing."""

    path: ClassVar = "sparse/georeference.json"
    rms_north_m: float | None = None
    rms_east_m: float | None = None
    rms_depth_m: float | None = None
    sigma_north_m: float | None = None
    sigma_east_m: float | None = None
    sigma_depth_m: float | None = None
    sigma_heading_deg: float | None = None
    sigma_tilt_deg: float | None = None
    scale_of_navigation: float | None = None
    scale_of_navigation_sigma: float | None = None
    sigma_scale: float = 0.0
    """Sigma of the logarithm of the scale that navigation gave; 0 where it is held."""
    mount: MountRecord | None = None
    format: str = "alice-survey georeference"
    version: int = 1
    stations: int = 0
    left_out: dict[str, int] = Field(default_factory=dict)
    """Readings that the rest contradicts, by group of channels."""
    largest_tilt_deg: float = 0.0
    largest_tilt_axis_deg: float = 0.0
    nuisances: dict[str, NuisanceRecord] = Field(default_factory=dict)
    soft_modes: tuple[float, ...] = ()
    """Sizes of the model's soft modes, in their sigmas."""
    soft_modes_factor: float = 1.0
    middle_ned_m: tuple[float, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    covariance_order: tuple[str, ...] = ()
    errors: dict[str, dict[str, float]] = Field(default_factory=dict)
    """How navigation's errors are correlated, by group of channels."""


class SimilarityRecord(JsonRecord):
    """`target = scale * rotation * source + translation`; the identity by default."""

    scale: float = Field(1.0, gt=0)
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)


class JointRecord(JsonRecord):
    """How well a group that no picture links to the largest one is placed relative to it.

    Sigmas are of the vector between the middles of both, and of the turn of one against the other.
    """

    stations: int
    sigma_north_m: float
    sigma_east_m: float
    sigma_depth_m: float
    sigma_tilt_deg: float
    sigma_heading_deg: float


class RegistrationRecord(JsonRecord):
    """`sparse/registration.json`."""

    path: ClassVar = "sparse/registration.json"
    registered: int
    total: int
    stations: int = 0
    models: tuple[int, ...] = ()
    joints: tuple[JointRecord, ...] = ()
    """Of every part that only navigation joins to the largest."""
    points: int
    mean_reprojection_px: float
    mean_track_length: float
    baseline: float | None = None
    rig_factor: float | None = None
    scale_source: str | None
    gauge: str = ""
    """Digest of the mapped model, as in its `MappingRecord`."""
    world_from_mapping: SimilarityRecord = SimilarityRecord()
    working_range: RangeRecord | None = None
    doming: DomingRecord | None = None
    acceptance: AcceptanceRecord | None = None
    georeference: GeoreferenceRecord | None = None


class ControlRow(JsonRecord):
    """How a known point or length fits the model."""

    name: str
    use: str
    misfit_sigmas: float


class PointRow(ControlRow):
    """Errors of a known point, metres."""

    views: int
    north_m: float
    east_m: float
    down_m: float
    left_out: tuple[str, ...] = ()
    """Pictures whose picks are off the common point."""
    reprojection_px: float | None = None
    sigma_picks_m: float | None = None


class BarRow(ControlRow):
    """Error of a known length."""

    known_m: float
    error_m: float
    error_relative: float
    length_m: float | None = None
    sigma_picks_m: float | None = None


class ControlRms(JsonRecord):
    """Statistics of all points and bars of one use; None where there is none."""

    points: int = 0
    north_m: float | None = None
    east_m: float | None = None
    down_m: float | None = None
    bars: int = 0
    length_m: float | None = None
    length_relative: float | None = None


class ControlRecord(JsonRecord):
    """`sparse/control.json`."""

    path: ClassVar = "sparse/control.json"
    points: tuple[PointRow, ...]
    bars: tuple[BarRow, ...]
    not_found: dict[str, str]
    """Reasons, by name."""
    sigma_factor: float = 1.0
    """How many times larger sigmas of points are than stated."""
    rms: dict[str, ControlRms]
    """Statistics by use."""
    format: str = "alice-survey control"
    version: int = 1


class PictureCamera(JsonRecord):
    """Camera of a picture of a model, and its mask."""

    camera: str
    station: int
    mask: str | None = None


class CamerasRecord(JsonRecord):
    """`sparse/cameras.json`: the cameras and the pictures of a model."""

    path: ClassVar = "sparse/cameras.json"
    cameras: dict[str, dict[str, Any]]
    """As `camera_calib.approximation.pinhole_warp` reads them."""
    images: dict[str, PictureCamera]


class FrameRecord(JsonRecord):
    """`sparse/frame.json`: what the coordinates of a model mean."""

    path: ClassVar = "sparse/frame.json"
    name: Literal["ned", "model"] = "ned"
    datum: PlaceRecord | None = None
    scaled: bool = True
    """Whether lengths are metres."""
    vertical_datum: str = ""
    notes: Notes = ()


class ScaleRecord(JsonRecord):
    """`scale.json` of a workspace: one known length."""

    path: ClassVar = "scale.json"

    points: tuple[str, str]
    length_m: float
    metres_per_unit: float = Field(gt=0, allow_inf_nan=False)
    gauge: str
    """Digest of the model that was measured, as in its `MappingRecord`."""


class CloudRecord(JsonRecord):
    """`dense/cloud.json`; lengths in the unit of the model."""

    path: ClassVar = "dense/cloud.json"
    points: int
    offset_east_north_up: tuple[float, float, float]
    thinned_to: float


Direction = tuple[float, float, float]


class PlaneRecord(JsonRecord):
    """`plane.json` of a folder: the plane that its rasters are projected on.

    A raster's place (x, y) and height h there are the point origin + x right + y up + h out, in the
    model's unit: east, north and up from the datum.
    """

    path: ClassVar = "dense/plane.json"
    name: str
    about: str
    origin_enu: Direction
    right_enu: Direction
    up_enu: Direction
    out_enu: Direction
    """Unit vectors: right and up in the plane for its viewer, and out of it towards the viewer."""
    frame: Literal["ned", "model"]
    unit: str
    datum: PlaceRecord | None = None
    vertical_datum: str


class MovingMasks(JsonRecord):
    """Pictures parts of which are masked since they move."""

    pictures: int
    """Looked at."""
    masked: int
    masked_share: float
    """Of the area of all."""


class SurfaceRecord(JsonRecord):
    """`dense/surface.json`."""

    path: ClassVar = "dense/surface.json"
    match_sigma_px: float
    pose_sigma: float | None = None
    cell: float
    """Side of a cell, in the unit."""
    vertical_datum: str
    moving: MovingMasks | None = None


class MosaicRecord(JsonRecord):
    """`mosaic/mosaic.json`."""

    path: ClassVar = "mosaic/mosaic.json"
    width_px: int
    height_px: int
    pixel: float
    """Side of a cell, in the unit."""
    unit: str = "m"
    pictures: tuple[str, ...] = ()


class MeshRecord(JsonRecord):
    """`mesh/mesh.json`."""

    path: ClassVar = "mesh/mesh.json"
    triangles: int
    area: float
    textured_share: float
    offset_east_north_up: tuple[float, float, float]


class CameraErrors(JsonRecord):
    """Errors of the camera track against the truth."""

    registered: int
    total: int
    rms_mm: float
    max_mm: float
    scale_error_ppm: float


class Dome(JsonRecord):
    """Bend of the surface against the truth."""

    dome_mm: float | None


class ErrorOverSigma(JsonRecord):
    """Errors of heights over their stated sigmas."""

    rms: float | None
    median: float | None = None


class SurfaceErrors(JsonRecord):
    """Errors of the DEM against the truth."""

    distance_rms_mm: float
    distance_max_mm: float | None = None
    doming: Dome
    ground_pixel_mm: float
    completeness_within_px: dict[str, float]
    """Share of the area, by ground pixels."""

    error_over_sigma: ErrorOverSigma | None = None


class MosaicErrors(JsonRecord):
    """Errors of the mosaic against the truth."""

    position_rms_mm: float | None = None
    position_95_mm: float | None = None


class LengthsRecord(JsonRecord):
    """Errors of lengths in the mosaic against the truth."""

    rms_mm: float | None = None
    mean_length_m: float | None = None


class MeshErrors(JsonRecord):
    """Errors of the mesh against the truth."""

    distance_rms_mm: float | None


class ScoreRecord(JsonRecord):
    """`evaluation/score.json`: errors against the truth of a simulated survey."""

    path: ClassVar = "evaluation/score.json"
    cameras: CameraErrors
    surface: SurfaceErrors
    mosaic: MosaicErrors
    lengths: LengthsRecord
    mesh: MeshErrors | None = None


class Distances(JsonRecord):
    """Distances from one surface to another, metres."""

    median_m: float
    median_px: float
    rms_m: float
    within_95_m: float = Field(alias="95_m")
    covered_share: float


class ReferenceRegistration(JsonRecord):
    """Alignment of a survey to a reference."""

    transform: str


class ReferenceRecord(JsonRecord):
    """`reference/reference.json`."""

    path: ClassVar = "reference/reference.json"
    reference: str
    """Path of its file."""
    registration: ReferenceRegistration
    survey_to_reference: Distances
    reference_to_survey: Distances

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.reference.rsplit("/", 1)[-1]


class ChangeRecord(JsonRecord):
    """`against/NAME/change.json`: figures of a comparison with an earlier survey."""

    path: ClassVar = "against/NAME/change.json"

    @property
    def plain(self) -> dict[str, int | float | str]:
        """Its numbers and texts."""
        values: dict[str, Any] = self.to_json()
        return {
            name: value
            for name, value in values.items()
            if isinstance(value, (int, float, str)) and not isinstance(value, bool)
        }


class ReportRecord(JsonRecord):
    """`report/report.json`."""

    path: ClassVar = "report/report.json"
    summary: dict[str, str]
    """Answers by question."""
