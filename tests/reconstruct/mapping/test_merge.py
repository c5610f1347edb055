from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from reconstruct.mapping.database import rigid3d, write_database
from reconstruct.mapping.mapper import (
    _options,
    as_transform,
    merge_models,
    report_left_out,
    second_from_first,
)
from tests.reconstruct.mapping.test_mapper import mapped_scene, seen_by_pinholes
from tests.reconstruct.scenes import make_scene


def part(model: pycolmap.Reconstruction, keep: set[int]) -> pycolmap.Reconstruction:
    """A model of some frames only."""
    found = pycolmap.Reconstruction(model)
    for frame in sorted(set(found.reg_frame_ids()) - keep):
        found.deregister_frame(frame)
    return found


def test_models_that_share_stations_become_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = make_scene(lines=1, stations=9, points=5500, noise_px=0.2)
    mapped = mapped_scene(scene)
    move = RigidTransform.from_components([3.0, -2.0, 1.0], Rotation.from_rotvec([0.3, -1.0, 0.4]))
    first = part(mapped.model, {1, 2, 3, 4, 5, 6})
    second = part(mapped.model, {6, 7, 8, 9})
    second.transform(pycolmap.Sim3d(1.0, rigid3d(move).rotation, move.translation))
    found = second_from_first(first, second)
    assert found is not None
    np.testing.assert_allclose(found.as_matrix(), move.as_matrix(), atol=1e-9)

    seen, lenses = seen_by_pinholes(scene)
    rig = {n: lenses[n].pinhole_from_cam * p for n, p in scene.rig.cam_from_rig.items()}
    write_database(tmp_path / "d.db", seen, rig)
    joined = merge_models([first, second], tmp_path / "d.db", _options(rig, 1, "nothing"))
    assert [m.num_reg_images() for m in joined] == [18]
    whole = [
        as_transform(m.frames[9].rig_from_world) * as_transform(m.frames[1].rig_from_world).inv()
        for m in (mapped.model, joined[0])
    ]
    error = whole[0] * whole[1].inv()
    assert error.rotation.magnitude() < 2e-3
    assert np.linalg.norm(error.translation) < 5e-3

    alone = part(mapped.model, {7, 8, 9})
    first = part(mapped.model, {1, 2, 3})
    assert second_from_first(first, alone) is None
    assert len(merge_models([first, alone], tmp_path / "d.db", _options(rig, 1, "nothing"))) == 2
    notes = report_left_out([first, alone])
    assert len(notes) == 1
    assert notes[0].startswith("6 pictures")
    assert "left/000006.png" in notes[0]
    assert notes[0] in capsys.readouterr().err
    assert report_left_out([first]) == report_left_out([]) == []
