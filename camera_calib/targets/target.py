"""Calibration targets: chessboards, ChArUco boards and AprilTag grids.

The frame of every target: the origin is its first point, x runs right along the rows of points, y
down along the columns, z into the board, away from the camera. Points are numbered row by row from
the top left, as the board is read when it hangs upright.

- A chessboard's points are its inner corners. The square at its top left is black wherever that can
  be distinguished (see `Target.is_ambiguous`).
- A ChArUco board is OpenCV's: its points are the inner corners too, and the markers, in the white
  squares, count row by row from the top left. `legacy` is the layout before OpenCV 4.6: boards with
  an even number of rows then begin with a white square.
- An AprilTag grid is Kalibr's: tags of the family 36h11 with a black border of two bits (so that a
  tag is ten bits wide), and small black squares that touch the tags' corners. Tags count from the
  bottom left, upwards row by row. Its points are the four corners of all tags, two rows of points
  for a row of tags. (Kalibr numbers the points from the bottom left, with y up and z towards the
  camera: its point in row r of R is ours in row R - 1 - r.)
"""

import re
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from alice_survey.core.artefacts import check_type, read_json, write_json
from alice_survey.core.contents import one_line
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array

Kind = Literal["chessboard", "charuco", "apriltag"]

FORMAT, VERSION = "alice-survey target", 1
TAG_FAMILY = "DICT_APRILTAG_36h11"
TAG_BITS, TAG_BORDER_BITS = 10, 2
"""Bits along a tag with its border, and the width of the border."""
_DEFAULT_DICTIONARY = "DICT_5X5_1000"
_MIN_COUNT, _MAX_COUNT = 3, 100
_MIN_M, _MAX_M = 1e-4, 10.0
_MIN_MARKER, _MAX_MARKER = 0.3, 0.95
_MIN_SPACING, _MAX_SPACING = 0.1, 1.0
_LENGTH = r"(?:\d+\.?\d*|\.\d+)(?:mm|cm|m)"
_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_GRAMMAR = (
    "write 'chessboard 9x6 25mm' (inner corners, square), 'charuco 12x9 40mm 30mm' (squares, "
    "square, marker; then, if needed, a dictionary such as DICT_5X5_250, and legacy), "
    "'apriltag 6x6 88mm 0.3' (tags, tag, gap over tag) or the path of a target's JSON file"
)


@dataclass(frozen=True, kw_only=True)
class Rejection:
    """A picture, or points of it, that took no part, and why."""

    view: str
    camera: str
    points: int
    """Number of points; 0 for the whole picture."""
    reason: str


