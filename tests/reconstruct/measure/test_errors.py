"""What a surface's heights share, and what is a cell's own."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import write_json
from reconstruct.adjustment import uncertainty
from reconstruct.measure.errors import in_plane, own_correlation
from reconstruct.measure.shapes import measure_line
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.planes import LEVEL_PLANE, Plane, facing
from tests.alice_survey.app.report.tiny import SIGMA_M, SLOPE, tiny_workspace

BOUNDS = (0.0, 0.0, 0.8, 1.2)


def known(folder: Path, shared: uncertainty.SharedMotions | None) -> None:
    """Write what points share as the placing does."""
    found = uncertainty.Uncertainty(
        frames=np.zeros(0, np.int64), stations=np.zeros(0, np.int64), images=(),
        frame_cov=np.zeros((0, 6, 6)), point_ids=np.zeros(0, np.int64),
        point_cov=np.zeros((0, 3, 3)), point_noise=np.zeros((0, 3, 3)), sigma_px=0.3,
        modes=uncertainty.no_modes(0, 0), shared=shared,
    )  # fmt: skip
    uncertainty.write_uncertainty(folder / "sparse" / "covariance.npz", found)


def growing(sigma: float) -> uncertainty.SharedMotions:
    """Points of the tiny surface, NED, that all grow about a place together."""
    east, north = np.random.default_rng(0).uniform(-0.2, 1.4, (2, 1500))
    ned = np.column_stack([north, east, 10.0 - SLOPE * east])
    motions = sigma * (ned - [0.6, 0.4, 9.9])
    return uncertainty.SharedMotions(ned, motions[:, :, None], np.eye(1), np.zeros((1500, 3, 3)))


def test_a_model_that_grows_changes_lengths_by_its_share(tmp_path: Path) -> None:
    folder = tiny_workspace(tmp_path)
    known(folder, growing(0.003))
    surface = MeasuredSurface.of(folder)
    figures = {one.name: one for one in measure_line(surface, [(0.2, 0.6), (0.6, 1.0)])}
    length = figures["length"]
    assert length.shared == pytest.approx(0.003 * length.value, rel=0.03)
    rise = figures["height_difference"]
    assert rise.shared == pytest.approx(0.003 * abs(rise.value), rel=0.05)
    assert figures["slope"].shared < 0.02  # a shape that grows is as steep
    assert any("shape and scale" in note for note in surface.errors.notes)


def test_what_all_heights_share_is_no_cells_own(tmp_path: Path) -> None:
    folder = tiny_workspace(tmp_path)
    shift = growing(0.0)
    up = np.zeros((1500, 3, 1))
    up[:, 2] = 0.8 * SIGMA_M
    known(folder, uncertainty.SharedMotions(shift.places, up, np.eye(1), shift.rest))
    surface = MeasuredSurface.of(folder)
    own = surface.window(30, 30, 5, 5)[1]
    np.testing.assert_allclose(own, 0.6 * SIGMA_M, rtol=1e-5)
    sigma = surface.at(np.array([[0.305, 0.605]])).sigma[0]  # in the middle of a cell
    assert sigma == pytest.approx(SIGMA_M, rel=1e-4)
    rise = measure_line(surface, [(0.205, 0.605), (0.605, 0.605)])[-2]
    assert rise.name == "height_difference"
    assert rise.sigma == pytest.approx(np.sqrt(2) * 0.6 * SIGMA_M, rel=1e-3)


def test_a_scale_of_navigation_is_counted(tmp_path: Path) -> None:
    names = (
        "rms_north_m rms_east_m rms_depth_m sigma_north_m sigma_east_m sigma_depth_m "
        "sigma_heading_deg sigma_tilt_deg"
    )
    place = dict.fromkeys(names.split()) | {"sigma_scale": 0.02}
    folder = tiny_workspace(tmp_path, sparse={"georeference": place})
    surface = MeasuredSurface.of(folder)
    length = measure_line(surface, [(0.2, 0.6), (0.6, 1.0)])[0]
    assert length.shared == pytest.approx(0.02 * length.value, rel=0.01)
    write_json(folder / "sparse" / "registration.json", {"georeference": None,
        "registered": 4, "total": 4, "points": 1000, "mean_reprojection_px": 0.3,
        "mean_track_length": 3.5, "scale_source": None
    })  # fmt: skip
    assert measure_line(MeasuredSurface.of(folder), [(0.2, 0.6), (0.6, 1.0)])[0].shared < 0.001


def test_motions_turn_with_the_plane() -> None:
    """A wall that faces south: what comes out of it goes south."""
    plane = Plane(
        name="wall", about="", plane_from_world=RigidTransform.from_rotation(facing(180.0, 0.0))
    )
    south = np.array([[[-1.0], [0.0], [0.0]]])
    shared = uncertainty.SharedMotions(
        np.array([[1.0, 2.0, 3.0]]), south, np.eye(1), south @ south[:, :, :1].swapaxes(1, 2)
    )
    found = in_plane(shared, plane)
    np.testing.assert_allclose(found.motions[0, :, 0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(found.places[0], [2.0, -3.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(found.rest[0]), [0.0, 0.0, 1.0], atol=1e-12)
    level = in_plane(shared, LEVEL_PLANE)
    np.testing.assert_allclose(level.motions[0, :, 0], [0.0, -1.0, 0.0], atol=1e-12)


def test_own_errors_go_together_as_two_kernels_say() -> None:
    """Against white noise on a fine grid under the window and the bilinear shares."""
    fine = 40
    steps = np.arange(-3 * fine, 3 * fine + 1) / fine
    window = np.exp(-(steps**2) / (2 * 0.5**2))
    share = np.maximum(1.0 - np.abs(steps), 0.0)
    kernel = np.convolve(window, share, mode="same")
    for cells in (0, 1, 2):
        moved = np.roll(kernel, cells * fine)
        expected = (kernel * moved).sum() / (kernel**2).sum()
        assert float(own_correlation(np.array(float(cells)))) == pytest.approx(expected, abs=0.02)
