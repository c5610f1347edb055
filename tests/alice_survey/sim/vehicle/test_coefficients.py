"""Coefficients by name: what a name stands for, and which sets are refused."""

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.coefficients import Coefficients


def named(**values: float) -> Coefficients:
    return Coefficients(name="some", values=values)


def test_each_name_lands_in_its_row_and_column() -> None:
    for i, force in enumerate("XYZKMN"):
        for j, motion in enumerate("uvwpqr"):
            one = np.zeros((6, 6))
            one[i, j] = -2.0
            linear = named(**{f"{force}_{motion}": -2.0})
            np.testing.assert_array_equal(linear.linear, one)
            assert not linear.quadratic.any() and not linear.added_mass.any()
            quadratic = named(**{f"{force}_{motion}{motion}": -2.0})
            np.testing.assert_array_equal(quadratic.quadratic, one)
            assert not quadratic.linear.any() and not quadratic.added_mass.any()
            added = named(**{f"{force}_{motion}dot": -2.0})
            mirrored = one.T if i != j else 0.0 * one
            np.testing.assert_array_equal(added.added_mass, -(one + mirrored))
            assert not added.linear.any() and not added.quadratic.any()
    np.testing.assert_array_equal(named(Y_uv=-1, Z_uw=-2, M_uw=-3, N_uv=4).lift, [-1, -2, -3, 4])


def test_both_names_of_an_added_mass_share_their_mean() -> None:
    matrix = named(Y_rdot=-8.50, N_vdot=-8.55).added_mass
    assert matrix[1, 5] == matrix[5, 1] == pytest.approx(8.525)
    with pytest.raises(VehicleError, match=r"Y_rdot = -8\.5 .*N_vdot = -9"):
        _ = named(Y_rdot=-8.5, N_vdot=-9.0).added_mass
    with pytest.raises(VehicleError, match=r"Z_qdot .*M_wdot"):
        _ = named(Z_qdot=11.0, M_wdot=-11.0).added_mass


def test_replacing_an_added_mass_drops_its_mirror() -> None:
    before = named(Y_rdot=-8.5, X_uu=-7.0, K_vdot=-0.2)
    after = before.with_values("other", {"N_vdot": -2.5, "X_uu": -15.0})
    assert after.name == "other"
    assert dict(after.values) == {"N_vdot": -2.5, "X_uu": -15.0, "K_vdot": -0.2}
    assert after.added_mass[1, 5] == 2.5
    assert before.added_mass[1, 5] == 8.5  # the old set is as it was


def test_damping_may_differ_by_the_way_of_the_motion() -> None:
    """A value of one way counts instead of that of both; a new one of both drops those of one."""
    kinds = Coefficients(
        name="test", values={"Z_ww": -200.0, "Z_ww_neg": -260.0, "X_uu_pos": -5.0, "Y_vv": -9.0}
    )
    assert (kinds.quadratic[2, 2], kinds.quadratic_back[2, 2]) == (-200.0, -260.0)
    assert (kinds.quadratic[0, 0], kinds.quadratic_back[0, 0]) == (-5.0, 0.0)
    assert kinds.quadratic[1, 1] == kinds.quadratic_back[1, 1] == -9.0
    assert (kinds.value("Z_ww_pos"), kinds.value("Z_ww_neg")) == (-200.0, -260.0)
    both = kinds.with_values("both", {"Z_ww": -100.0})
    assert both.quadratic[2, 2] == both.quadratic_back[2, 2] == -100.0
    one = kinds.with_values("one", {"Z_ww_pos": -100.0})
    assert (one.quadratic[2, 2], one.quadratic_back[2, 2]) == (-100.0, -260.0)
    with pytest.raises(VehicleError, match="Z_w_neg"):
        Coefficients(name="test", values={"Z_w_neg": -1.0})
