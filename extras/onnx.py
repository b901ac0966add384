r"""A policy as ONNX, for game engines and anything else that runs networks.

    python -m extras.onnx jesse [--out jesse.onnx]        needs the extra `onnx`

    q, qd, x, R, user_previous, user ──► concatenate ──► (o − mean) / std ──► clip ──► actor ──► clip ──► action
                                                                                          × limit ──► torque

Inputs are the terms of the observation [Reda23 Eqs. 2 to 4], (N, size) each, float32, SI units, in the heading frame:
on the floor below the root, x forward along the root's heading, y left, z up, right-handed.  The names of every input's
numbers, units, rates and the weights' licence are in the file's metadata (`inputs`, `units`, `control_rate`, …).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from character import Character, Switches
from env import SUBSTEPS, observation_terms
from extras.policies import input_names
from mocap.data import CONTROL_RATE
from nn import LEAKY_SLOPE
from plumbing.cli import UserError, arg, cli, run_main
from plumbing.files import atomic_write, check_folders
from policy import Policy, devices_of, find_policy, load_character, total_steps

OPSET, IR = 17, 8  # of 2022: what Unity's and Unreal's importers read
UNITS = {
    "q": "rad, hinge angles",
    "qd": "m/s and rad/s of the root, in the frame; then rad/s of the hinges",
    "x": "m, links' origins",
    "R": "first two columns of the links' rotations, row by row",
    "user_previous": "as user, one control step before, in the frame of now",
    "user": "m, headset and controllers; then the first two columns of their rotations, row by row",
    "action": "share of the torque limit, -1 to 1",
    "torque": "N m, of the driven hinges",
}


@dataclass
class Options(Switches):
    """Which policy, and where to write it."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    policy: str | None = arg(None, "run folder or policy .npz; characters/NAME.npz by default")
    out: str | None = arg(None, "file to write; NAME.onnx by default")


def model_of(policy: Policy, char: Character, devices: int, notes: dict):
    """The actor, its normaliser and both clippings as an ONNX model.

    Args      notes : more metadata, name -> text
    Returns   onnx.ModelProto
    Raises    UserError: ONNX is not installed, or the policy is of another character
    Test      tests/extras/test_onnx.py::test_same_as_ours
    """
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError:
        raise UserError('ONNX is not installed: needed for this; pip install -e ".[onnx]"') from None
    terms = observation_terms(char, devices, asymmetric=False)["actor"]
    if sum(terms.values()) != policy.obs_size or len(char.limits) != policy.action_size:
        sizes = f"{policy.obs_size} observations and {policy.action_size} actions"
        valid = f"{sum(terms.values())} and {len(char.limits)} as {char.name} has"
        raise UserError(f"the policy has {sizes}; valid: {valid}")
    norm, n = policy.norm, policy.obs_size
    constants = {
        "mean": norm.mean[:n],
        "inv_std": norm.inv_std[:n],
        "least": np.float32(-norm.clip),
        "most": np.float32(norm.clip),
        "minus_one": np.float32(-1),
        "one": np.float32(1),
        "limit": char.limits,
        **policy.actor.params,
    }
    nodes = [
        helper.make_node("Concat", list(terms), ["observation"], axis=1),
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Mul", ["centred", "inv_std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "least", "most"], ["h0"]),
    ]
    last = policy.actor.n_layers - 1
    for i in range(last + 1):
        nodes.append(helper.make_node("Gemm", [f"h{i}", f"W{i}", f"b{i}"], [f"y{i}"]))
        if i < last and policy.activation == "tanh":
            nodes.append(helper.make_node("Tanh", [f"y{i}"], [f"h{i + 1}"]))
        elif i < last:
            nodes.append(helper.make_node("LeakyRelu", [f"y{i}"], [f"h{i + 1}"], alpha=LEAKY_SLOPE))
    nodes.append(helper.make_node("Clip", [f"y{last}", "minus_one", "one"], ["action"]))
    nodes.append(helper.make_node("Mul", ["action", "limit"], ["torque"]))
    vector = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])  # noqa: E731
    graph = helper.make_graph(
        nodes,
        char.name,
        [vector(name, size) for name, size in terms.items()],
        [vector(name, policy.action_size) for name in ("action", "torque")],
        [numpy_helper.from_array(np.asarray(v, np.float32), name) for name, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    helper.set_model_props(model, notes | described(char, devices))
    onnx.checker.check_model(model)
    return model


def described(char: Character, devices: int) -> dict:
    """The metadata of a character's policy: names and units of the inputs, joints of the outputs, rates, the frame.

    Test      tests/extras/test_onnx.py::test_metadata"""
    names = input_names(char, devices, asymmetric=False)
    terms = observation_terms(char, devices, asymmetric=False)["actor"]
    inputs = {t: [n.removeprefix(f"{t}.") for n in names if n.startswith(f"{t}.")] for t in terms}
    driven = np.array(char.hinges)[char.driven].tolist()
    return {
        "character": char.name,
        "inputs": json.dumps(inputs),
        "outputs": json.dumps(driven),
        "units": json.dumps(UNITS),
        "frame": "on the floor below the root, turned with its heading: x forward, y left, z up, right-handed; metres",
        "torque_limits": json.dumps([round(float(v), 6) for v in char.limits]),
        "control_rate": f"{CONTROL_RATE:g} Hz",
        "physics_rate": f"{CONTROL_RATE * SUBSTEPS:g} Hz",
    }


def main(argv=None) -> None:
    """python -m extras.onnx NAME: write a policy as ONNX.  Test: tests/extras/test_onnx.py::test_command_line"""
    argv = list(argv or [])
    if argv and not argv[0].startswith("-"):
        argv[:1] = ["--character", argv[0]]
    opt = cli(Options, argv, "python -m extras.onnx", __doc__)
    policy, path, meta = find_policy(opt)
    char = load_character(opt, meta, path)
    out = Path(opt.out or f"{char.name}.onnx")
    check_folders(out, read=(path,))
    notes = {"licence": str(meta.get("licence", "not said")), "policy": Path(path).name}
    notes["steps"] = str(total_steps(meta))
    model = model_of(policy, char, devices_of(meta, path, None), notes)
    atomic_write(out, model.SerializeToString())
    sizes = ", ".join(f"{i.name} {i.type.tensor_type.shape.dim[1].dim_value}" for i in model.graph.input)
    print(f"{out}: {sizes} -> action, torque {policy.action_size}; {notes['licence']}")


if __name__ == "__main__":
    run_main(main)
