"""What `benchmarks/camera.py` asks for, on few points: the same work, and not slower than peers."""

from benchmarks.camera_speed import measure


def test_projection_keeps_up_with_opencv() -> None:
    rows = measure(20_000, 8, None)  # it also checks that peers find the same pixels

    fastest = next(row for row in rows if row.peer == "cv2.projectPoints" and row.what == "project")
    assert fastest.goals == (1.0, 2.0)
    assert fastest.ratio > 1.0
