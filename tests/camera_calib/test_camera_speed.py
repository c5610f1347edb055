"""What `benchmarks/camera.py` measures, on few points: the same work as its peers."""

from benchmarks.camera_speed import measure


def test_projection_is_measured_against_opencv() -> None:
    rows = measure(20_000, 8)  # it also checks that peers find the same pixels

    against = next(row for row in rows if row.peer == "cv2.projectPoints" and row.what == "project")
    assert against.goals == (1.0, 2.0)
