"""The formats of annotations by their names."""

from alice_survey.core.errors import ConfigError
from reconstruct.annotations.formats.biigle import BIIGLE
from reconstruct.annotations.formats.coco import COCO
from reconstruct.annotations.formats.common import Format
from reconstruct.annotations.formats.taglab import TAGLAB

FORMATS = {one.name: one for one in (TAGLAB, BIIGLE, COCO)}


def format_named(name: str) -> Format:
    """A format.

    Raises:
        ConfigError: there is none of that name.
    """
    try:
        return FORMATS[name]
    except KeyError:
        raise ConfigError(f"format {name!r}: give one of {', '.join(FORMATS)}") from None
