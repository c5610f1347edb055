"""Pictures that look alike, for surveys whose navigation does not say which overlap.

Every picture gets one vector: its features' distances from the words of a codebook, summed by word
(VLAD, Jegou et al. 2010) with each word's sum normalised (Arandjelovic & Zisserman 2013). The
codebook is made from the survey's own features, so that nothing needs to be downloaded and words
are those of this sea floor. Words that all pictures share count less, since the mean of the vectors
is taken off.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from reconstruct.matching.features import load_features
from reconstruct.matching.pairs import Pair

_WORDS = 64
_SAMPLE = 30_000
"""Features from which the codebook is made."""
_ROUNDS = 12
_LARGEST = 1500
"""Features of each picture that are described."""
_BLOCK = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class _WordsTask:
    features: Path
    words: NDArray[np.float32]


def alike_pairs(
    features: Sequence[Path], wanted: Sequence[int], partners: int, *, seed: int, executor: Executor
) -> list[Pair]:
    """Pairs of pictures that look most alike.

    Args:
        features: files of the features of every picture.
        wanted: pictures for which partners are sought, among all.
        partners: how many for each.
        seed: of the codebook.
        executor: where tasks run.

    Returns:
        Pairs in rising order.
    """
    if len(features) < 2 or not len(wanted):
        return []
    words = make_codebook(features, seed)
    tasks = [_WordsTask(features=path, words=words) for path in features]
    rows = executor.map(describe, tasks, label="looks of pictures")
    looks = np.stack(list(rows))
    looks = looks - looks.mean(axis=0)
    looks = looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-9)
    pairs: set[Pair] = set()
    chosen = np.asarray(wanted)
    for start in range(0, len(chosen), _BLOCK):
        some = chosen[start : start + _BLOCK]
        likeness = looks[some] @ looks.T
        likeness[np.arange(len(some)), some] = -np.inf
        count = min(partners, len(features) - 1)
        best = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
        pairs |= {
            (min(int(i), int(j)), max(int(i), int(j)))
            for i, row in zip(some, best, strict=True)
            for j in row
        }
    return sorted(pairs)


def make_codebook(features: Sequence[Path], seed: int) -> NDArray[np.float32]:
    """Centres, (W, 128), of the features of evenly chosen pictures (k-means, Lloyd 1982)."""
    rng = np.random.default_rng(seed)
    step = max(1, len(features) // 100)
    some = features[::step]
    each = max(1, _SAMPLE // len(some))
    sample = np.concatenate([load_features(path).descriptors[:each] for path in some])
    sample = sample.astype(np.float32)
    words = sample[rng.choice(len(sample), min(_WORDS, len(sample)), replace=False)]
    for _ in range(_ROUNDS):
        word = _nearest(sample, words)
        count = np.bincount(word, minlength=len(words))
        sums = _sums(sample, word, len(words))
        filled = count > 0
        words = words.copy()
        words[filled] = (sums[filled] / count[filled, None]).astype(np.float32)
    return words


def describe(task: _WordsTask) -> NDArray[np.float32]:
    """The vector of a picture, (W * 128,); zeros without features."""
    descriptors = load_features(task.features).descriptors[:_LARGEST].astype(np.float32)
    if not len(descriptors):
        return np.zeros(task.words.size, np.float32)
    word = _nearest(descriptors, task.words)
    sums = _sums(descriptors - task.words[word], word, len(task.words))
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    vector = (sums / np.maximum(norms, 1e-9)).ravel()
    found: NDArray[np.float32] = vector.astype(np.float32)
    return found


def _nearest(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.intp]:
    nearest: NDArray[np.intp] = np.argmin(
        (words**2).sum(axis=1) - 2 * descriptors @ words.T, axis=1
    )
    return nearest


def _sums(rows: NDArray[np.float32], word: NDArray[np.intp], words: int) -> Array:
    """Sums, (W, D), of rows (N, D) by word."""
    order = np.argsort(word, kind="stable")
    starts = np.searchsorted(word[order], np.arange(words))
    present = np.bincount(word, minlength=words) > 0
    found = np.zeros((words, rows.shape[1]))
    found[present] = np.add.reduceat(rows[order].astype(np.float64), starts[present], axis=0)
    return found
