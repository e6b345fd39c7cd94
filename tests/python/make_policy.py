"""Writes an LSTM policy as another library would export it, and what that library makes of some ticks.

    python make_policy.py FOLDER

`lstm.onnx` has names of its own and a batch that is left open; `golden.safetensors` holds the numbers of the onnx package's
reference implementation, by the names that the bundle gives them.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

STATE, ACTION, HIDDEN, TICKS = 18, 4, 16, 9


def weight(random, name, *shape):
    return numpy_helper.from_array((0.4 * random.standard_normal(shape)).astype(np.float32), name)


def policy():
    random = np.random.default_rng(7)
    nodes = [
        helper.make_node("Gemm", ["obs", "w_in", "b_in"], ["embedded"], transB=1),
        helper.make_node("Elu", ["embedded"], ["active"]),
        helper.make_node("Unsqueeze", ["active", "axis"], ["x"]),
        helper.make_node(
            "LSTM", ["x", "w", "r", "b", "", "h_in", "c_in"], ["y", "h_out", "c_out"], hidden_size=HIDDEN
        ),
        helper.make_node("Squeeze", ["y", "both"], ["flat"]),
        helper.make_node("Gemm", ["flat", "w_out", "b_out"], ["mean"], transB=1),
        helper.make_node("Tanh", ["mean"], ["actions"]),
    ]
    constants = [
        weight(random, "w_in", 24, STATE),
        weight(random, "b_in", 24),
        numpy_helper.from_array(np.array([0]), "axis"),
        numpy_helper.from_array(np.array([0, 1]), "both"),
        weight(random, "w", 1, 4 * HIDDEN, 24),
        weight(random, "r", 1, 4 * HIDDEN, HIDDEN),
        weight(random, "b", 1, 8 * HIDDEN),
        weight(random, "w_out", ACTION, HIDDEN),
        weight(random, "b_out", ACTION),
    ]

    def value(name, *shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    carried = (1, 1, HIDDEN)
    graph = helper.make_graph(
        nodes,
        "actor",
        [value("obs", "batch", STATE), value("h_in", *carried), value("c_in", *carried)],
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
    folder = Path(sys.argv[1])
    model = policy()
    onnx.save(model, folder / "lstm.onnx")
    reference = ReferenceEvaluator(model)
    random = np.random.default_rng(8)
    state = random.standard_normal((TICKS, STATE)).astype(np.float32)
    first = np.array([tick in (0, 6) for tick in range(TICKS)], np.uint8)
    found = {"action": [], "next_state.h_in": [], "next_state.c_in": []}
    carried = None
    for tick in range(TICKS):
        if first[tick]:
            carried = [np.zeros((1, 1, HIDDEN), np.float32) for _ in range(2)]
        inputs = {"obs": state[tick : tick + 1], "h_in": carried[0], "c_in": carried[1]}
        actions, *carried = reference.run(None, inputs)
        for rows, value in zip(found.values(), (actions, *carried), strict=True):
            rows.append(np.asarray(value, np.float32)[0])
    arrays = {
        "input/action": np.zeros((TICKS, ACTION), np.float32),
        "input/state": state,
        "input/is_first": first,
        **{f"expect/policy/{name}": np.stack(rows) for name, rows in found.items()},
    }
    write_safetensors(folder / "golden.safetensors", arrays)


if __name__ == "__main__":
    main()
