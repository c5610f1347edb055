"""A small made-up report with everything that a report can hold."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageOps

from alice_survey.kit.document import (
    Figure,
    Mesh,
    PictureLayer,
    Report,
    Scale,
    Section,
    ShapeLayer,
    SurveyMap,
    Table,
    Verdict,
)
from alice_survey.kit.figure import draw_figure
from alice_survey.kit.paper import with_stills

PIXEL_M = 0.004
TILE_PX = 256
VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
RUDE = '<img src=x onerror="alert(1)"> & </script><!--'
"""A text that would do harm if it were not escaped."""


def seafloor(width: int, height: int) -> Image.Image:
    """A picture with sand waves, stones and a checked corner."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:height, 0:width]
    shade = 0.5 + 0.16 * np.sin(x / 60 + 2 * np.sin(y / 130)) + 0.1 * np.sin(y / 41)
    shade += 0.05 * rng.standard_normal((height, width))
    for _ in range(60):
        at, radius = rng.uniform(0, (width, height)), rng.uniform(6, 28)
        shade[(x - at[0]) ** 2 + (y - at[1]) ** 2 < radius**2] *= 0.6
    colour = np.stack([shade * 190, shade * 180 + 14, shade * 140 + 30], axis=-1)
    return Image.fromarray(np.clip(colour, 0, 255).astype(np.uint8))


def encoded(picture: Image.Image, kind: str) -> bytes:
    held = io.BytesIO()
    picture.save(held, kind)
    return held.getvalue()


