"""The paper's tables of coefficients next to values from shape: text, CSV, JSON, figure."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import ConfigError
from alice_survey.core.text_table import text_table
from alice_survey.kit.figure import (
    Axes,
    Polygon,
    Rectangle,
    Sheet,
    check_figure_path,
    figure_style,
    new_figure,
    save_figure,
)
from alice_survey.sim.vehicle.files import vehicle_from
from alice_survey.sim.vehicle.hydrodynamics import added_mass, drag
from alice_survey.sim.vehicle.hydrodynamics.entrained import Entrained, entrained_water
from alice_survey.sim.vehicle.hydrodynamics.geometry import ALICE, Geometry
from alice_survey.sim.vehicle.hydrodynamics.paper_tables import TABLES, PaperRow
from alice_survey.sim.vehicle.hydrodynamics.parts import Flow, estimate, part_coefficients, parts
from alice_survey.sim.vehicle.propulsion import Thruster

CLOSE_PERCENT, NEAR_PERCENT = 1.0, 5.0
"""Differences up to which a row counts as reproduced, and as near."""
_EQUATIONS = {
    "X_udot": "-alpha_0 / (2 - alpha_0) m_e - rho pi/4 w_m^2 h_m",
    "Y_vdot": "-int rho pi r^2 dx - rho pi/4 c_m^2 h_m",
    "Z_wdot": "-int rho pi r^2 dx; b^2 - r^2 + r^4/b^2 at the mounts",
    "Y_rdot": "= N_vdot",
    "N_vdot": "-int x dm, strips of Y_vdot",
    "N_rdot": "-int x^2 dm, strips of Y_vdot",
    "M_wdot": "int x dm, strips of Z_wdot",
    "M_qdot": "-int x^2 dm, strips of Z_wdot",
    "K_vdot": "int z dm, mast in sway",
    "K_pdot": "-int (y^2 + z^2) dm, mast, pods, fins",
    "N_pdot": "int x z dm, mast in sway",
    "M_udot": "-int z dm, mast in surge",
    "X_uu": "-rho/2 A (0.44 d/l + 4 C_f (l/d + sqrt(d/l))); strut; tunnels",
    "Y_vv": "-rho/2 1.2 k_1(l/d) int 2r dx; mast as a plate",
    "Z_ww": "-rho/2 1.2 k_1(l/d) int 2r dx; mounts as plates",
    "N_vv": "-int x dD, strips of Y_vv",
    "M_ww": "int x dD, strips of Z_ww",
    "N_rr": "-int |x|^3 dD, strips of Y_vv",
    "M_qq": "-int |x|^3 dD, strips of Z_ww",
    "K_vv": "int z dD, mast in sway",
    "K_pp": "-int |z|^3 dD of the mast - |y|^3 D of pods, mounts",
    "K_rr": "int z x |x| dD, mast in sway",
    "M_uu": "-int z dD, mast in surge",
    "Y_uv": "-rho/2 d^2 0.003 (180/pi) l/d",
    "Z_uw": "-rho/2 d^2 0.003 (180/pi) l/d",
    "M_uw": "-Z_uw x_cp, x_cp = x_n - 0.65 l",
    "N_uv": "Y_uv x_cp, x_cp = x_n - 0.65 l",
}  # fmt: skip
"""By SNAME name, dm and dD being the positive mass and drag of an element. C_f is ITTC-57's."""

_HULL_EQUATIONS = {
    "X_uu": "-rho/2 A (0.44 d/l + 4 C_f (l/d + sqrt(d/l)))",
    "Y_vv": "-rho/2 1.2 k_1(l/d) int 2r dx",
    "Z_ww": "-rho/2 1.2 k_1(l/d) int 2r dx",
}


@dataclass(frozen=True, kw_only=True)
class CoefficientRow:
    """One row of the paper and the value computed for it."""

    table: str
    coefficient: str
    part: str
    printed: float
    paper: float
    """Printed value with its sign corrected."""
    computed: float
    difference_percent: float
    """Difference relative to the paper's size; positive is a greater value."""
    mark: str
    """`reproduced` within 1 %, `near` within 5 %, else `no`."""
    paper_other: float | None
    """CFD or calibrated value."""
    factor: float | None
    """Calibration factor as printed, table V."""
    equation: str


