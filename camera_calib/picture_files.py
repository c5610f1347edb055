"""Files of pictures, before they are decoded."""

from pathlib import Path


def is_cut_short(path: Path) -> bool:
    """Whether a JPEG's data end before its picture does; OpenCV would fill the rest with grey.

    Coded data hold no markers (ITU T.81, B.1.1.5), so that the end of the image must be among what
    follows the last start of a scan.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg") or not path.is_file():
        return False
    data = path.read_bytes()
    scan = data.rfind(b"\xff\xda")
    return data.startswith(b"\xff\xd8") and scan >= 0 and data.find(b"\xff\xd9", scan) < 0