def picture_layer(
    name: str, title: str, picture: Image.Image, pixel_m: float = PIXEL_M, **more: Any
) -> PictureLayer:
    """A layer with its levels and tiles, the coarsest level fitting one tile."""
    levels = max(1, math.ceil(math.log2(max(picture.size) / TILE_PX)) + 1)
    tiles, sizes = {}, []
    for halvings in range(levels):
        pixel = pixel_m * 2**halvings
        width, height = (-(-side // 2**halvings) for side in picture.size)
        sizes.append((width, height, pixel, pixel))
        small = picture.resize((width, height), Image.Resampling.BOX)
        for x, y in np.ndindex(-(-width // TILE_PX), -(-height // TILE_PX)):
            left, top = x * TILE_PX, y * TILE_PX
            box = (left, top, min(left + TILE_PX, width), min(top + TILE_PX, height))
            tiles[f"{levels - 1 - halvings}/{x}/{y}"] = encoded(small.crop(box), "WEBP")
    about = f"About {title.lower()}."
    return PictureLayer(
        name=name, title=title, west_m=-2.2, north_m=2.1, pixel_m=pixel_m, width_px=picture.width,
        height_px=picture.height, tile_px=TILE_PX, levels=levels, tiles=tiles, sizes=sizes,
        **{"about": about, **more},
    )  # fmt: skip


def sketch_map(side: int = 1100) -> SurveyMap:
    floor = seafloor(side, side - 90)
    depths = floor.convert("L").resize((side // 2, (side - 90) // 2))
    dem = ImageOps.colorize(depths, VIRIDIS[0], VIRIDIS[-1], mid=VIRIDIS[2])
    seen = Image.new("RGBA", dem.size, (230, 159, 0, 0))
    seen.paste((230, 159, 0, 120), (0, 0, dem.width // 3, dem.height))
    coarse = 2 * PIXEL_M
    rows = np.linspace(-1.6, 1.6, 7)
    stations = [(e, n) for n in rows for e in np.linspace(-1.7, 1.7, 9)]
    wide, high = 0.42, 0.34
    return SurveyMap(
        unit="m",
        origin="(0, 0) is the datum, 59.123456° N 5.123456° E.",
        layers=[
            picture_layer(
                "mosaic", "Mosaic", floor, shown=True,
                about="Orthomosaic, 4 mm a pixel, colours as under white light.",
            ),
            picture_layer(
                "dem", "Height", dem, coarse,
                scale=Scale(label="height above the datum, m", low=-15.32, high=-14.87,
                            colours=VIRIDIS),
            ),
            picture_layer(
                "sigma", "Its sigma", dem.rotate(180), coarse,
                scale=Scale(label="sigma of the height, mm", low=0.2, high=3.4, colours=VIRIDIS),
            ),
            picture_layer("few", "Seen in fewer than 3 pictures", seen, coarse, base=False),
            ShapeLayer(
                name="area", title="Survey area", about="As asked for.", kind="polygon",
                shapes=[[(-2, -1.8), (2, -1.8), (2, 1.8), (-2, 1.8)]], colour="#d55e00",
                dashed=True,
            ),
            ShapeLayer(
                name="footprints", title="Footprints", about="Of the left camera.",
                kind="polygon", colour="#cc79a7", shown=False,
                shapes=[
                    [(e - wide, n - high), (e + wide, n - high), (e + wide, n + high),
                     (e - wide, n + high)]
                    for e, n in stations
                ],
                texts=[f"Station {i}" for i in range(len(stations))],
            ),
            ShapeLayer(
                name="plan", title="Planned lines", about="", kind="line", colour="#e69f00",
                dashed=True, shapes=[[(-1.9, float(n)), (1.9, float(n))] for n in rows],
                texts=[f"Line {i}" for i in range(len(rows))],
            ),
            ShapeLayer(
                name="points", title="Check points", about="Left out of the adjustment.",
                kind="point", shapes=[[(0.6, -0.533)], [(-1.2, 1.0)]], colour="#009e73",
                texts=["Point A: 1.2 mm east, 0.4 mm north, 2.2 mm up", f"Point B {RUDE}"],
            ),
        ],
    )  # fmt: skip


def sketch_mesh(folder: Path) -> Mesh:
    """A hilly sheet with a texture; east is x, up is y, south is z."""
    cells = 60
    x, z = np.meshgrid(np.linspace(-2, 2, cells), np.linspace(-1.6, 1.6, cells))
    y = 0.25 * np.sin(2 * x) * np.cos(3 * z)
    at = np.arange(cells * cells).reshape(cells, cells)
    quads = (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:])
    a, b, c, d = (corner.ravel() for corner in quads)
    sheet = trimesh.Trimesh(
        vertices=np.stack([x, y, z], axis=-1).reshape(-1, 3),
        faces=np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]),
        process=False,
    )
    uv = np.stack([(x + 2) / 4, (1.6 - z) / 3.2], axis=-1).reshape(-1, 2)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=seafloor(512, 410), metallicFactor=0.0, roughnessFactor=1.0
    )
    sheet.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    path = folder / "sketch.glb"
    path.write_bytes(sheet.export(file_type="glb", include_normals=False))
    return Mesh(
        glb=path,
        about=f"{len(sheet.faces)} triangles, 4.0 m by 3.2 m.",
        still=Figure(
            png=encoded(seafloor(640, 400), "PNG"),
            title="Mesh",
            alt="The sea floor from the south: two rows of sand waves.",
            shows="The mesh from the south.",
        ),
    )


def sketch_figure(title: str, width: int = 1210, height: int = 629) -> Figure:
    """Drawn as the real ones are."""
    rng = np.random.default_rng(3)

    def paint(axes: Sequence[Any]) -> None:
        axes[0].hist(rng.standard_normal(4000), 60, color="#0072b2")
        axes[0].set(xlabel="residual, px", ylabel="observations")

    return draw_figure(
        paint,
        height / 130,
        width_in=width / 130,
        title=title,
        alt="A histogram of residuals, as wide as one pixel, symmetric about zero.",
        shows="How far the points of the model fall from where the pictures saw them.",
        good="Symmetric about zero, hardly any beyond 3 px.",
        otherwise="Calibrate the rig again, or refine it from the survey's own pictures.",
    )


def sketch_report(folder: Path, side: int = 1100) -> Report:
    """A report with a map, a mesh, figures and tables.

    Args:
        folder: where the mesh is written.
        side: of the mosaic, px.
    """
    wide = Table(
        title="Cameras",
        header=["picture", *(f"{axis} sigma, mm" for axis in ("east", "north", "up")),
                "turn, mrad", "points seen", "of the residuals, px", "remark"],
        rows=[
            [f"left/{i:06d}.png", f"{0.1 * i + 0.213:.3f}", "0.198", "0.412", "0.031 ± 0.004",
             f"{1200 + 31 * i}", "0.31", "good" if i % 2 else "few points to the north"]
            for i in range(14)
        ],
    )  # fmt: skip
    return Report(
        title="Brattholmen demo survey",
        subtitle="Imaged 4 May 2026 at 59.123456° N 5.123456° E, 15 m deep; report of 5 May 2026",
        summary={
            "What was mapped": "23.2 m² of sea floor in 116 pictures from 58 stereo stations, "
            "all of them placed; 99.4 % of the area is seen in three pictures or more.",
            "How well": "Heights are good to 1.1 mm (one sigma) and lengths to 0.2 %.",
            "What to do next": "Nothing must be repeated.",
        },
        facts=[("area", "23.2 m²"), ("pictures placed", "116 of 116"), ("scale", "0.2 %")],
        verdicts=[
            Verdict(level="bad", text="Check point B is 12 mm off: its mark was moved."),
            Verdict(level="look", text="0.6 % of the area is seen in fewer than three pictures."),
            Verdict(level="good", text="All pictures are placed."),
        ],
        sections=[
            Section(name="map", title="Where it was flown", scene="map",
                    text=["The plan asked for 7 lines 0.53 m apart; they were flown within 3 cm."]),
            Section(name="mesh", title="The sea floor from all sides", scene="mesh"),
            Section(
                name="residuals", title="How well the pictures agree",
                text=["Every point is seen in 4.1 pictures on average.", f"Escaped: {RUDE}"],
                figures=[sketch_figure("Residuals"), sketch_figure("Doming", 1320, 900)],
                tables=[wide],
            ),
            Section(
                name="versions", title="How to make it again",
                tables=[
                    Table(title="Versions", header=["package", "version"],
                          rows=[["numpy", "2.1.0"], ["opencv-contrib-python-headless", "4.10.0"]]),
                    Table(title="Settings", header=["setting", "value"],
                          rows=[["plan.altitude_m", "2"],
                                ["workspace", "/a/very/long/path" * 9]]),
                ],
            ),
        ],
        map=with_stills(sketch_map(side)),
        mesh=sketch_mesh(folder),
    )  # fmt: skip