def coefficient_rows() -> tuple[CoefficientRow, ...]:
    """Every row of the paper's three tables."""
    whole = estimate(ALICE).values
    hull = next(part_coefficients(p) for p in parts(ALICE, Flow()) if p.name == "hull")
    rows = []
    for row in TABLES:
        computed = (hull if row.part == "hull" else whole)[row.coefficient]
        difference = 100.0 * (computed - row.value) / abs(row.value)
        rows.append(
            CoefficientRow(
                table=row.table,
                coefficient=row.coefficient,
                part=row.part,
                printed=row.printed,
                paper=row.value,
                computed=computed,
                difference_percent=difference,
                mark=_mark(difference),
                paper_other=row.other,
                factor=row.factor,
                equation=_equation(row),
            )
        )
    return tuple(rows)


def _mark(difference_percent: float) -> str:
    if abs(difference_percent) <= CLOSE_PERCENT:
        return "reproduced"
    return "near" if abs(difference_percent) <= NEAR_PERCENT else "no"


def _equation(row: PaperRow) -> str:
    whole = _EQUATIONS[row.coefficient]
    return _HULL_EQUATIONS.get(row.coefficient, whole) if row.part == "hull" else whole


_HULL, _EDGE, _WATER, _PART, _THRUST = "#f4ead5", "#34495e", "#cfe3f1", "#b9c4cc", "#c0392b"
_COLOURS = {"reproduced": "#1e8449", "near": "#82b74b", "no": "#d68910"}
_SIZE_IN, _LEFT_IN, _WIDTH_IN = (15.2, 8.9), 0.75, 8.5
_X, _SIDE, _TOP = (-1.0, 1.15), (0.26, -0.40), (0.26, -0.26)
"""Limits shown, metres."""
_FLOOR, _CEILING = 0.1, 10.0
"""Least and greatest ratio that the axis of ratios holds."""


@figure_style()
def draw_coefficients(path: Path, geometry: Geometry, rows: Sequence[CoefficientRow]) -> None:
    """Draw side and top view, mass and drag along the hull, and the ratio to the paper's values.

    Args:
        path: PNG, PDF or SVG.
        geometry: geometry of a vehicle that is known by name.
        rows: rows of the comparison.

    Raises:
        ConfigError: the suffix is not one of the three.
    """
    check_figure_path(path)
    craft = vehicle_from(geometry.name)
    thrusters = craft.thrusters
    inside = entrained_water(geometry, craft.rigid_body.buoyancy_kg, craft.density_kg_m3)
    figure = new_figure(_SIZE_IN[1], _SIZE_IN[0], layout="none")
    side, top = (_view(figure, bottom, limits) for bottom, limits in ((5.6, _SIDE), (2.9, _TOP)))
    along = figure.add_axes((*_fraction(_LEFT_IN, 0.65), *_fraction(_WIDTH_IN, 1.75)))
    along.set_xlim(_X)
    ratios = figure.add_axes((*_fraction(11.0, 1.1), *_fraction(3.8, 7.0)))
    _draw_side(side, geometry, inside, thrusters)
    _draw_top(top, geometry, inside, thrusters)
    _draw_strips(along, geometry, inside)
    _draw_ratios(ratios, rows)
    outline = geometry.outline
    figure.suptitle(
        f"{geometry.name.upper()}: {outline.length_m:.2f} x {outline.diameter_m:.2f} m as the "
        f"paper's tables imply, {1e3 * geometry.envelope_volume_m3:.0f} L, "
        f"{inside.mass_kg:.0f} kg of water inside",
        fontsize=13, y=0.992,
    )  # fmt: skip
    save_figure(figure, path, dpi=120)


def _fraction(x_in: float, y_in: float) -> tuple[float, float]:
    return x_in / _SIZE_IN[0], y_in / _SIZE_IN[1]


def _view(figure: Sheet, bottom_in: float, limits: tuple[float, float]) -> Axes:
    """Axes to one scale: all views have the same x above each other."""
    height = (limits[0] - limits[1]) * _WIDTH_IN / (_X[1] - _X[0])
    axes = figure.add_axes((*_fraction(_LEFT_IN, bottom_in), *_fraction(_WIDTH_IN, height)))
    axes.set_xlim(_X)
    axes.set_ylim(limits)
    return axes


