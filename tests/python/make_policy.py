"""Writes an LSTM policy as another library would export it, and what that library makes of some ticks.

    python make_policy.py FOLDER [--hidden 16] [--picture]

`lstm.onnx` has names of its own and a batch that is left open; with `--picture` it also sees a camera by three convolutions.
`golden.safetensors` holds the numbers of the onnx package's reference implementation, by the names that the bundle gives them.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

STATE, ACTION, TICKS = 18, 4, 9
# Channels, kernel and stride of each convolution on a picture of 64 x 64; 4 x 4 pixels are left.
CONVOLUTIONS = [(32, 8, 4), (64, 4, 2), (64, 3, 1)]


def weight(random, name, *shape):
    scale = 1.6 / np.sqrt(np.prod(shape[1:]))
    return numpy_helper.from_array((scale * random.standard_normal(shape)).astype(np.float32), name)


def convolutions(random):
    """Pixels to a row of numbers: nodes, constants and how many numbers."""
    nodes = [
        helper.make_node("Cast", ["camera"], ["pixels"], to=TensorProto.FLOAT),
        helper.make_node("Div", ["pixels", "full"], ["unit"]),
        helper.make_node("Transpose", ["unit"], ["map_0"], perm=[0, 3, 1, 2]),
    ]
    constants = [numpy_helper.from_array(np.array(255, np.float32), "full")]
    channels = 3
    for index, (out, kernel, stride) in enumerate(CONVOLUTIONS):
        names = [f"map_{index}", f"kernel_{index}", f"bias_{index}"]
        sizes = {"kernel_shape": [kernel, kernel], "strides": [stride, stride]}
        nodes.append(helper.make_node("Conv", names, [f"sum_{index}"], **sizes))
        nodes.append(helper.make_node("Relu", [f"sum_{index}"], [f"map_{index + 1}"]))
        constants += [weight(random, names[1], out, channels, kernel, kernel), weight(random, names[2], out)]
        channels = out
    nodes.append(helper.make_node("Flatten", [f"map_{len(CONVOLUTIONS)}"], ["seen"]))
    return nodes, constants, 16 * channels


def policy(hidden, picture):
    random = np.random.default_rng(7)
    before, more, width = convolutions(random) if picture else ([], [], 0)
    if picture:
        before.append(helper.make_node("Concat", ["obs", "seen"], ["all"], axis=1))
    nodes = [
        *before,
        helper.make_node("Gemm", ["all" if picture else "obs", "w_in", "b_in"], ["embedded"], transB=1),
        helper.make_node("Elu", ["embedded"], ["active"]),
        helper.make_node("Unsqueeze", ["active", "axis"], ["x"]),
        helper.make_node(
            "LSTM", ["x", "w", "r", "b", "", "h_in", "c_in"], ["y", "h_out", "c_out"], hidden_size=hidden
        ),
        helper.make_node("Squeeze", ["y", "both"], ["flat"]),
        helper.make_node("Gemm", ["flat", "w_out", "b_out"], ["mean"], transB=1),
        helper.make_node("Tanh", ["mean"], ["actions"]),
    ]
    constants = [
        *more,
        weight(random, "w_in", hidden, STATE + width),
        weight(random, "b_in", hidden),
        numpy_helper.from_array(np.array([0]), "axis"),
        numpy_helper.from_array(np.array([0, 1]), "both"),
        weight(random, "w", 1, 4 * hidden, hidden),
        weight(random, "r", 1, 4 * hidden, hidden),
        weight(random, "b", 1, 8 * hidden),
        weight(random, "w_out", ACTION, hidden),
        weight(random, "b_out", ACTION),
    ]

    def value(name, *shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    carried = (1, 1, hidden)
    cameras = [helper.make_tensor_value_info("camera", TensorProto.UINT8, ["batch", 64, 64, 3])] if picture else []
    graph = helper.make_graph(
        nodes,
        "actor",
        [*cameras, value("obs", "batch", STATE), value("h_in", *carried), value("c_in", *carried)],
        [value("actions", "batch", ACTION), value("h_out", *carried), value("c_out", *carried)],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    return model


def write_safetensors(path, arrays):
    names = {np.dtype(np.float32): "F32", np.dtype(np.uint8): "U8"}
    header, data = {}, b""
    for name, array in arrays.items():
        content = np.ascontiguousarray(array).tobytes()
        offsets = [len(data), len(data) + len(content)]
        header[name] = {"dtype": names[array.dtype], "shape": array.shape, "data_offsets": offsets}
        data += content
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def main():
    parser = argparse.ArgumentParser(description="Write an LSTM policy as another library would export it.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hidden", type=int, default=16, help="width of the LSTM and of the layer before it")
    parser.add_argument("--picture", action="store_true", help="see a camera of 64 x 64 beside the measured state")
    arguments = parser.parse_args()
    folder, hidden = arguments.folder, arguments.hidden
    model = policy(hidden, arguments.picture)
    onnx.save(model, folder / "lstm.onnx")
    reference = ReferenceEvaluator(model)
    random = np.random.default_rng(8)
    state = random.standard_normal((TICKS, STATE)).astype(np.float32)
    pictures = random.integers(0, 256, (TICKS, 64, 64, 3), np.uint8)
    first = np.array([tick in (0, 6) for tick in range(TICKS)], np.uint8)
    found = {"action": [], "next_state.h_in": [], "next_state.c_in": []}
    carried = None
    for tick in range(TICKS):
        if first[tick]:
            carried = [np.zeros((1, 1, hidden), np.float32) for _ in range(2)]
        row = slice(tick, tick + 1)
        inputs = {"obs": state[row], "h_in": carried[0], "c_in": carried[1]}
        if arguments.picture:
            inputs["camera"] = pictures[row]
        actions, *carried = reference.run(None, inputs)
        for rows, value in zip(found.values(), (actions, *carried), strict=True):
            rows.append(np.asarray(value, np.float32)[0])
    arrays = {
        "input/action": np.zeros((TICKS, ACTION), np.float32),
        "input/state": state,
        "input/is_first": first,
        **{f"expect/policy/{name}": np.stack(rows) for name, rows in found.items()},
    }
    if arguments.picture:
        arrays["input/image"] = pictures
    write_safetensors(folder / "golden.safetensors", arrays)


if __name__ == "__main__":
    main()
