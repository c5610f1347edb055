"""Pictures that stages have drawn, small enough for a page."""

from pathlib import Path

import cv2

from alice_survey.base.errors import WorkspaceError

_MOST_PX = 1600


def still(path: Path, most_px: int = _MOST_PX) -> bytes:
    """A picture as PNG, at most so wide and high.

    Raises:
        WorkspaceError: it cannot be decoded.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise WorkspaceError(f"{path} cannot be read as a picture: make its stage again")
    height, width = picture.shape[:2]
    shrink = max(width, height) / most_px
    if shrink > 1.0:
        size = (max(1, round(width / shrink)), max(1, round(height / shrink)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    encoded: bytes = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return encoded