def _hull(axes: Axes, geometry: Geometry, inside: Entrained) -> None:
    x, r = np.array(geometry.outline.x_m), np.array(geometry.outline.radius_m)
    shape = np.column_stack([[*x, *x[::-1]], [*r, *-r[::-1]]])
    hull = Polygon(shape, facecolor=_HULL, edgecolor=_EDGE, lw=1.4, zorder=2)
    axes.add_patch(hull)
    for low, high in (
        (geometry.outline.tail_x_m, inside.tail_to_x_m),
        (inside.nose_from_x_m, geometry.outline.nose_x_m),
    ):
        wet = Rectangle((low, -0.2), high - low, 0.4, facecolor=_WATER, edgecolor="none", zorder=3)
        axes.add_patch(wet)
        wet.set_clip_path(hull)
    axes.add_patch(Polygon(shape, fill=False, edgecolor=_EDGE, lw=1.4, zorder=4))
    axes.plot(0, 0, marker="+", color="black", ms=11, mew=1.6, zorder=9)


def _arrows(axes: Axes, thrusters: Sequence[Thruster], down: int) -> None:
    """Thrusters whose push lies in the plane as arrows, others as rings; `down` is 1 or 2."""
    for thruster in thrusters:
        x, y = thruster.position_body_m[0], thruster.position_body_m[down]
        ahead, across = thruster.direction_body[0], thruster.direction_body[down]
        if ahead or across:
            axes.annotate(
                "", (x + 0.15 * ahead, y + 0.15 * across), (x, y), zorder=8,
                arrowprops={"arrowstyle": "-|>", "color": _THRUST, "lw": 1.8},
            )  # fmt: skip
        axes.plot(x, y, marker="o", ms=5, mfc="white", mec=_THRUST, mew=1.5, zorder=9)


def _tunnels(axes: Axes, geometry: Geometry, across: str) -> None:
    """Tunnels along the axis `across`, y or z, of the picture, as boxes; the others as circles."""
    angle = np.linspace(0, 2 * np.pi, 60)
    for tunnel in geometry.tunnels:
        radius = tunnel.diameter_m / 2.0
        if tunnel.axis == across:
            reach = float(geometry.outline.radius_at(np.array([tunnel.x_m]))[0])
            _box(axes, tunnel.x_m - radius, -reach, tunnel.diameter_m, 2 * reach, "white")
        else:
            axes.plot(tunnel.x_m + radius * np.cos(angle), radius * np.sin(angle), color=_EDGE,
                      lw=1.2, zorder=6)  # fmt: skip


def _draw_side(
    axes: Axes, geometry: Geometry, inside: Entrained, thrusters: Sequence[Thruster]
) -> None:
    _hull(axes, geometry, inside)
    mast, pod = geometry.mast, geometry.pod.outline
    _box(axes, mast.x_m - mast.chord_m / 2, mast.root_z_m - mast.height_m, mast.chord_m,
         mast.height_m)  # fmt: skip
    _body(axes, pod.x_m, pod.radius_m, 0.0)
    _tunnels(axes, geometry, "z")
    _arrows(axes, thrusters, 2)
    axes.annotate("mast", (mast.x_m + 0.05, mast.root_z_m - 0.2), fontsize=9)
    axes.annotate("pod and nozzle", (pod.x_m[0] - 0.02, 0.115), fontsize=9, ha="center", va="top")
    axes.annotate("wet", (inside.tail_to_x_m - 0.02, -0.08), fontsize=8, ha="right", zorder=9)
    axes.annotate("wet", (inside.nose_from_x_m + 0.02, -0.08), fontsize=8, zorder=9)
    axes.set_ylabel("z, down, m")
    axes.set_title("from starboard: + origin, red thrusters, blue water inside")


def _draw_top(
    axes: Axes, geometry: Geometry, inside: Entrained, thrusters: Sequence[Thruster]
) -> None:
    _hull(axes, geometry, inside)
    pod, mount, mast = geometry.pod, geometry.mount, geometry.mast
    for sign in (1.0, -1.0):
        _body(axes, pod.outline.x_m, pod.outline.radius_m, sign * pod.y_m)
        root = geometry.outline.diameter_m / 2.0
        _box(axes, mount.aft_x_m, sign * root, mount.chord_m, sign * (mount.tip_y_m - root))
    angle = np.linspace(0, 2 * np.pi, 60)
    axes.fill(mast.x_m + mast.chord_m / 2 * np.cos(angle), mast.width_m / 2 * np.sin(angle),
              fc=_PART, ec=_EDGE, lw=1.0, zorder=6)  # fmt: skip
    _tunnels(axes, geometry, "y")
    for tunnel in geometry.tunnels:
        if tunnel.axis == "y":
            end, where = (1.12, "right") if tunnel.x_m > 0 else (-0.98, "left")
            axes.annotate(f"{tunnel.name}\nx = {tunnel.x_m:+.2f} m", (end, -0.16), ha=where,
                          fontsize=9)  # fmt: skip
    _arrows(axes, thrusters, 1)
    axes.set_ylabel("y, starboard, m")
    axes.set_title("from above")


