from typing import Any

from alice_survey.core.errors import PlanError
from missions.exposure.ways_out import Settings, Way, conflict, with_ways_that_work


def way(cost: float, **settings: Any) -> Way:
    return Way(change=f"way {cost}", price=f"costs {cost}", cost=cost, settings=settings)


def test_the_three_cheapest_ways_are_named_in_order() -> None:
    fault = conflict(
        "14 pictures a second", ("overlap", "the trigger"), map(way, (3.0, 0.5, 2.0, 1.0))
    )
    assert isinstance(fault, PlanError)
    first, *rest = str(fault).splitlines()
    for name in ("14 pictures a second", "overlap", "the trigger"):
        assert name in first
    assert rest == [f"  - way {c}: costs {c}" for c in (0.5, 1.0, 2.0)]


def test_a_conflict_without_a_way_out_is_one_line() -> None:
    assert str(conflict("nothing", ("a", "b"), [])) == "nothing: a conflicts with b"


def test_ways_that_fail_are_not_offered_and_those_that_meet_another_conflict_take_its_way() -> None:
    tried = []

    def plan(settings: Settings) -> None:
        tried.append(dict(settings))
        if settings.get("a") == 2 and "b" not in settings:
            further = conflict("next", ("c", "d"), [way(0.1, a=9), way(0.5, b=1), way(0.2, b=0)])
            raise further
        if settings.get("a") == 1 or settings.get("b") == 0:
            raise PlanError("no")

    found = conflict("x", ("a", "b"), [way(1.0, a=1), way(2.0, a=2), way(3.0, a=3)])
    kept = with_ways_that_work(found, plan)

    assert [one.settings for one in kept.ways] == [{"a": 2, "b": 1}, {"a": 3}]
    assert str(kept).splitlines()[1:] == [
        "  - way 2.0 and way 0.5: costs 2.0; costs 0.5", "  - way 3.0: costs 3.0",
    ]  # fmt: skip
    assert tried == [{"a": 1}, {"a": 2}, {"a": 2, "b": 0}, {"a": 2, "b": 1}, {"a": 3}]


def test_no_more_is_tried_than_is_shown() -> None:
    tried = []
    found = conflict("x", ("a", "b"), [way(float(c), a=c) for c in range(50)])
    assert len(with_ways_that_work(found, tried.append).ways) == len(tried) == 3