@dataclass(frozen=True, kw_only=True)
class Target:
    """A flat pattern whose points are known.

    Raises:
        CalibrationError: no such target can be made or used.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    kind: Kind
    columns: int
    rows: int
    """Inner corners of a chessboard, squares of a ChArUco board, tags of an AprilTag grid."""
    size_m: float
    """Side of a square, or of a tag."""
    marker_m: float | None = None
    """Side of a marker (ChArUco)."""
    dictionary: str | None = None
    """OpenCV's name of the markers' dictionary (ChArUco)."""
    legacy: bool = False
    """Laid out as OpenCV did before 4.6 (ChArUco)."""
    spacing: float | None = None
    """Gap between tags over the side of a tag (AprilTag)."""

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise CalibrationError(f"target: no kind '{self.kind}'; {_GRAMMAR}")
        counted, sized, minimum, own = _KINDS[self.kind]
        fields = {"marker_m", "dictionary", "spacing"}
        given = {name for name in fields if getattr(self, name) is not None}
        if given != set(own) or (self.legacy and self.kind != "charuco"):
            raise CalibrationError(
                f"target: a {self.kind} has {', '.join(own) or 'no more than counts and a size'}; "
                f"{_GRAMMAR}"
            )
        share = None if self.marker_m is None else self.marker_m / self.size_m
        for what, number, low, high in (
            (f"a count of {counted}", self.columns, minimum, _MAX_COUNT),
            (f"a count of {counted}", self.rows, minimum, _MAX_COUNT),
            (f"mm for a {sized}", 1e3 * self.size_m, 1e3 * _MIN_M, 1e3 * _MAX_M),
            ("of a square's side for its marker", share, _MIN_MARKER, _MAX_MARKER),
            ("of a tag's side for its gap (spacing)", self.spacing, _MIN_SPACING, _MAX_SPACING),
        ):
            if number is not None and not low <= number <= high:
                raise CalibrationError(
                    f"target: {number:g} {what}: it must be {low:g} to {high:g}; check the unit"
                )
        if self.kind == "chessboard":
            return
        family = TAG_FAMILY if self.dictionary is None else self.dictionary
        if family not in dictionary_names():
            raise CalibrationError(
                f"target: no dictionary '{family}'; take one of {', '.join(dictionary_names())}"
            )
        held, needed = len(aruco_dictionary(family).bytesList), len(self.marker_places)
        if held < needed:
            raise CalibrationError(
                f"target: {self.columns}x{self.rows} {counted} need {needed} markers, {family} "
                f"has {held}: take a larger dictionary or fewer {counted}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of points."""
        if self.kind == "charuco":
            return self.rows - 1, self.columns - 1
        if self.kind == "apriltag":
            return 2 * self.rows, 2 * self.columns
        return self.rows, self.columns

    @cached_property
    def points(self) -> Array:
        """(N, 3) points in the target's frame, metres, row by row, z = 0."""
        rows, columns = self.shape
        y, x = (self._places(count) for count in (rows, columns))
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1).reshape(-1, 3)

    def _places(self, count: int) -> Array:
        index = np.arange(count, dtype=np.float64)
        if self.spacing is None:
            places: Array = index * self.size_m
        else:
            places = (index // 2 * (1.0 + self.spacing) + index % 2) * self.size_m
        return places

    @property
    def outline(self) -> tuple[float, float, float, float]:
        """Least x, least y, greatest x, greatest y of the pattern in the target's frame, metres.

        The border of the black pattern; a target also needs a white margin around it.
        """
        x, y = self.points[-1, :2]
        around = self.size_m * (1.0 if self.spacing is None else self.spacing)
        return -around, -around, float(x) + around, float(y) + around

    @property
    def top_left_black(self) -> NDArray[np.bool_]:
        """(N,) whether the area above and left of a point is black; it is opposite below it."""
        rows, columns = self.shape
        y, x = np.mgrid[:rows, :columns]
        return np.asarray(((x + y + self.first_square_white) % 2 == 0).ravel())

    @property
    def first_square_white(self) -> bool:
        """Whether the square at the top left is white: so in old ChArUco boards of even rows."""
        return self.legacy and self.rows % 2 == 0

    @property
    def is_ambiguous(self) -> bool:
        """Whether the numbering is not unique: two cameras may number points differently.

        A chessboard with two odd or two even counts looks the same when turned by half a turn; one
        with an odd and an even count, which has one black corner square and its opposite white,
        does not, nor does any target with markers.
        """
        return self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0

    @property
    def description(self) -> str:
        """The target in words that `parse_target` reads."""
        words = [self.kind, f"{self.columns}x{self.rows}", f"{self.size_m * 1e3:.10g}mm"]
        if self.marker_m is not None:
            words += [f"{self.marker_m * 1e3:.10g}mm", str(self.dictionary)]
        if self.spacing is not None:
            words.append(f"{self.spacing:.10g}")
        return " ".join([*words, "legacy"] if self.legacy else words)

    @cached_property
    def _white_squares(self) -> list[tuple[int, int]]:
        """Column and row of the squares that hold a ChArUco board's markers, in their order."""
        first = int(self.first_square_white)
        return [
            (x, y) for y in range(self.rows) for x in range(self.columns) if (x + y + first) % 2
        ]

    @property
    def marker_places(self) -> Array:
        """(M, 2) top left corner of each marker by its number, in the target's frame, metres."""
        if self.kind == "charuco" and self.marker_m is not None:
            margin = (self.size_m - self.marker_m) / 2.0
            return (np.array(self._white_squares, dtype=np.float64) - 1.0) * self.size_m + margin
        if self.kind == "apriltag":
            grid = self.points[:, :2].reshape(*self.shape, 2)[::2, ::2]
            return np.ascontiguousarray(grid[::-1]).reshape(-1, 2)
        return np.empty((0, 2))

    def to_json(self) -> dict[str, Any]:
        """As a JSON object; what its kind lacks is left out."""
        data = {key: value for key, value in asdict(self).items() if value is not None}
        if self.kind != "charuco":
            del data["legacy"]
        return {"format": FORMAT, "version": VERSION, **data}

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """The inverse of `to_json`.

        Raises:
            CalibrationError: it is not a target, or a newer one than this program knows.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise CalibrationError(f'target: its file must hold "format": "{FORMAT}"')
        if data.get("version") != VERSION:
            raise CalibrationError(f"target: version {data.get('version')}; {VERSION} is known")
        values = {key: value for key, value in data.items() if key not in ("format", "version")}
        try:
            return check_type(cls, values)
        except ValueError as error:
            raise CalibrationError(f"target: its file is wrong: {error}") from None


_KINDS: dict[str, tuple[str, str, int, tuple[str, ...]]] = {
    "chessboard": ("inner corners", "square", _MIN_COUNT, ()),
    "charuco": ("squares", "square", _MIN_COUNT, ("marker_m", "dictionary")),
    "apriltag": ("tags", "tag", 1, ("spacing",)),
}
"""What is counted, what has the size, the least count, and the fields of its own."""
_WORDS = re.compile(
    r"(?P<kind>chessboard|charuco|apriltag) (?P<columns>\d{1,6})x(?P<rows>\d{1,6}) "
    rf"(?P<size>{_LENGTH})(?: (?P<marker>{_LENGTH})(?: (?P<dictionary>DICT_\w+))?"
    r"(?P<legacy> legacy)?| (?P<spacing>\d*\.?\d+))?",
    re.IGNORECASE,
)


def parse_target(text: str) -> Target:
    """Read a target from words, or from the JSON file that `alice-survey target` writes.

    Raises:
        CalibrationError: the words or the file are wrong; the message shows how they must be.
        WorkspaceError: the file is missing or no JSON.
    """
    if text.strip().lower().endswith(".json"):
        return read_target(Path(text.strip()))
    found = _WORDS.fullmatch(" ".join(text.split()))
    if found is None:
        raise CalibrationError(f"target '{text}' is not understood: {_GRAMMAR}")
    marker, word = found["marker"], found["dictionary"] or _DEFAULT_DICTIONARY
    known = {name.upper(): name for name in dictionary_names()}
    return Target(
        kind=found["kind"].lower(),  # type: ignore[arg-type]  # one of them, by the pattern
        columns=int(found["columns"]),
        rows=int(found["rows"]),
        size_m=_length_m(found["size"]),
        marker_m=None if marker is None else _length_m(marker),
        dictionary=None if marker is None else known.get(word.upper(), word),
        legacy=found["legacy"] is not None,
        spacing=None if found["spacing"] is None else float(found["spacing"]),
    )


def read_target(path: Path) -> Target:
    """Read a target's JSON file.

    Raises:
        CalibrationError: the file describes no target.
        WorkspaceError: it is missing or no JSON.
    """
    data = read_json(path)
    try:
        return Target.from_json(data)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {one_line(error)}") from None


def write_target(path: Path, target: Target) -> None:
    """Write a target's JSON file, which `parse_target` reads."""
    write_json(path, target.to_json())


def dictionary_names() -> list[str]:
    """OpenCV's names of marker dictionaries."""
    return sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def aruco_dictionary(name: str) -> Any:
    """OpenCV's dictionary of a name that `dictionary_names` holds."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _length_m(word: str) -> float:
    number = word.rstrip("cmCM")
    return round(float(number) * _UNITS_M[word[len(number) :].lower()], 12)