def _draw_strips(axes: Axes, geometry: Geometry, inside: Entrained) -> None:
    outline, mount, flow = geometry.outline, geometry.mount, Flow()
    x = np.linspace(outline.tail_x_m, outline.nose_x_m, 1201)
    r = outline.radius_at(x)
    sway = added_mass.circle_section(r, flow.density_kg_m3)
    finned = (x > mount.aft_x_m) & (x < mount.fore_x_m)
    heave = np.where(
        finned, added_mass.finned_circle_section(r, mount.tip_y_m, flow.density_kg_m3), sway
    )
    axes.plot(x, sway, color="#1b4f72", lw=1.8, label="added mass in sway, hull")
    axes.plot(x, heave, color="#5dade2", lw=1.4, ls="--", label="in heave, with the mounts")
    wet = (x >= inside.nose_from_x_m) | (x <= inside.tail_to_x_m)
    axes.fill_between(x, 0, sway, where=wet, color=_WATER, lw=0, label="water inside")
    axes.set_ylim(0, None)
    axes.set_ylabel("kg/m")
    axes.set_xlabel("x, forward, m")
    crossing = drag.cylinder_across(outline.length_m / outline.diameter_m)
    twin = axes.twinx()
    twin.plot(x, 0.5 * flow.density_kg_m3 * crossing * 2.0 * r, color="#ca6f1e", lw=1.5,
              label="drag across (right)")  # fmt: skip
    twin.set_ylim(0, None)
    twin.set_ylabel("N/m at 1 m/s")
    twin.spines["right"].set_visible(True)
    twin.grid(visible=False)
    lines = [axes.get_legend_handles_labels(), twin.get_legend_handles_labels()]
    axes.legend(lines[0][0] + lines[1][0], lines[0][1] + lines[1][1], fontsize=9,
                loc="lower center", ncol=2)  # fmt: skip
    axes.set_title("strips along the hull")


def _draw_ratios(axes: Axes, rows: Sequence[CoefficientRow]) -> None:
    """Computed over the paper's estimate, and its CFD and calibrated values over the same."""
    shown: dict[tuple[str, str], CoefficientRow] = {}
    for row in rows:
        if row.table != "V":
            shown.setdefault((row.coefficient, row.part), row)
    others = {(r.table, r.coefficient, r.part): r.paper_other for r in rows}
    labels = []
    for place, ((coefficient, part), row) in enumerate(shown.items()):
        ratio = row.computed / row.paper
        axes.plot([1, np.clip(ratio, _FLOOR, _CEILING)], [place, place], color=_COLOURS[row.mark],
                  lw=6, solid_capstyle="butt", zorder=2)  # fmt: skip
        axes.plot(ratio, place, marker="o", ms=6, color=_COLOURS[row.mark], zorder=3)
        for table, marker in (("IV", "x"), ("V", "D")):
            other = others.get((table, coefficient, part))
            if other is not None:
                value = other / row.paper
                inside = _FLOOR <= value <= _CEILING
                axes.plot(
                    np.clip(value, _FLOOR, _CEILING), place, marker=marker, ms=6 if inside else 4,
                    mfc="none", mec="#2c3e50", ls="none", zorder=4,
                )  # fmt: skip
        labels.append(coefficient + (" hull" if part == "hull" else ""))
    axes.axvline(1.0, color="black", lw=1.0, zorder=1)
    axes.set_xscale("log")
    axes.set_xlim(_FLOOR / 1.1, _CEILING * 1.1)
    axes.set_xticks([0.1, 0.2, 0.5, 1, 2, 5, 10], ["0.1", "0.2", "0.5", "1", "2", "5", "10"])
    axes.minorticks_off()
    axes.set_yticks(range(len(labels)), labels, fontsize=9)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    for mark, words in (("reproduced", "within 1 %"), ("near", "within 5 %"), ("no", "farther")):
        axes.plot([], [], color=_COLOURS[mark], lw=6, label=f"computed, {words}")
    axes.plot([], [], "x", mec="#2c3e50", label="the paper's CFD")
    axes.plot([], [], "D", mfc="none", mec="#2c3e50", label="calibrated at sea")
    axes.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=2)
    axes.set_xlabel("over the paper's estimate (small marks: beyond the axis)")
    axes.set_title("coefficients")


