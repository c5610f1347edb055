"""Render the pictures of a facade with Mitsuba 3, in a Python that has nothing of this project.

    PYTHON facade_render.py FOLDER

FOLDER holds `scene.json` (mesh, texture, cameras), as `benchmarks.facade` writes it; pictures go
into FOLDER/photos, those that are there are kept. `pip install mitsuba` makes such a Python.
"""

import json
import sys
from pathlib import Path

import mitsuba as mi

_SUN, _SKY = 1.6, 0.55
_SAMPLES = 48


def main() -> None:
    """Render every camera of the scene."""
    folder = Path(sys.argv[1])
    asked = json.loads((folder / "scene.json").read_text())
    mi.set_variant("llvm_ad_rgb", "scalar_rgb")  # LLVM, where there is one, is quicker
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": _SKY}},
            "sun": {
                "type": "directional",
                "direction": [0.45, 0.6, -0.65],
                "irradiance": {"type": "rgb", "value": [_SUN, 0.96 * _SUN, 0.88 * _SUN]},
            },
            "facade": {
                "type": "obj",
                "filename": str(folder / asked["mesh"]),
                "face_normals": True,
                "material": {
                    "type": "twosided",
                    "nested": {
                        "type": "diffuse",
                        "reflectance": {
                            "type": "bitmap",
                            "filename": str(folder / asked["texture"]),
                        },
                    },
                },
            },
        }
    )
    (folder / "photos").mkdir(exist_ok=True)
    for number, camera in enumerate(asked["cameras"]):
        path = folder / "photos" / camera["name"]
        if path.exists():
            continue
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": asked["fov_deg"],
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=camera["eye"], target=camera["target"], up=camera["up"]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": asked["size_px"][0],
                    "height": asked["size_px"][1],
                    "rfilter": {"type": "gaussian", "stddev": 0.4},
                },
                "sampler": {"type": "multijitter", "sample_count": _SAMPLES, "seed": number},
            }
        )
        shown = mi.Bitmap(mi.render(scene, sensor=sensor, seed=number))
        shown = shown.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
        part = path.with_name(f"part-{camera['name']}")
        shown.write(str(part))
        part.replace(path)
        print(path.name, flush=True)


if __name__ == "__main__":
    main()
