"""The table of everything that is read from outside."""

from tests.fuzz import areas, cameras, logs, workspace

TARGETS = {
    target.name: target for module in (areas, logs, cameras, workspace) for target in module.TARGETS
}