def _box(axes: Axes, x: float, y: float, width: float, height: float, colour: str = _PART) -> None:
    axes.add_patch(
        Rectangle((x, y), width, height, facecolor=colour, edgecolor=_EDGE, lw=1.0, zorder=5)
    )


def _body(axes: Axes, x: Sequence[float], r: Sequence[float], middle: float) -> None:
    low, high = middle - np.array(r), middle + np.array(r)
    axes.fill([*x, *x[::-1]], [*low, *high[::-1]], fc=_PART, ec=_EDGE, lw=1.0, zorder=6, alpha=0.9)


_TITLES = {
    "III": "Table III, estimated by the paper",
    "IV": "Table IV, estimated by the paper next to its CFD",
    "V": "Table V, before and after the paper's calibration at sea",
}
_OTHER = {"III": "", "IV": "CFD", "V": "at sea"}


def coefficients_report(
    csv: Path | None = None, plot: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """The paper's three tables next to ALICE's coefficients from shape.

    Args:
        csv: file to write the rows to.
        plot: figure of the vehicle and its coefficients to draw.

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a file cannot be written.
    """
    rows = coefficient_rows()
    try:
        if csv is not None:
            header = [field.name for field in fields(CoefficientRow)]
            write_csv(csv, header, [list(asdict(row).values()) for row in rows])
        if plot is not None:
            draw_coefficients(plot, ALICE, rows)
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from None
    counts = {mark: sum(row.mark == mark for row in rows) for mark in ("reproduced", "near", "no")}
    data = {
        "geometry": _geometry(ALICE),
        "rows": [asdict(row) for row in rows],
        "counts": counts,
        "computed": dict(estimate(ALICE).values),
    }
    return _text(rows, counts), data


def _geometry(geometry: Geometry) -> dict[str, Any]:
    outline = geometry.outline
    return {
        "name": geometry.name,
        "length_m": outline.length_m,
        "diameter_m": outline.diameter_m,
        "nose_x_m": outline.nose_x_m,
        "tail_x_m": outline.tail_x_m,
        "side_area_m2": outline.side_area_m2,
        "side_fullness": outline.side_fullness,
        "wetted_area_m2": outline.wetted_area_m2,
        "envelope_volume_m3": geometry.envelope_volume_m3,
        "tunnels_x_m": {tunnel.name: tunnel.x_m for tunnel in geometry.tunnels},
    }


def _text(rows: Sequence[CoefficientRow], counts: dict[str, int]) -> str:
    blocks = []
    for table, title in _TITLES.items():
        cells = [
            (
                row.coefficient + (" hull" if row.part == "hull" else ""),
                f"{row.printed:g}",
                f"{row.paper:g}",
                f"{row.computed:.4g}",
                f"{row.difference_percent:+.1f} %",
                *([] if table == "III" else [f"{row.paper_other:g}"]),
                row.mark,
                row.equation,
            )
            for row in rows
            if row.table == table
        ]
        other = [_OTHER[table]] if _OTHER[table] else []
        header = (
            "coefficient", "printed", "paper", "computed", "difference", *other, "", "equation",
        )  # fmt: skip
        blocks.append(f"{title}\n{text_table(header, cells)}")
    outline = ALICE.outline
    blocks.append(
        f"{len(rows)} rows: {counts['reproduced']} within {CLOSE_PERCENT:g} %, {counts['near']} "
        f"within {NEAR_PERCENT:g} %, {counts['no']} not reproduced (docs/vehicle-comparison.md). "
        "Signs are those of x forward, y starboard, z down.\n"
        f"Hull {outline.length_m:.2f} x {outline.diameter_m:.2f} m, side "
        f"{outline.side_fullness:.3f} of length times diameter, envelope "
        f"{1e3 * ALICE.envelope_volume_m3:.1f} L."
    )
    return "\n\n".join(blocks)
