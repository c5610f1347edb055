import numpy as np

from reconstruct.mosaic.seams import candidates, choose_views
from tests.oracles_mosaic import labels_energy, lowest_energy


def random_problem(seed: int, rows: int, columns: int, maximum: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    number = np.stack(
        [rng.permutation(maximum + 1)[:maximum] for _ in range(rows * columns)]
    ).reshape(rows, columns, maximum)
    share = rng.uniform(0.3, 1.0, (rows, columns, maximum))
    colours = rng.normal(0, 0.2, (rows, columns, maximum, 3))
    return number.astype(np.int32), share.astype(np.float32), colours.astype(np.float32)


def test_labels_are_close_to_the_best_of_all() -> None:
    excess = []
    for seed in range(12):
        number, share, colours = random_problem(seed, 3, 3, 2)
        chosen = choose_views(number, share, colours)
        found = labels_energy(number, share, colours, chosen)
        best = lowest_energy(number, share, colours)
        assert found >= best - 1e-4
        excess.append(found / best - 1)
    assert np.mean(excess) < 0.03
    assert max(excess) < 0.2


def test_a_seam_goes_around_what_two_views_show_differently() -> None:
    rows, columns = 24, 40
    east = np.arange(columns) / columns
    falling, rising = np.tile(1.2 - east, (rows, 1)), np.tile(0.2 + east, (rows, 1))
    qualities = np.stack([falling, rising]).astype(np.float32)
    number, share, row_of = candidates(qualities, np.array([7, 9], np.int32))
    thing = np.zeros((rows, columns), bool)
    thing[8:16, 16:26] = True  # astride the line at which the qualities are equal
    shown = np.zeros((2, rows, columns, 3), np.float32)
    shown[1][thing] = 0.8
    index = np.arange(rows)[:, None, None], np.arange(columns)[None, :, None]
    chosen = choose_views(number, share, shown[row_of, index[0], index[1]])
    label = np.take_along_axis(number, chosen[..., None], axis=2)[..., 0]
    assert set(np.unique(label)) == {7, 9}
    assert len(np.unique(label[8:16, 16:26])) == 1
    assert (label[:, :8] == 7).all()
    assert (label[:, -8:] == 9).all()
    plain = choose_views(number, share, np.zeros_like(shown[row_of, index[0], index[1]]))
    assert (plain == 0).mean() > 0.9


def test_seams_are_laid_up_to_views_that_are_settled() -> None:
    """Energy over both halves of a grid, the second laid with or without regard to the first."""
    gains = []
    for seed in range(8):
        number, share, colours = random_problem(seed, 12, 16, 3)
        left, right = (slice(None), slice(0, 8)), (slice(None), slice(8, 16))
        apart = np.full((12, 16), -1, np.int32)
        for half in (left, right):
            apart[half] = choose_views(number[half], share[half], colours[half])
        settled = np.full((12, 16), -1, np.int32)
        settled[left] = np.take_along_axis(number, np.maximum(apart, 0)[..., None], 2)[left][..., 0]
        joined = choose_views(number, share, colours, settled)
        np.testing.assert_array_equal(joined[left], apart[left])
        before, after = (labels_energy(number, share, colours, one) for one in (apart, joined))
        gains.append(before - after)
    assert min(gains) > 0
    assert np.mean(gains) > 5  # of some 150
