"""Chapters, times and places of videos, written after the public specifications."""

import struct
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import cv2
import numpy as np
import pytest

from alice_survey.core.artefacts import read_json
from alice_survey.core.errors import ImageError, keep_warnings
from reconstruct.pictures.importing import import_images
from reconstruct.pictures.videos import find_videos, read_fixes, read_recordings, video_start
from tests.reconstruct.pictures import gopro
from tests.reconstruct.pictures.dated import counts, rows_of, table

NOON = datetime(2024, 7, 1, 12, tzinfo=UTC)
OSLO = ZoneInfo("Europe/Oslo")


def levels(first: int, count: int, size: tuple[int, int] = (64, 48)) -> list[np.ndarray]:
    """Frames that state their number by their grey level."""
    return [np.full((size[1], size[0], 3), 3 * i, np.uint8) for i in range(first, first + count)]


@pytest.mark.parametrize(
    "chapters", ["GX010042.MP4 GX020042.MP4 GX030042.MP4", "GOPR0042.MP4 GP010042.MP4 gp020042.mp4"]
)
def test_chapters_of_a_recording_run_on(tmp_path: Path, chapters: str) -> None:
    names = chapters.split()
    paths = [
        gopro.film(tmp_path / name, levels(20 * i, 20), created=NOON)
        for i, name in enumerate(names)
    ]
    with keep_warnings() as warnings:
        found = import_images(tmp_path / "w", [], videos=paths[::-1], every_s=0.5)
    assert warnings == []
    records = rows_of(tmp_path / "w")
    assert [r.time_s for r in records] == pytest.approx(np.arange(12) * 0.5)
    assert [r.image for r in records][:2] == [
        f"camera/{Path(names[0]).stem}_00000{i}.png" for i in range(2)
    ]
    assert counts(found) == {"camera": 12}
    (line,) = [one for one in found.lines if "frames of" in one]
    assert "3 files" in line and "2024-07-01 12:00:00" in line and "local time" in line
    assert line in read_json(tmp_path / "w" / "images" / "survey.json")["notes"]
    again = import_images(tmp_path / "w", [], videos=paths[::-1], every_s=0.5)
    assert not again.changed and again.lines == found.lines


def test_a_missing_chapter_is_named_and_its_time_is_kept(tmp_path: Path) -> None:
    lengths = {1: 30, 3: 30, 4: 10}
    paths = [
        gopro.film(tmp_path / f"GX0{chapter}0042.MP4", levels(0, count))
        for chapter, count in lengths.items()
    ]
    with keep_warnings() as warnings:
        (recording,) = read_recordings(paths, UTC)
    assert [file.start_s for file in recording.files] == pytest.approx([0.0, 6.0, 9.0])
    (warning,) = warnings
    assert "chapters 2 " in warning and "3.0 s" in warning
    with keep_warnings() as warnings:
        (recording,) = read_recordings(paths[1:], UTC)
    assert recording.files[0].start_s == 0.0
    assert "chapters 1, 2 " in warnings[0] and "GX030042.MP4" in warnings[0]


def test_recordings_are_ordered_by_their_dates(tmp_path: Path) -> None:
    then = NOON + timedelta(seconds=100)
    late = gopro.film(tmp_path / "a.mp4", levels(0, 20), created=then, gopro=False)
    early = gopro.film(tmp_path / "b.mp4", levels(0, 20), created=NOON, gopro=False)
    found = read_recordings([late, early], UTC)
    shown = [(r.name, r.start_s, r.start) for r in found]
    assert shown == [("b", 0.0, NOON), ("a", 100.0, then)]
    undated = gopro.film(tmp_path / "c.mp4", levels(0, 20))
    assert [np.isnan(r.start_s) for r in read_recordings([early, undated], UTC)] == [True, True]


def test_a_gopros_local_time_ties_it_to_navigation(tmp_path: Path) -> None:
    """It writes 12:00 in Oslo as 12:00 UTC; that is 10:00 UTC."""
    video = gopro.film(tmp_path / "GX010001.MP4", levels(0, 40), created=NOON)
    start = NOON - timedelta(hours=2, seconds=10)
    rows = [((start + timedelta(seconds=s)).isoformat(), 5 + s) for s in range(60)]
    log = table(tmp_path / "log.csv", "time_utc,depth_m", rows)
    import_images(
        tmp_path / "w", [video], every_s=1.0, navigation=log, time_zone="Europe/Oslo",
        clock_offset_s=3.0,
    )  # fmt: skip
    records = rows_of(tmp_path / "w")
    assert [r.depth_m for r in records] == pytest.approx([18.0, 19.0, 20.0, 21.0])
    began = NOON - timedelta(hours=2)
    other = gopro.film(tmp_path / "phone.mp4", levels(0, 40), created=began, gopro=False)
    import_images(
        tmp_path / "v", [], videos=[other], every_s=1.0, navigation=log, time_zone="Europe/Oslo"
    )
    records = rows_of(tmp_path / "v")
    assert [r.depth_m for r in records] == pytest.approx([15.0, 16.0, 17.0, 18.0])


def test_wide_boxes_are_read(tmp_path: Path) -> None:
    seconds = round((NOON - gopro.EPOCH).total_seconds())
    header = gopro.full_box(b"mvhd", struct.pack(">QQIQ", seconds, seconds, 1000, 0), version=1)
    index = gopro.box(b"moov", header)
    wide = struct.pack(">I4sQ", 1, b"mdat", 16 + 5) + b"12345"
    for data, made in ((wide + index, NOON), (wide[:-2], None), (b"\x1aE\xdf\xa3 no MP4", None)):
        (tmp_path / "a.mp4").write_bytes(data)
        assert video_start(tmp_path / "a.mp4")[0] == made


