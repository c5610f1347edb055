import pytest

from alice_survey.base.errors import PlanError
from missions.exposure.ways_out import Way, conflict


def test_the_three_cheapest_ways_are_named_in_order() -> None:
    ways = [Way(change=f"way {c}", price=f"costs {c}", cost=c) for c in (3.0, 0.5, 2.0, 1.0)]
    fault = conflict("14 pictures a second", ("overlap", "the trigger"), ways)
    assert isinstance(fault, PlanError)
    first, *rest = str(fault).splitlines()
    for name in ("14 pictures a second", "overlap", "the trigger"):
        assert name in first
    assert rest == [f"  - way {c}: costs {c}" for c in (0.5, 1.0, 2.0)]


def test_a_conflict_needs_a_way_out() -> None:
    with pytest.raises(ValueError):
        conflict("nothing", ("a", "b"), [])
