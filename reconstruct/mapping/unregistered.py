"""Why pictures are not in the model."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from alice_survey.core.artefacts import write_csv
from alice_survey.core.manifest import ImageRecord
from reconstruct.mapping.database import VerifiedPair

UNREGISTERED = "unregistered.csv"
"""In `mapping` with reasons, in `sparse` with places too."""
FEW_FEATURES = 100
"""Features of a picture below which that is why it has no matches."""


def reasons(
    images: Sequence[str],
    registered: Collection[str],
    features: Sequence[int],
    pairs: Sequence[VerifiedPair],
) -> dict[str, str]:
    """What kept each picture out of the model, in words.

    Args:
        images: names of all pictures.
        registered: those in the model.
        features: how many each has.
        pairs: verified matches between pictures, by their numbers.

    Returns:
        By name, of those that are not in the model.
    """
    inside = np.array([image in registered for image in images])
    tied: list[dict[int, int]] = [{} for _ in images]
    for i, j, found in pairs:
        tied[i][j] = tied[j][i] = len(found.matches)
    joined = np.array([(i, j) for i, j, _ in pairs], dtype=np.int64).reshape(-1, 2)
    links = coo_matrix((np.ones(len(joined)), joined.T), shape=(len(images),) * 2)
    part = connected_components(links, directed=False)[1]
    size, kept = np.bincount(part), np.bincount(part, weights=inside)
    words = {}
    for n in np.flatnonzero(~inside).tolist():
        if features[n] < FEW_FEATURES:
            why = f"{features[n]} features: too dark, too blurred or without texture"
        elif not tied[n]:
            why = (
                f"{features[n]} features, but no other picture matches it: no overlap, or the "
                "water hides what they share"
            )
        elif kept[part[n]] == 0:
            why = (
                f"one of {size[part[n]]} pictures that match each other and no picture of the "
                "model: pictures between them and the model are missing"
            )
        else:
            best = max(tied[n], key=lambda other: tied[n][other])
            why = (
                f"matches {len(tied[n])} pictures, best {images[best]} ({tied[n][best]} matches), "
                "but what they share is too little or contradicts the model"
            )
        words[images[n]] = why
    return words


def write_reasons(path: Path, records: Sequence[ImageRecord], words: dict[str, str]) -> None:
    """Write a table of pictures that are not in the model; none where all are."""
    rows = [(r.image, r.camera, r.station, words[r.image]) for r in records if r.image in words]
    if rows:
        write_csv(path, ("image", "camera", "station", "reason"), rows)
