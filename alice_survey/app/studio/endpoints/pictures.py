"""The studio's pictures: which show a place, picks and control in them, lengths between points."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from alice_survey.app.studio.endpoints.base import (
    Call,
    Content,
    Endpoint,
    KeptValue,
    Studio,
    TileRequest,
)
from alice_survey.app.studio.files import STAGES_MADE, Workspace
from alice_survey.core.artefacts import read_csv, read_stage
from alice_survey.core.config import Config
from alice_survey.core.errors import AliceError, ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord, read_manifest
from alice_survey.core.records import MappingRecord
from reconstruct.picking.lengths import Lengths, point_residuals, preview_control
from reconstruct.picking.matching import refine
from reconstruct.picking.registered import RegisteredPictures, Sight
from reconstruct.picking.surface import ModelSurface, SurfacePlace
from reconstruct.pictures.undistorted import Colour, read_colour
from reconstruct.placing.control_command import note_scale
from reconstruct.placing.control_points import (
    CONTROL_FILE,
    MARKERS_FILE,
    PICKS_FILE,
    Control,
    Pick,
    TriangulatedPoint,
    read_control,
    read_picks,
    save_control,
    save_picks,
    table_token,
    triangulate_picks,
)

TILE_PX = 512
_MAX_BYTES = 500 << 20
"""Of decoded pictures that are kept; the last one is, however large."""
_QUALITY = 95


class TakenPictures:
    """Pictures of a workspace's `images/`; threads may share it."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace; it need not have any."""
        self._workspace = workspace
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[str, str], Colour] = OrderedDict()
        self._records = lru_cache(1)(self._read_records)

    def records(self) -> dict[str, ImageRecord]:
        """What the manifest says, by name; nothing where there are no pictures yet."""
        folder = self._workspace.folder / "images"
        if read_stage(folder) is None or not self._workspace.has("images/manifest.csv"):
            return {}
        return self._records(self._workspace.token("images/manifest.csv"))

    def _read_records(self, _: str) -> dict[str, ImageRecord]:
        rows = read_manifest(self._workspace.folder / "images" / "manifest.csv")
        return {record.image: record for record in rows}

    def path(self, name: str) -> Path:
        """The file of a picture.

        Raises:
            FileNotFoundError: the manifest names no such picture, or the file is a link or not
                there.
        """
        if name not in self.records():
            raise FileNotFoundError(name)
        return self._workspace.file(("images", *name.split("/")))

    def token(self, name: str) -> str:
        """Token of a picture's file; see `path`."""
        self.path(name)
        return self._workspace.token(f"images/{name}")

    def colour(self, name: str) -> Colour:
        """(H, W, 3) BGR as taken.

        Raises:
            ImageError: it cannot be decoded.
            FileNotFoundError: see `path`.
        """
        key = name, self.token(name)  # a changed file is read again
        with self._lock:  # of several that request it, one decodes
            if key not in self._kept:
                self._kept[key] = read_colour(self.path(name))
                kept = self._kept.values()
                while len(kept) > 1 and sum(picture.nbytes for picture in kept) > _MAX_BYTES:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]

    def grey(self, name: str) -> NDArray[np.uint8]:
        """(H, W) as taken; see `colour`."""
        return np.asarray(cv2.cvtColor(self.colour(name), cv2.COLOR_BGR2GRAY), np.uint8)

    def size(self, name: str) -> tuple[int, int]:
        """Width and height, without decoding the picture where its header says so."""
        from PIL import Image

        with Image.open(self.path(name)) as image:
            return image.size

    def tile(self, name: str, halvings: int, column: int, row: int) -> bytes:
        """A tile as WebP, each of its pixels the mean of those of the picture that it covers.

        Args:
            name: of the picture.
            halvings: 0 is full resolution.
            column: of the tile.
            row: of the tile.

        Raises:
            FileNotFoundError: no such tile.
            ImageError: the picture cannot be decoded.
        """
        picture = self.colour(name)
        side = TILE_PX << halvings
        part = picture[row * side : (row + 1) * side, column * side : (column + 1) * side]
        if halvings >= levels_of(picture.shape[1], picture.shape[0]) or not part.size:
            raise FileNotFoundError(name)
        if halvings:
            size = tuple(-(-length >> halvings) if length else 0 for length in part.shape[1::-1])
            part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        options = [cv2.IMWRITE_WEBP_QUALITY, _QUALITY]
        data: bytes = cv2.imencode(".webp", part, options)[1].tobytes()
        return data


