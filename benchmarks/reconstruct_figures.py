"""The figures of `benchmarks.reconstruct`: ours and those of other programs."""

import math
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.figures import Figure, Findings
from benchmarks.measured import Cost
from benchmarks.reconstruct_scores import Accuracy

_Numbers = dict[str, tuple[float, str]]
"""Value and unit by name."""
_SPARSE_ALONE = ("colmap", "hierarchical", "global")
"""Programs that end at the sparse model."""


def against_peers(
    count: int,
    costs: Mapping[str, Cost],
    found: Accuracy | None,
    rivals: Mapping[str, tuple[Cost | None, Accuracy | None]],
) -> Findings:
    """Cost and accuracy of ours to where each other program ends.

    Args:
        count: of pictures.
        costs: of our stages.
        found: our accuracy; None where there is no model.
        rivals: cost and accuracy of others, by name; None where the program is missing.
    """
    findings = Findings(failed=failures(f"{count} pictures", costs))
    for name, (cost, accuracy) in rivals.items():
        end = "sparse model" if name in _SPARSE_ALONE else "mosaic"
        stages = [costs["sparse"]] if name in _SPARSE_ALONE else list(costs.values())
        own = _spent(stages) | _sparse_errors(found)
        if name not in _SPARSE_ALONE:
            own |= _surface_errors(found)
        theirs = {} if cost is None or not cost.ok else _numbers(cost, accuracy)
        where = f"{count} pictures to the {end}"
        if all(stage.ok for stage in stages):
            findings += Findings(figures=tuple(_figures(where, own, name, theirs)))
        if cost is not None and not cost.ok:
            findings += Findings(left_out=(f"{where}, {name}: {cost.last_line()}",))
    return findings


def failures(where: str, costs: Mapping[str, Cost]) -> tuple[str, ...]:
    """Our stages that failed, in words."""
    return tuple(f"{where}, {s}: {c.last_line()}" for s, c in costs.items() if not c.ok)


def _spent(costs: Sequence[Cost]) -> _Numbers:
    return {
        "time": (sum(cost.wall_s for cost in costs), "s"),
        "processor time": (sum(cost.cpu_s for cost in costs), "s"),
        "peak memory": (max(cost.peak_mib for cost in costs), "MiB"),
    }


def _numbers(cost: Cost, found: Accuracy | None) -> _Numbers:
    return _spent([cost]) | _sparse_errors(found) | _surface_errors(found)


def _sparse_errors(found: Accuracy | None) -> _Numbers:
    if found is None:
        return {}
    return {
        "registered": (found.registered, "pictures"),
        "cameras, rms error": (found.cameras_mm, "mm"),
        "cameras, bend": (found.bend_mm, "mm"),
        "sparse points, rms distance": (found.points_mm, "mm"),
        "sparse points, median distance": (found.points_median_mm, "mm"),
    }


def _surface_errors(found: Accuracy | None) -> _Numbers:
    if found is None:
        return {}
    return {
        "surface, rms distance": (found.surface_mm, "mm"),
        "surface, median distance": (found.surface_median_mm, "mm"),
    }


def _figures(
    where: str, own: _Numbers, peer: str | None = None, theirs: _Numbers | None = None
) -> Iterator[Figure]:
    """All that are numbers; next to the peer's where it has them."""
    for what, (value, unit) in own.items():
        other, _ = (theirs or {}).get(what, (math.nan, unit))
        if math.isfinite(value):
            compared = peer is not None and math.isfinite(other)
            yield Figure(
                name=f"{where}: {what}", value=value, unit=unit,
                peer=peer if compared else None, peer_value=other if compared else None,
            )  # fmt: skip
