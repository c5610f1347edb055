"""Folders of several cameras are paired by time where there is any, and else say how."""

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import ImageError, keep_warnings
from reconstruct.pictures.importing import import_images
from reconstruct.pictures.incoming import moments_of, pair_by_time
from tests.reconstruct.pictures.dated import date, noise, rows_of, save, table

START = datetime(2024, 7, 1, 12, 0, 0, 250_000, tzinfo=UTC)
COUNT = 12
DROPPED = {"left": (3,), "right": (7,)}
"""As many of each, so that counts and orders look right."""
Name = Callable[[int, int, datetime], str]


def moment(k: int) -> datetime:
    return START + timedelta(seconds=0.5 * k)


def write(
    folder: Path, name: Name, *, exif: bool = False, late_s: float = 0.0
) -> dict[str, list[Path]]:
    """Pictures by side; `name` takes the moment, the camera's own count and the time."""
    found: dict[str, list[Path]] = {}
    for side, seed in (("left", 0), ("right", 100)):
        kept = [k for k in range(COUNT) if k not in DROPPED[side]]
        for own, k in enumerate(kept):
            time = moment(k) + timedelta(seconds=late_s if side == "right" else 0.0)
            path = folder / side / f"{name(k, own, time)}.jpg"
            stated = {"taken": date(0, time), "fraction": f"{time.microsecond:06d}"}
            save(path, noise(seed + k, size=(32, 24)), **(stated if exif else {}))
            found.setdefault(side, []).append(path)
    return found


def true_moments(sides: Mapping[str, Sequence[Path]]) -> list[dict[str, Path]]:
    at = {side: iter(paths) for side, paths in sides.items()}
    return [
        {side: next(at[side]) for side in sides if k not in DROPPED[side]} for k in range(COUNT)
    ]


NAMES: dict[str, tuple[Name, bool]] = {
    "exif": (lambda k, own, time: f"IMG_{own:04d}", True),
    "seconds since 1970": (lambda k, own, time: f"{time.timestamp():.3f}", False),
    "of a bag": (
        lambda k, own, time: f"{int(time.timestamp())}_{1000 * time.microsecond:09d}", False
    ),
    "nanoseconds": (lambda k, own, time: f"cam{round(time.timestamp() * 1e3) * 10**6}", False),
    "date": (lambda k, own, time: time.strftime("%Y%m%d_%H%M%S.%f"), False),
    "ISO": (lambda k, own, time: time.strftime("%Y-%m-%dT%H-%M-%S.%f"), False),
    "numbers": (lambda k, own, time: f"{k + 1}", False),
}  # fmt: skip


@pytest.mark.parametrize("how", NAMES)
def test_dropped_frames_shift_nothing(tmp_path: Path, how: str) -> None:
    name, exif = NAMES[how]
    sides = write(tmp_path, name, exif=exif)
    with keep_warnings() as said:
        found, _ = pair_by_time(sides, None, UTC)
    assert found == true_moments(sides)
    assert how == "numbers" or any("without one of another camera" in text for text in said)


def test_a_trigger_log_pairs_and_times(tmp_path: Path) -> None:
    sides = write(tmp_path, lambda k, own, time: f"shot{own:03d}")
    expected = true_moments(sides)
    rows = [
        (side, one[side].name, moment(k).isoformat())
        for side in sides for k, one in enumerate(expected) if side in one
    ]  # fmt: skip
    # and none of the last picture
    log = table(tmp_path / "triggers.csv", "camera,image,time_utc", rows[:-1])
    with keep_warnings() as said:
        import_images(tmp_path / "w", [], cameras={s: tmp_path / s for s in sides}, triggers=log)
    assert any("triggers.csv" in text and sides["right"][-1].name in text for text in said)
    records = rows_of(tmp_path / "w")
    del expected[-1]["right"]
    assert {(r.image, r.station) for r in records} == {
        (f"{side}/{path.name}", k) for k, one in enumerate(expected) for side, path in one.items()
    }


@pytest.mark.parametrize("which", ["number", "station"])  # the latter as `fly` writes it
def test_a_trigger_log_by_number_times_one_camera(tmp_path: Path, which: str) -> None:
    sides = write(tmp_path, lambda k, own, time: f"DSC_{k:05d}")
    rows = [(k, 10 + 0.5 * k) for k in range(COUNT)]
    log = table(tmp_path / "triggers.csv", f"{which},time_s", rows)
    found, time_s = pair_by_time({"left": sides["left"]}, log, UTC)
    expected = [10 + 0.5 * k for k in range(COUNT) if k not in DROPPED["left"]]
    assert [time_s[one["left"]] for one in found] == expected


def test_cameras_whose_clocks_differ_are_paired_by_number_and_said(tmp_path: Path) -> None:
    sides = write(tmp_path, lambda k, own, time: f"IMG_{k:04d}", exif=True, late_s=3600.0)
    with keep_warnings() as said:
        found, _ = pair_by_time(sides, None, UTC)
    assert found == true_moments(sides)
    assert any("not of one clock" in text and "--triggers" in text for text in said)


RNG = np.random.default_rng(4)


def test_a_dropped_picture_does_not_shift_the_others() -> None:
    true = 100.0 + 0.1 * np.arange(50) + RNG.normal(0, 0.002, 50)
    lost = {"left": [3, 20, 21], "right": [0, 20, 40]}
    late = {"left": 0.0, "right": 0.004}
    found = moments_of({side: np.delete(true + late[side], lost[side]) for side in lost})
    left = {side: iter(range(47)) for side in lost}
    moments = [{side: next(left[side]) for side in lost if k not in lost[side]} for k in range(50)]
    assert found == [one for one in moments if one]


def test_three_cameras_of_unlike_rates_meet_where_they_do() -> None:
    fast, slow, odd = np.arange(0, 10, 0.1), np.arange(0, 10, 0.5), np.array([2.5, 4.03])
    found = moments_of({"fast": fast, "slow": slow, "odd": odd})
    assert len(found) == 101  # 4.03 is a moment of its own, 0.03 s from any other
    together = [m for m in found if len(m) > 1]
    assert len(together) == 20
    assert [m for m in found if "odd" in m] == [{"fast": 25, "slow": 5, "odd": 0}, {"odd": 1}]


def test_times_that_do_not_pair_are_refused() -> None:
    left = np.arange(0, 5, 0.1)
    for right, named in ((left + 0.05, "no pictures of left and right"), (left[::-1], "right")):
        with pytest.raises(ImageError, match=named):
            moments_of({"left": left, "right": right})