def levels_of(width: int, height: int) -> int:
    """Levels of tiles, halved until one tile holds the picture."""
    return max(1, int(np.ceil(np.log2(max(width, height) / TILE_PX))) + 1)


T = TypeVar("T")
_MAX_SEEING = 60
_MODEL = ("sparse/cameras.json", "sparse/model/images.bin", "sparse/frame.json")

Name = Annotated[str, Field(min_length=1, max_length=1000)]
Pixel = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class _AskedPick(Config):
    """Pixels count from 0 at the middle of the first, as in `picks.csv`."""

    image: Name
    point: Annotated[str, Field(max_length=200)] = "point"
    x: Pixel
    y: Pixel
    sigma_px: Annotated[float, Field(gt=0, le=100)] = 0.5
    matched_to: Annotated[str, Field(max_length=1000)] = ""

    @property
    def pick(self) -> Pick:
        return Pick(
            image=self.image, point=self.point, x_px=self.x + 0.5, y_px=self.y + 0.5,
            sigma_px=self.sigma_px, matched_to=self.matched_to,
        )  # fmt: skip


class _List(Config):
    find: str = ""
    """Part of the names."""
    count: int = Field(100, ge=0, le=500)


class _Seeing(Config):
    """A place of the surface, or a pixel of a picture that shows it."""

    n: float | None = None
    e: float | None = None
    image: str | None = None
    x: Pixel = 0.0
    y: Pixel = 0.0
    count: int = Field(24, ge=0, le=_MAX_SEEING)


class _Refine(Config):
    pick: _AskedPick
    images: Annotated[list[Name], Field(max_length=_MAX_SEEING)] | None = None
    """The best of those that see the point where they are not named."""


class _SaveRequest(Config):
    token: str
    """Of the file that the page has seen."""
    page: str = ""
    """Names the page: what it saves is no news to it."""


class _SavePicks(_SaveRequest):
    points: Annotated[list[Name], Field(max_length=1000)]
    picks: Annotated[list[_AskedPick], Field(max_length=20_000)]


class _SaveControl(_SaveRequest):
    rows: Annotated[
        list[dict[Name, Annotated[str, Field(max_length=1000)]]], Field(max_length=5000)
    ]
    names: Annotated[tuple[tuple[Name, Name], ...], Field(max_length=5000)] = ()


class _AskedSpot(Config):
    picks: Annotated[list[_AskedPick], Field(min_length=1, max_length=200)]


class _AskedEnds(Config):
    """Two points, each by the picks of it."""

    first: Annotated[list[_AskedPick], Field(min_length=1, max_length=200)]
    second: Annotated[list[_AskedPick], Field(min_length=1, max_length=200)]


class _AskedScale(_AskedEnds):
    length_m: Annotated[float, Field(gt=0)]


class _OpenModel:
    """A registered model, as long as its files are what they were."""

    def __init__(self, studio: Studio) -> None:
        folder = studio.workspace.folder
        self.pictures = RegisteredPictures.read(folder)
        self.surface = ModelSurface(folder)
        self.lengths = Lengths(folder, self.pictures)
        self.lock = threading.Lock()


