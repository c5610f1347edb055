"""Patches that `colour_reference.csv` names: what pictures show of them, and faulty rows."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import WorkspaceError
from reconstruct.mosaic.picture_measures import ReferencePatch, linear_table, read_references
from tests.oracles_dense import Scene, flat, stereo_views, write_workspace

CARD = (60, 120, 180)
"""Blue, green, red levels of the card."""
HEADER = "image,x,y,radius_px,red,green,blue\n"
IMAGE = "left/000.png"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A picture with a card 20 px about (50, 40), burnt out about (120, 40), else black."""
    folder = tmp_path_factory.mktemp("reference")
    views = stereo_views(np.array([0.0]), np.array([0.0]))
    plain = Scene(depth_of=flat, paint=lambda n, e: np.full((*n.shape, 3), 100.0))
    write_workspace(folder, views, plain)
    path = folder / "images" / IMAGE
    picture = np.zeros_like(cv2.imread(str(path)))
    cv2.circle(picture, (50, 40), 20, CARD, -1)
    cv2.circle(picture, (120, 40), 20, (255, 255, 255), -1)
    cv2.imwrite(str(path), picture)
    return folder


def references(workspace: Path, rows: str) -> tuple[ReferencePatch, ...]:
    (workspace / "colour_reference.csv").write_text(HEADER + rows)
    return read_references(workspace, [IMAGE])


def test_a_patch_is_the_mean_light_within_its_circle(workspace: Path) -> None:
    (patch,) = references(workspace, f"{IMAGE},50,40,15,0.4,0.3,0.2\n")
    np.testing.assert_allclose(patch.light, linear_table()[list(CARD)], rtol=1e-6)
    np.testing.assert_allclose(patch.reflectance, [0.2, 0.3, 0.4])
    height, width = cv2.imread(str(workspace / "images" / IMAGE)).shape[:2]
    np.testing.assert_allclose(patch.place, [50.5 / width, 40.5 / height], rtol=1e-6)


def test_without_the_file_there_is_no_reference(tmp_path: Path) -> None:
    assert read_references(tmp_path, [IMAGE]) == ()


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("left/none.png,50,40,15,0.4,0.3,0.2", "no picture 'left/none.png'"),
        (f"{IMAGE},50,40,60,0.4,0.3,0.2", "not within the picture"),
        (f"{IMAGE},-5,40,10,0.4,0.3,0.2", "not within the picture"),
        (f"{IMAGE},50,40,nan,0.4,0.3,0.2", "not within the picture"),
        (f"{IMAGE},50,40,15,40,30,20", "reflectances above 0, at most 1"),
        (f"{IMAGE},50,40,15,0.4,0,0.2", "reflectances above 0, at most 1"),
        (f"{IMAGE},50,,15,0.4,0.3,0.2", "must be numbers"),
        (f"{IMAGE},50,40,1,0.4,0.3,0.2", "9 are needed"),
        (f"{IMAGE},120,40,15,0.4,0.3,0.2", "burnt out"),
        (f"{IMAGE},50,90,15,0.4,0.3,0.2", "it is black"),
        ("", "has no patch"),
    ],
)
def test_a_faulty_row_is_named_in_one_line(workspace: Path, row: str, says: str) -> None:
    with pytest.raises(WorkspaceError) as caught:
        references(workspace, f"{row}\n" if row else "")
    text = str(caught.value)
    assert says in text and "\n" not in text
    assert not row or "line 2" in text
