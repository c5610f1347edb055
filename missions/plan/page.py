"""A plan as one HTML page: an interactive map and all figures, without any network."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.config import SeaConfig
from alice_survey.core.frames import Datum
from alice_survey.kit.document import (
    Link,
    MapScript,
    PictureLayer,
    Report,
    Section,
    Table,
    Verdict,
)
from alice_survey.kit.page import render_html
from alice_survey.kit.words import share
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.exposure.settings_table import Setting
from missions.plan.page_map import plan_map, station_data
from missions.values.plan_file import Plan

SCRIPTS = (files("alice_survey.kit") / "map_stations.js", Path(__file__).with_name("page_map.js"))
"""What the page's map adds to the kit's; the studio draws stations by the first."""


def write_page(
    path: Path,
    plan: Plan,
    rig: Rig,
    certificate: Certificate,
    settings_rows: Sequence[Setting],
    *,
    bathymetry: Bathymetry | None,
    sea: SeaConfig,
    warnings: Sequence[str],
    links: Sequence[Link],
    layers: Sequence[PictureLayer] = (),
) -> None:
    """Write a plan as a page with an interactive map.

    Args:
        path: of the HTML file.
        plan: the plan.
        rig: its cameras; footprints are of the first.
        certificate: how many pictures see each place.
        settings_rows: of the table of imaging settings.
        bathymetry: contours to draw, or None.
        sea: its mean current near the sea floor is shown.
        warnings: where the plan differs from what was requested.
        links: files to point to, their addresses as paths relative to the page.
        layers: more of the map.
    """
    chart = replace(
        plan_map(plan, rig, certificate, bathymetry, sea, layers),
        script=MapScript(
            text="".join(script.read_text(encoding="utf-8") for script in SCRIPTS),
            data=station_data(plan, rig, certificate),
        ),
    )
    report = Report(
        title=plan.name,
        subtitle=_subtitle(plan),
        facts=_facts(plan, rig),
        verdicts=[Verdict(level="look", text=text) for text in warnings],
        sections=[
            Section(name="map", title="Map", scene="map"),
            Section(title="Coverage", tables=[_coverage(certificate)]),
            Section(title="Dives", tables=[_dives(plan)]),
            _settings(settings_rows),
            Section(
                title="Files", links=[replace(link, address=quote(link.address)) for link in links]
            ),
        ],
        map=chart,
        footer="Places are of the left port's outer glass, metres north and east of the datum "
        f"{place_text(plan.datum)}; latitude and longitude are WGS 84.",
    )
    with atomic_path(path) as temporary:
        temporary.write_text(render_html(report), encoding="utf-8")


def place_text(datum: Datum) -> str:
    """`32.823600° N, 34.955300° E`."""
    return (
        f"{abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, "
        f"{abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}"
    )


def _subtitle(plan: Plan) -> str:
    return (
        f"Survey plan at {place_text(plan.datum)}: {plan.area.survey.area:.0f} m² of sea floor at "
        f"{plan.seafloor_depth_m:g} m, seen from {plan.altitude_m:g} m at {plan.speed_mps:g} m/s, "
        f"lines {plan.line_spacing_m:.2f} m apart"
    )


def _facts(plan: Plan, rig: Rig) -> list[tuple[str, str]]:
    minutes = plan.duration_s / 60
    along, across = 100 * plan.reached_forward_overlap, 100 * plan.reached_side_overlap
    return [
        ("lines", f"{len(plan.lines)}"),
        ("stations", f"{plan.stations}"),
        ("pictures", f"{plan.stations * len(rig.cameras)}"),
        ("every", f"{plan.interval_s:.2f} s"),
        ("exposure", f"{plan.exposure_s * 1000:.2f} ms"),
        ("overlap", f"{along:.0f} / {across:.0f} %"),
        ("covered", share(plan.coverage, 2)),
        ("way", f"{plan.length_m:.0f} m"),
        ("time", f"{minutes:.0f} min" if minutes < 180 else f"{minutes / 60:.1f} h"),
        ("dives", f"{len(plan.dives)}"),
        ("energy", f"{plan.energy_wh:.0f} Wh"),
    ]


def _coverage(seen: Certificate) -> Table:
    passes = seen.pattern.passes
    rows = (
        ("In at least one picture", share(seen.covered_share, 3)),
        ("Seen by every camera", share(seen.every_camera_share, 3)),
        ("Seen by all cameras at once (stereo)", share(seen.stereo_share, 3)),
        (
            f"At the requested overlap: on {passes} line(s) and in "
            f"{passes * seen.pattern.pictures} picture(s) of every camera",
            share(seen.share_at_overlap, 3),
        ),
        ("Fewest pictures of a camera anywhere", f"{seen.fewest_pictures}"),
        ("Pictures of all cameras, mean", f"{seen.mean_pictures:.1f}"),
        ("Cell of this count", f"{100 * seen.grid.cell_m:.1f} cm"),
    )
    return Table(title="Share of the area", header=("", "value"), rows=rows)


def _dives(plan: Plan) -> Table:
    rows = [
        (
            f"Dive {number}",
            f"{dive.first_line} to {dive.last_line}",
            f"{sum(plan.lines[i].stations for i in range(dive.first_line, dive.last_line + 1))}",
            f"{dive.route.length_m:.0f} m",
            f"{dive.duration_s / 60:.0f} min",
            f"{dive.energy_wh:.0f} Wh",
            f"{dive.home_ne_m[0]:.1f} m north, {dive.home_ne_m[1]:.1f} m east",
        )
        for number, dive in enumerate(plan.dives, start=1)
    ]
    header = ("", "lines", "stations", "way", "time", "energy", "launched and recovered at")
    return Table(title="In the order of flight", header=header, rows=rows)


def _settings(rows: Sequence[Setting]) -> Section:
    """The settings, each with its equation, its source, the setting that bounds it, and a note."""
    sources = list(dict.fromkeys(row.source for row in rows if row.source))
    header = ("setting", "value", "equation [source]", "bound by", "note")
    tables = []
    for group in dict.fromkeys(row.group for row in rows):
        own = [row for row in rows if row.group == group]
        shown = [
            (
                row.name,
                row.text,
                f"{row.equation} [{sources.index(row.source) + 1}]" if row.source else row.equation,
                row.bound_by,
                row.note,
            )
            for row in own
        ]
        tables.append(Table(title=group.capitalize(), header=header, rows=shown))
    listed = [(f"[{number}]", source) for number, source in enumerate(sources, start=1)]
    tables.append(Table(title="Sources", header=("", "source"), rows=listed))
    return Section(name="settings", title="Settings and why", tables=tables)
