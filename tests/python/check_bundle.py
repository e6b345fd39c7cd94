"""Checks a bundle with tools that share no code with this project.

Every part must pass the official ONNX checker with full shape inference, and ONNX Runtime must give the golden values: first
each part on the golden inputs of its tick, then the whole policy recurrently, each tick on its own results.

    python check_bundle.py BUNDLE [--tolerance 1e-5]

Prints one line per part with its largest error; exit 1 beyond tolerance, 2 when the bundle cannot be read.
"""

import argparse
import sys
import tomllib
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import numpy_helper

SAFETENSORS_TYPES = {"F32": np.float32, "I64": np.int64, "U8": np.uint8}
BRANCH_OUTPUTS = ["h_next", "prior_z", "posterior_z", "prior_log_probs", "posterior_log_probs"]


def read_safetensors(path):
    """Named arrays of a safetensors file: a length, a JSON header, then the data."""
    import json

    data = path.read_bytes()
    header_len = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + header_len])
    header.pop("__metadata__", None)
    arrays = {}
    for name, entry in header.items():
        start, end = (8 + header_len + offset for offset in entry["data_offsets"])
        arrays[name] = np.frombuffer(data[start:end], SAFETENSORS_TYPES[entry["dtype"]]).reshape(entry["shape"])
    return arrays


def check_graph(path):
    """The official checks; returns the graph's operators."""
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    inferred = onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)
    # What inference finds out must be what the file says.
    said = {info.name: info for info in model.graph.value_info}
    for info in inferred.graph.value_info:
        if info.name in said and info.type != said[info.name].type:
            raise ValueError(f"{path.name}: {info.name} is inferred as {info.type}, the file says {said[info.name].type}")
    domains = {entry.domain for entry in model.opset_import} | {node.domain for node in model.graph.node}
    if domains - {"", "ai.onnx"}:
        raise ValueError(f"{path.name}: operators beyond the standard ones: {sorted(domains)}")
    for tensor in model.graph.initializer:
        if not np.all(np.isfinite(numpy_helper.to_array(tensor))):
            raise ValueError(f"{path.name}: {tensor.name} is not finite")
    return {node.op_type for node in model.graph.node}


class Errors:
    """Largest error of each part; class indices count as an error of 1 where they differ."""

    def __init__(self, golden):
        self.golden = golden
        self.largest = {}
        self.compared = {}

    def compare(self, part, tick, outputs):
        for name, found in outputs.items():
            expected = self.golden.get(f"expect/{part}/{name}")
            if expected is None or tick >= len(expected):
                continue
            expected = expected[tick : tick + 1]
            if found.shape != expected.shape:
                raise ValueError(f"{part}/{name}: shape {found.shape}, golden {expected.shape}")
            if found.dtype == np.int64:
                error = float(np.any(found != expected))
            else:
                error = float(np.max(np.abs(found - expected)))
            error = np.inf if np.isnan(error) else error
            self.largest[part] = max(self.largest.get(part, 0.0), error)
            self.compared[part] = self.compared.get(part, 0) + 1


class Policy:
    """The parts, run by ONNX Runtime."""

    def __init__(self, folder, parts):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.sessions = {
            name: onnxruntime.InferenceSession(folder / file, options, providers=["CPUExecutionProvider"])
            for name, file in parts.items()
        }

    def run(self, part, *inputs):
        session = self.sessions[part]
        names = [entry.name for entry in session.get_inputs()]
        outputs = session.run(None, dict(zip(names, inputs, strict=True)))
        return dict(zip([entry.name for entry in session.get_outputs()], outputs, strict=True))


def replay(policy, golden, initial, errors, recurrent):
    """Runs all ticks. Where `recurrent`, the state is carried over from our own results, else from the golden ones."""
    branches = [name for name in ("robot", "environment", "dynamics") if name in policy.sessions]
    state = None
    for tick, first in enumerate(golden["input/is_first"]):
        if first:
            state = [initial[f"{branch}/{value}"] for branch in branches for value in ("z", "h")]
        row = slice(tick, tick + 1)
        encoder = policy.run("encoder", golden["input/image"][row])
        features = encoder["features"]
        errors.compare("encoder", tick, encoder)
        measured = [golden["input/state"][row]] if "input/state" in golden else []
        acting = branches[0]  # robot or dynamics
        action, noise = golden["input/action"][row], golden[f"input/{acting}_noise"][tick]
        first_branch = policy.run(acting, *state[:2], action, features, noise, *measured)
        errors.compare(acting, tick, first_branch)
        if not recurrent:
            first_branch = expected(golden, acting, tick)
        found = [first_branch]
        if "environment" in branches:
            environment_z, environment_h = state[2:]
            interaction = policy.run("interaction", first_branch["prior_z"], first_branch["h_next"], environment_z)
            errors.compare("interaction", tick, interaction)
            e = interaction["e"] if recurrent else golden["expect/interaction/e"][row]
            noise = golden["input/environment_noise"][tick]
            environment = policy.run("environment", e, environment_h, features, noise)
            errors.compare("environment", tick, environment)
            found.append(environment if recurrent else expected(golden, "environment", tick))
        state = [branch[value] for branch in found for value in ("posterior_z", "h_next")]
        for part in ("actor", "reward", "continue", "decoder"):
            if part in policy.sessions:
                errors.compare(part, tick, policy.run(part, *state))


def expected(golden, part, tick):
    return {name: golden[f"expect/{part}/{name}"][tick : tick + 1] for name in BRANCH_OUTPUTS}


def main():
    parser = argparse.ArgumentParser(description="Check a bundle with the ONNX checker and ONNX Runtime.")
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--tolerance", type=float, default=1e-5, help="largest absolute error (default 1e-5)")
    arguments = parser.parse_args()
    try:
        manifest = tomllib.loads((arguments.bundle / "manifest.toml").read_text())
        parts = {part["name"]: part["file"] for part in manifest["parts"]}
        golden = read_safetensors(arguments.bundle / manifest["golden"]["file"])
        initial = read_safetensors(arguments.bundle / manifest["initial"]["file"])
    except (OSError, KeyError, ValueError) as error:
        print(f"check_bundle: {arguments.bundle}: {error}", file=sys.stderr)
        return 2

    good = True
    operators = {}
    for name, file in parts.items():
        try:
            operators[name] = check_graph(arguments.bundle / file)
        except Exception as error:  # The checker raises several types; each is a failed part.
            print(f"{name:<12} FAIL  checker: {error}")
            good = False
    if not good:
        return 1
    policy = Policy(arguments.bundle, parts)
    alone, recurrent = Errors(golden), Errors(golden)
    replay(policy, golden, initial, alone, recurrent=False)
    replay(policy, golden, initial, recurrent, recurrent=True)
    print(f"{'part':<12}       {'alone':>9}  {'recurrent':>9}  compared  operators")
    for name in parts:
        largest = max(alone.largest.get(name, np.inf), recurrent.largest.get(name, np.inf))
        within = largest <= arguments.tolerance
        good = good and within
        errors = f"{alone.largest.get(name, np.nan):9.2e}  {recurrent.largest.get(name, np.nan):9.2e}"
        print(f"{name:<12} {'ok  ' if within else 'FAIL'}  {errors}  {alone.compared.get(name, 0):8}  {len(operators[name])}")
    ticks = len(golden["input/is_first"])
    print(f"{'all parts' if good else 'NOT all parts'} within {arguments.tolerance:g} over {ticks} ticks")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
