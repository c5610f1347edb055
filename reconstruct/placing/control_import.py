"""Control points of other programs into a workspace: `control.csv` and `picks.csv`.

A format is one module with a reader that returns `ForeignControl`; `_READERS` lists them.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

from alice_survey.core.artefacts import need_stage, write_csv
from alice_survey.core.contents import one_line, shown
from alice_survey.core.errors import WorkspaceError, warn, why
from alice_survey.core.manifest import read_manifest
from reconstruct.pictures.files import safe_name
from reconstruct.placing.control_file import CONTROL_FILE, PICKS_FILE
from reconstruct.placing.foreign_control import ForeignBar, ForeignControl, ForeignPoint
from reconstruct.placing.metashape_control import is_markers, read_markers
from reconstruct.placing.odm_control import is_gcp_list, read_gcp_list

Heights = Literal["level", "ellipsoid"]

_READERS: tuple[tuple[Callable[[str], bool], Callable[[str], ForeignControl]], ...] = (
    (is_markers, read_markers),
    (is_gcp_list, read_gcp_list),
)
_MAX_BYTES = 200_000_000
_CONTROL_HEADER = (
    "kind", "name", "use", "latitude_deg", "longitude_deg", "north_m", "east_m", "depth_m",
    "height_m", "sigma_m", "sigma_vertical_m", "from", "to", "length_m",
)  # fmt: skip
_SHOWN_NAMES = 4


@dataclass(frozen=True, kw_only=True)
class ImportedControl:
    """What a workspace got."""

    points: int
    bars: int
    checks: int
    """Points and bars that only score the model."""
    picks: int
    pictures: int
    """Pictures in which points are picked."""

    def __str__(self) -> str:
        """One line."""
        held = f" ({self.checks} of them to check by)" if self.checks else ""
        bars = f", {self.bars} scale bar{'s' * (self.bars > 1)}" if self.bars else ""
        return f"{self.points} points{bars}{held}, {self.picks} picks in {self.pictures} pictures"


def import_control(
    workspace: Path,
    path: Path,
    *,
    sigma_m: float | None = None,
    sigma_vertical_m: float | None = None,
    heights: Heights = "level",
    overwrite: bool = False,
) -> ImportedControl:
    """Write `control.csv` and `picks.csv` from ODM's `gcp_list.txt` or Metashape's markers.

    Args:
        workspace: folder with finished `images/`.
        path: the file.
        sigma_m: standard deviation of north and of east where the file states none.
        sigma_vertical_m: of heights; as `sigma_m` when None.
        heights: what the file's heights count from: `level`, up from the level that depths of the
            survey count from, or `ellipsoid`, that of WGS 84.
        overwrite: replace files that are there.

    Raises:
        WorkspaceError: the file cannot be read or is of no known format, a point's sigma is not
            known, no picture of it is in the workspace, or a file would be replaced.
    """
    images = need_stage(workspace, "images", "import-images")
    targets = [workspace / CONTROL_FILE, workspace / PICKS_FILE]
    there = [target for target in targets if target.exists()]
    if there and not overwrite:
        raise WorkspaceError(f"{there[0]} is there: move it away, or give --overwrite")
    found = read_foreign(path)
    if heights == "ellipsoid" and not all(point.geodetic for point in found.points):
        raise WorkspaceError(f"{path}: is of a local grid, which has no ellipsoid: --heights level")
    points = _usable(path, found, sigma_m, sigma_vertical_m)
    bars = _bars(path, found, sigma_m)
    names = [record.image for record in read_manifest(images / "manifest.csv")]
    wanted = {point.name for point in points} | {end for bar in bars for end in bar.ends}
    rows, lost = _picks(found, wanted, names)
    if not rows:
        raise WorkspaceError(
            f"{path}: none of its {len(found.picks)} picks is in a picture of {images}: "
            f"{_some(lost)}"
            if lost
            else f"{path}: no point of known place is picked in a picture"
        )
    if lost:
        warn(
            f"{path}: {_some(lost)}: not in {images}, or there more than once; picks in them are "
            "left out"
        )
    for target, header, lines in (
        (
            targets[0],
            _CONTROL_HEADER,
            [*(_control_row(point, heights) for point in points), *map(_bar_row, bars)],
        ),
        (targets[1], ("image", "point", "x", "y", "sigma_px"), rows),
    ):
        write_csv(target, header, lines)
    for note in found.notes:
        warn(f"{path}: {note}")
    return ImportedControl(
        points=len(points),
        bars=len(bars),
        checks=[*(p.use for p in points), *(bar.use for bar in bars)].count("check"),
        picks=len(rows),
        pictures=len({row[0] for row in rows}),
    )


def read_foreign(path: Path) -> ForeignControl:
    """Read a file of any known format.

    Raises:
        WorkspaceError: it cannot be read or is of none.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise WorkspaceError(f"{path}: is larger than {_MAX_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    for fits, reader in _READERS:
        if fits(text):
            try:
                found = reader(text)
            except (ValueError, OverflowError) as error:
                raise WorkspaceError(f"{path}: {one_line(error)}") from None
            double = [n for n, k in Counter(p.name for p in found.points).items() if k > 1]
            if double:
                raise WorkspaceError(f"{path}: point {shown(double[0])} is there twice")
            return found
    raise WorkspaceError(
        f"{path}: neither a gcp_list.txt of ODM (its first line names the coordinate system) nor "
        "markers that Metashape exported as XML"
    )


def _usable(
    path: Path,
    foreign: ForeignControl,
    sigma_m: float | None,
    sigma_vertical_m: float | None,
) -> list[ForeignPoint]:
    """Points of known place, with sigmas; the others are named, unless bars end there."""
    placed = [point for point in foreign.points if all(map(math.isfinite, point.place))]
    ends = {end for bar in foreign.bars for end in bar.ends}
    left = [p.name for p in foreign.points if p not in placed and p.name not in ends]
    if left:
        warn(f"{path}: points without a whole place are left out: {_some(left)}")
    if not placed and not foreign.bars:
        raise WorkspaceError(f"{path}: no point has a place")
    found = []
    for point in placed:
        known = point.with_sigmas(sigma_m, sigma_vertical_m)
        if known is None:
            raise WorkspaceError(
                f"{path}: states no accuracy of point {shown(point.name)}: give --sigma, in metres"
            )
        found.append(known)
    return found


def _bars(path: Path, foreign: ForeignControl, sigma_m: float | None) -> list[ForeignBar]:
    """Bars with sigmas."""
    bars = [bar if bar.sigma_m else replace(bar, sigma_m=sigma_m) for bar in foreign.bars]
    unknown = [bar.name for bar in bars if bar.sigma_m is None]
    if unknown:
        raise WorkspaceError(
            f"{path}: states no accuracy of scale bar {shown(unknown[0])}: give --sigma, in metres"
        )
    return bars


def _picks(
    found: ForeignControl, wanted: set[str], names: Sequence[str]
) -> tuple[list[tuple[str, str, float, float, float]], list[str]]:
    """Rows of `picks.csv`, and pictures of the file that the workspace lacks or has twice."""
    by_stem: dict[str, list[str]] = {}
    for name in names:
        by_stem.setdefault(PurePosixPath(name).stem.lower(), []).append(name)
    rows, lost = [], []
    for pick in found.picks:
        image = _image(pick.picture, by_stem)
        if image is None:
            lost.append(pick.picture)
        elif pick.point in wanted:
            # Files count from the outer corner of the first pixel, `picks.csv` from its middle.
            rows.append((image, pick.point, pick.x_px - 0.5, pick.y_px - 0.5, pick.sigma_px))
    return rows, list(dict.fromkeys(lost))


def _image(picture: str, by_stem: dict[str, list[str]]) -> str | None:
    """The one picture of the workspace that has a file's name, which may have a folder."""
    parts = PurePosixPath(picture.replace("\\", "/"))
    # A label may lack the suffix and have dots of its own.
    for stem in dict.fromkeys((parts.stem, parts.name)):
        some = by_stem.get(safe_name(stem).lower(), [])
        if len(some) > 1:
            some = [n for n in some if PurePosixPath(n).parent.name == parts.parent.name]
        if len(some) == 1:
            return some[0]
    return None


def _control_row(point: ForeignPoint, heights: Heights) -> tuple[object, ...]:
    first, second, height = point.place
    geodetic = (first, second, None, None) if point.geodetic else (None, None, first, second)
    vertical = (-height, None) if heights == "level" else (None, height)
    return (
        "point", point.name, point.use, *geodetic, *vertical, point.sigma_m, point.sigma_vertical_m,
        *[None] * 3,
    )  # fmt: skip


def _bar_row(bar: ForeignBar) -> tuple[object, ...]:
    return ("bar", bar.name, bar.use, *[None] * 6, bar.sigma_m, None, *bar.ends, bar.length_m)


def _some(names: Sequence[str]) -> str:
    text = ", ".join(shown(name) for name in names[:_SHOWN_NAMES])
    return text + (f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else "")
