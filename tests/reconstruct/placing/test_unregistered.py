"""Pictures that are not in a model, and why."""

import numpy as np

from reconstruct.mapping.run import reasons
from reconstruct.matching.matches import PairMatches


def pair(i: int, j: int, count: int) -> tuple[int, int, PairMatches]:
    return i, j, PairMatches(matches=np.zeros((count, 2), np.uint32), geometry={})


def test_each_picture_has_its_reason():
    images = [f"{letter}.png" for letter in "abcdefgh"]
    pairs = [pair(0, 1, 300), pair(1, 2, 200), pair(3, 1, 17), pair(3, 2, 25), pair(5, 6, 90)]
    features = [2000, 2000, 2000, 1500, 12, 900, 900, 800]
    words = reasons(images, {"a.png", "b.png", "c.png"}, features, pairs)
    assert set(words) == {"d.png", "e.png", "f.png", "g.png", "h.png"}
    assert "matches 2 pictures, but" in words["d.png"]
    assert words["e.png"].startswith("12 features: too dark")
    assert "one of 2 pictures that match each other" in words["f.png"]
    assert words["f.png"] == words["g.png"]
    assert words["h.png"].startswith("800 features, but no other picture matches it")
    assert reasons(images[:3], set(images[:3]), features[:3], []) == {}
