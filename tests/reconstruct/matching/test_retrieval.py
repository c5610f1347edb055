from pathlib import Path

import numpy as np

from alice_survey.base.executor import SERIAL
from reconstruct.matching.features import Features, save_features
from reconstruct.matching.pairs import alike_pairs, describe, make_codebook
from tests.oracles_matching import vlad_slowly


def strip(folder: Path, pictures: int = 40, shared: int = 60) -> list[Path]:
    """A line of pictures, each of 100 features, of which it shares most with its neighbours."""
    rng = np.random.default_rng(1)
    floor = rng.gamma(0.6, 25.0, (100 + (pictures - 1) * (100 - shared), 128)).clip(0, 255)
    files = []
    for k in range(pictures):
        seen = floor[k * (100 - shared) :][:100]
        noisy = np.clip(seen + rng.normal(0, 5, seen.shape), 0, 255)
        files.append(folder / f"{k}.npz")
        save_features(
            files[k],
            Features(
                pixels=np.zeros((100, 2)),
                scale_px=np.ones(100, np.float32),
                descriptors=noisy[rng.permutation(100)].astype(np.uint8),
            ),
        )
    return files


def test_neighbours_look_most_alike(tmp_path: Path) -> None:
    files = strip(tmp_path)
    found = alike_pairs(files, range(len(files)), 2, seed=3, executor=SERIAL)
    near = {(i, i + 1) for i in range(len(files) - 1)}
    assert len(near & set(found)) >= 0.9 * len(near)
    assert len(found) <= 2 * len(files)
    assert found == alike_pairs(files, range(len(files)), 2, seed=3, executor=SERIAL)


def test_partners_are_sought_for_those_that_need_them(tmp_path: Path) -> None:
    files = strip(tmp_path, pictures=12)
    found = alike_pairs(files, [5], 3, seed=3, executor=SERIAL)
    assert len(found) == 3
    assert all(5 in pair for pair in found)
    assert alike_pairs(files, [], 3, seed=3, executor=SERIAL) == []


def test_vectors_equal_those_of_the_slow_twin(tmp_path: Path) -> None:
    files = strip(tmp_path, pictures=3)
    words = make_codebook(files, seed=4)
    with np.load(files[1]) as data:
        slow = vlad_slowly(data["descriptors"], words)
    np.testing.assert_allclose(describe(files[1], words), slow, atol=1e-5)


def test_a_picture_without_features_looks_like_nothing(tmp_path: Path) -> None:
    files = strip(tmp_path, pictures=4)
    empty = Features(
        pixels=np.zeros((0, 2)),
        scale_px=np.zeros(0, np.float32),
        descriptors=np.zeros((0, 128), np.uint8),
    )
    save_features(files[2], empty)
    words = make_codebook(files, seed=4)
    assert not describe(files[2], words).any()