class _Tab:
    def __init__(self, studio: Studio) -> None:
        self._studio = studio
        self._taken, self._writing = TakenPictures(studio.workspace), threading.Lock()
        self._model = KeptValue(lambda: _OpenModel(studio))

    # ---- Pictures ----

    def list_pictures(self, call: Call) -> dict[str, Any]:
        """Pictures in the order of the manifest, and whether the model has them."""
        asked = call.ask(_List)
        words = asked.find.lower()
        found = [name for name in self._taken.records() if words in name.lower()]
        known = self._read_model().pictures if self._has_model() else ()
        return {
            "total": len(found),
            "pictures": [
                {"name": name, "registered": name in known} for name in found[: asked.count]
            ],
        }

    def picture(self, call: Call) -> dict[str, Any]:
        """Size and tiles of a picture."""
        name = call.path["name"]
        width, height = self._taken.size(name)
        return {
            "name": name, "width": width, "height": height, "tile": TILE_PX,
            "levels": levels_of(width, height), "token": self._taken.token(name),
        }  # fmt: skip

    def tile(self, call: Call) -> Content:
        """A tile of a picture as taken, WebP; level 0 is the coarsest."""
        asked = call.ask(TileRequest)
        token = self._taken.token(asked.name)
        halvings = levels_of(*self._taken.size(asked.name)) - 1 - asked.level
        if halvings < 0:
            raise FileNotFoundError(asked.name)
        data = self._taken.tile(asked.name, halvings, asked.x, asked.y)
        return Content(
            data=data, kind="image/webp", tag=f"{token}-{asked.level}-{asked.x}-{asked.y}"
        )

    def seeing(self, call: Call) -> dict[str, Any]:
        """Pictures that see a place of the surface, the best first."""
        asked, model = call.ask(_Seeing), self._read_model()
        if asked.image is not None:
            place = self._surface_at(model, asked.image, asked.x + 0.5, asked.y + 0.5)
        elif asked.n is None or asked.e is None:
            raise AliceError("the request needs a place, n and e, or a pixel of an image")
        else:
            place = model.surface.below(asked.n, asked.e)
        seen, hidden = _unhidden(model, place)
        return {
            "place": {"n": place.point[0], "e": place.point[1], "down": place.point[2]},
            "total": len(seen), "hidden": hidden,
            "pictures": [
                {
                    "name": one.image, "x": one.pixel[0] - 0.5, "y": one.pixel[1] - 0.5,
                    "off_nadir_deg": float(np.degrees(one.off_nadir_rad)),
                }
                for one in seen[: asked.count]
            ],
        }  # fmt: skip

    @staticmethod
    def _surface_at(model: _OpenModel, image: str, x_px: float, y_px: float) -> SurfacePlace:
        size = model.pictures.warp(image).size_px
        if not (0 <= x_px <= size[0] and 0 <= y_px <= size[1]):
            raise ReconstructionError(
                f"{image}: {x_px - 0.5:g}, {y_px - 0.5:g} is outside its {size[0]} x {size[1]} px"
            )
        start, way = model.pictures.picture(image).ray(np.array([x_px, y_px]))
        if not np.isfinite(start + way).all():
            raise ReconstructionError(f"{image}: that pixel is beyond the reach of the lens")
        return model.surface.met_by(start, way)

    # ---- Picks ----

    def refine(self, call: Call) -> dict[str, Any]:
        """A pick found again in other pictures; nothing is written."""
        asked, model = call.read(_Refine), self._read_model()
        pick = asked.pick.pick
        place = self._surface_at(model, pick.image, pick.x_px, pick.y_px)
        images = asked.images
        if images is None:
            images = [s.image for s in _unhidden(model, place)[0]][: _MAX_SEEING // 3]
        for image in images:
            model.pictures.row(image)
        found = refine(pick, images, place, model.pictures.picture, self._taken.grey)
        return {
            "picks": [_pick_json(one) for one in found.picks],
            "refused": [{"name": one.image, "why": one.why} for one in found.refused],
        }

    def picks(self, call: Call) -> dict[str, Any]:
        """All picks, the points that they show, residuals, and what control says to them."""
        folder = self._studio.workspace.folder
        own, coded = self._read(PICKS_FILE, read_picks), self._read(MARKERS_FILE, read_picks)
        picks = [*(own or []), *(coded or [])]
        control = self._read(CONTROL_FILE, read_control) or Control()
        model = self._read_model() if self._has_model() else None
        found_points: dict[str, TriangulatedPoint] = {}
        lost: dict[str, str] = {}
        off: list[Array | None] = [None] * len(picks)
        if model is not None:
            known = {p.image for p in picks if p.image in model.pictures}
            cameras = {name: model.pictures.picture(name) for name in known}
            found_points, lost = triangulate_picks(picks, cameras)
            off = point_residuals(found_points, picks, model.pictures)
        points: dict[str, dict[str, Any]] = {}
        for number, (pick, miss) in enumerate(zip(picks, off, strict=True)):
            position = found_points.get(pick.point)
            about = points.setdefault(
                pick.point,
                {
                    "name": pick.point,
                    "picks": [],
                    "why": lost.get(pick.point, ""),
                    "coded": number >= len(own or []),
                    "position": None if position is None else _position_json(position),
                },
            )
            left_out = position is not None and pick.image in position.left_out
            about["picks"].append(
                {
                    **_pick_json(pick),
                    "left_out": left_out,
                    "residual": None if miss is None else miss.tolist(),
                }
            )
        mapped = MappingRecord.read_existing(folder / MappingRecord.path)
        return {
            "token": table_token(folder / PICKS_FILE),
            "points": list(points.values()),
            "control": None if model is None
            else preview_control(control, found_points, lost, model.pictures.frame),
            "unit": "m" if model is None else model.pictures.frame.unit,
            "scaled_by_rig": mapped is not None and mapped.scaled,
        }  # fmt: skip

    def save(self, call: Call) -> dict[str, Any]:
        """Replace the picks of some points in `picks.csv`."""
        asked = call.read(_SavePicks)
        records = self._taken.records()
        strange = [p.image for p in asked.picks if p.image not in records]
        if strange:
            raise AliceError(f"{strange[0]!r} is no picture of this survey")
        picks = [one.pick for one in asked.picks]
        return self._write_file(
            PICKS_FILE, asked.page,
            lambda path: save_picks(path, asked.token, picks, set(asked.points)),
        )  # fmt: skip

    # ---- Control ----

    def control(self, call: Call) -> dict[str, Any]:
        """The rows of `control.csv` as they stand."""
        path = self._studio.workspace.folder / CONTROL_FILE
        rows = []
        if self._read(CONTROL_FILE, read_control) is not None:
            table = read_csv(path, ("kind", "name", "use"), fault=WorkspaceError)[1]
            rows = [
                {"line": line, **{name: cell for name, cell in row.items() if cell}}
                for line, row in table
                if not next(iter(row.values())).startswith("# ")
            ]
        return {"token": table_token(path), "rows": rows}

    def save_control(self, call: Call) -> dict[str, Any]:
        """Replace rows of `control.csv` by kind and name."""
        asked = call.read(_SaveControl)
        return self._write_file(
            CONTROL_FILE, asked.page,
            lambda path: save_control(path, asked.token, asked.rows, asked.names),
        )  # fmt: skip

    # ---- Spots and lengths ----

    def position(self, call: Call) -> dict[str, Any]:
        """The point that picks show and how far each misses it; nothing is written."""
        asked, model = call.read(_AskedSpot), self._read_model()
        picks = [p.pick for p in asked.picks]
        found = model.lengths.target(picks)
        off = point_residuals({p.point: found for p in picks}, picks, model.pictures)
        return {
            "position": _position_json(found),
            "residuals": [
                {
                    "image": pick.image, "left_out": pick.image in found.left_out,
                    "residual": None if miss is None else miss.tolist(),
                }
                for pick, miss in zip(picks, off, strict=True)
            ],
        }  # fmt: skip

    def length(self, call: Call) -> dict[str, Any]:
        """The distance between two points and its sigma; nothing is written."""
        asked, model = call.read(_AskedEnds), self._read_model()
        with model.lock:
            found = model.lengths.between(
                [p.pick for p in asked.first], [p.pick for p in asked.second]
            )
        return {
            "value": found.value, "sigma": found.sigma, "unit": model.pictures.frame.unit,
            "sigma_picks": found.sigma_picks, "sigma_poses": found.sigma_poses,
            "sigma_scale": found.sigma_scale,
        }  # fmt: skip

    def scale(self, call: Call) -> dict[str, Any]:
        """Note a known length in `scale.json`."""
        asked, model = call.read(_AskedScale), self._read_model()
        ends = [[p.pick for p in one] for one in (asked.first, asked.second)]
        places = [model.lengths.target(picks).model for picks in ends]
        names = [
            "+".join(f"{p.image}:{p.x},{p.y}" for p in one) for one in (asked.first, asked.second)
        ]
        with self._writing, self._studio.only_writer():
            line = note_scale(
                self._studio.workspace.folder, (names[0], names[1]), places[0], places[1],
                asked.length_m,
            )  # fmt: skip
        self._studio.publish("picks", {"scale": True})
        return {"line": line}

    # ---- What all use ----

    def _write_file(self, name: str, page: str, write: Callable[[Any], str]) -> dict[str, Any]:
        path = self._studio.workspace.folder / name
        if path.is_symlink():
            raise AliceError(f"{name} is a link: the studio changes files of the survey alone")
        with self._writing, self._studio.only_writer():
            try:
                token = write(path)
            except WorkspaceError as error:  # a row of the page, or of the file by its line
                raise AliceError(str(error)) from None
        self._studio.publish("picks", {"file": name, "token": token, "page": page})
        return {"token": token}

    def _read(self, name: str, read: Callable[[Any], T]) -> T | None:
        path = self._studio.workspace.folder / name
        if path.is_symlink() or not path.is_file():
            return None
        return read(path)

    def _has_model(self) -> bool:
        return all(self._studio.workspace.has(path) for path in _MODEL)

    def _read_model(self) -> _OpenModel:
        workspace = self._studio.workspace
        if not self._has_model():
            raise AliceError("no model yet: run 'alice-survey reconstruct' first")
        return self._model.of(workspace.state((*STAGES_MADE, *_MODEL, "dense/dem.tif")))


def _unhidden(model: _OpenModel, place: SurfacePlace) -> tuple[list[Sight], int]:
    """Pictures that see a place with nothing between, and how many it is hidden from."""
    found = model.pictures.seeing(place.point, place.normal)[: 4 * _MAX_SEEING]
    centres = np.array([model.pictures.centres[model.pictures.row(s.image)] for s in found])
    hidden = model.surface.hides(place, centres.reshape(-1, 3))
    return [s for s, out in zip(found, hidden, strict=True) if not out], int(hidden.sum())


def _pick_json(pick: Pick) -> dict[str, Any]:
    return {
        "image": pick.image, "point": pick.point, "x": pick.x_px - 0.5, "y": pick.y_px - 0.5,
        "sigma_px": pick.sigma_px, "matched_to": pick.matched_to,
    }  # fmt: skip


def _position_json(position: TriangulatedPoint) -> dict[str, Any]:
    return {
        "n": position.model[0], "e": position.model[1], "down": position.model[2],
        "sigma": np.sqrt(np.diag(position.covariance)).tolist(), "views": position.views,
        "rms_px": position.rms_px,
    }  # fmt: skip


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """Pictures, picks, control, lengths and scale."""
    tab = _Tab(studio)
    return (
        Endpoint(path="/api/pictures", answer=tab.list_pictures),
        Endpoint(path="/api/pictures/seeing", answer=tab.seeing),
        Endpoint(path="/api/pictures/{name:path}/about", answer=tab.picture),
        Endpoint(path="/api/pictures/{name:path}/tile/{level}/{x}/{y}.webp", answer=tab.tile),
        Endpoint(path="/api/picks", answer=tab.picks),
        Endpoint(path="/api/picks/refine", answer=tab.refine, method="POST", computes=True),
        Endpoint(path="/api/picks/save", answer=tab.save, method="POST", writes=True,
                 max_bytes=8 << 20),
        Endpoint(path="/api/picks/position", answer=tab.position, method="POST", computes=True),
        Endpoint(path="/api/picks/length", answer=tab.length, method="POST", computes=True),
        Endpoint(path="/api/control", answer=tab.control),
        Endpoint(path="/api/control/save", answer=tab.save_control, method="POST", writes=True,
                 max_bytes=8 << 20),
        Endpoint(path="/api/scale", answer=tab.scale, method="POST", writes=True),
    )  # fmt: skip