def test_videos_of_a_folder_are_found_without_previews(tmp_path: Path) -> None:
    for name in ("GX020001.MP4", "GX010001.MP4", "GL010001.LRV", "GX010001.THM", ".hidden.mp4"):
        (tmp_path / name).write_bytes(b"x")
    assert [p.name for p in find_videos([tmp_path])] == ["GX010001.MP4", "GX020001.MP4"]


def test_recordings_of_two_sizes_are_of_two_cameras(tmp_path: Path) -> None:
    videos = [
        gopro.film(tmp_path / f"{name}.mp4", levels(0, count, size), created=NOON)
        for name, count, size in (("a", 20, (64, 48)), ("b", 40, (80, 48)), ("c", 30, (64, 48)))
    ]
    found = import_images(tmp_path / "w", [], videos=videos, every_s=1.0)
    assert counts(found) == {"camera": 5, "camera-2": 4}
    wrong = gopro.film(tmp_path / "GX010001.mp4", levels(0, 9))
    second = gopro.film(tmp_path / "GX020001.mp4", levels(0, 9, (80, 48)))
    with pytest.raises(ImageError, match=r"80 x 48 .* 64 x 48"):
        read_recordings([wrong, second], UTC)


def test_frames_come_as_they_are_stored(tmp_path: Path) -> None:
    """A matrix in the track's header turns a video by 90 deg in players."""
    path = gopro.film(tmp_path / "a.mp4", levels(0, 20))
    data = path.read_bytes()
    upright = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    turned = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    place = data.index(upright, data.index(b"tkhd"))
    path.write_bytes(data[:place] + turned + data[place + 36 :])
    found = import_images(tmp_path / "w", [], videos=[path], every_s=1.0)
    assert counts(found) == {"camera": 2}
    record = read_json(tmp_path / "w" / "images" / "imported.json")["cameras"]["camera"]
    assert (record["width_px"], record["height_px"]) == (64, 48)


def test_a_clock_that_was_never_set_states_no_time(tmp_path: Path) -> None:
    reset = datetime(2016, 1, 1, 0, 42, tzinfo=UTC)
    path = gopro.film(tmp_path / "GX010001.MP4", levels(0, 20), created=reset)
    with keep_warnings() as warnings:
        (recording,) = read_recordings([path], UTC)
    assert recording.start is None and "never set" in warnings[0]


@pytest.mark.parametrize("telemetry", [gopro.gps5, gopro.gps9])
def test_gps_of_a_gopro_gives_time_and_place(tmp_path: Path, telemetry: object) -> None:
    """A diver swims 18e-5 deg to the north in 2 s at the surface, then dives: no fix."""
    began = NOON + timedelta(seconds=0.5)
    data = []
    for second in range(4):
        places = [(60.0 + (18 * second + i) * 5e-6, -5.25, 0.5) for i in range(18)]
        when = began + timedelta(seconds=second)
        data.append(telemetry(places, when, fix=3 if second < 2 else 0))  # type: ignore[operator]
    made = NOON - timedelta(days=300)
    path = gopro.film(tmp_path / "GX010042.MP4", levels(0, 40), payloads=data, created=made)
    found = import_images(tmp_path / "w", [], videos=[path], every_s=0.5)
    (recording,) = read_recordings([path], OSLO)
    assert recording.start is not None
    assert abs((recording.start - began).total_seconds()) < 2e-3
    records = rows_of(tmp_path / "w")
    known = [r for r in records if r.has_position]
    assert [r.time_s for r in known] == pytest.approx(np.arange(6) * 0.5)
    for r in known[:4]:
        assert r.latitude_deg == pytest.approx(60.0 + 18 * 5e-6 * r.time_s, abs=2e-7)
        assert (r.longitude_deg, r.depth_m) == pytest.approx((-5.25, -0.5), abs=1e-7)
    assert found.positions == 6
    assert any("GPS in the video" in line for line in found.lines)


def test_telemetry_that_states_too_much_counts_as_none(tmp_path: Path) -> None:
    good = gopro.gps5([(60.0, 5.0, 1.0)] * 3, NOON)
    scale = good.index(b"SCAL")
    for broken in (
        good[: scale + 8] + b"\0" * 20 + good[scale + 28 :],  # divided by zero
        good.replace(b"GPS5l", b"GPS5?"),
        good.replace(b"GPS5l\x14\0\x03", b"GPS5l\x14\xff\xff"),
        good[:30],
    ):
        path = gopro.film(tmp_path / "a.mp4", levels(0, 5), payloads=[broken])
        assert len(read_fixes(path, 1.0).time_s) == 0
    path = gopro.film(tmp_path / "a.mp4", levels(0, 5), payloads=[good])
    assert len(read_fixes(path, 1.0).time_s) == 3


def test_frames_of_videos_are_cut_too(tmp_path: Path) -> None:
    """The left half of a frame is dark, the right one bright."""
    frames = [np.hstack([f, 255 - f]) for f in levels(5, 20)]
    video = gopro.film(tmp_path / "zed.mp4", frames)
    found = import_images(tmp_path / "w", [], videos=[video], every_s=0.5, split=True)
    assert counts(found) == {"left": 4, "right": 4}
    records = rows_of(tmp_path / "w")
    assert [(r.camera, r.station) for r in records[:4]] == [
        ("left", 0), ("right", 0), ("left", 1), ("right", 1),
    ]  # fmt: skip
    assert [r.time_s for r in records] == pytest.approx(np.repeat(np.arange(4) * 0.5, 2))
    means = [cv2.imread(str(tmp_path / "w/images" / r.image)).mean() for r in records]
    np.testing.assert_allclose(np.add(means[::2], means[1::2]), 255, atol=10)
    assert max(means[::2]) < 100
