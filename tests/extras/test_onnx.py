"""extras/onnx.py: another software runs the policy and comes to the same actions."""

import json

import numpy as np
import pytest

import character
from env import observation_terms, slices_of
from extras import onnx as export
from extras.policies import input_names
from plumbing.cli import UserError
from policy import Policy, load_policy

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")


def run(model, obs, char, devices=3):
    """The model's outputs for raw observations, cut into its named inputs."""
    session = runtime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    cuts = slices_of(observation_terms(char, devices, asymmetric=False))
    assert [i.name for i in session.get_inputs()] == list(cuts)
    return session.run(["action", "torque"], {name: obs[:, s] for name, s in cuts.items()})


@pytest.mark.parametrize("name, devices", [("jesse", 3), ("dino", 3), ("oppy", 3), ("jesse-hmd", 1)])
def test_same_as_ours(name, devices):
    """The shipped policies, far beyond both clippings too, agree to 1e-5."""
    policy, _ = load_policy(character.CHARACTERS / f"{name}.npz")
    char = character.load(name.removesuffix("-hmd"))
    rng, n = np.random.default_rng(0), policy.norm
    size = policy.obs_size
    obs = n.mean[:size] + rng.standard_normal((64, size)) / n.inv_std[:size] * rng.choice([0.5, 3.0, 100.0], (64, 1))
    obs = obs.astype(np.float32)
    action, torque = run(export.model_of(policy, char, devices, {}), obs, char, devices)
    want = np.clip(policy.mean_action(obs), -1.0, 1.0)
    np.testing.assert_allclose(action, want, atol=1e-5)
    np.testing.assert_allclose(torque, want * char.limits, atol=1e-5 * char.limits.max())
    assert (np.abs(want) == 1.0).any() and (np.abs(want) < 1.0).any()


def test_tanh_and_wrong_sizes():
    char, rng = character.load("jesse"), np.random.default_rng(1)
    size = sum(observation_terms(char)["actor"].values())
    policy = Policy(size, size, len(char.limits), (16, 8), (8,), 0.1, 1.0, rng, activation="tanh")
    policy.theta_pi += rng.standard_normal(policy.theta_pi.shape).astype(np.float32)
    obs = rng.standard_normal((5, size)).astype(np.float32)
    action, _ = run(export.model_of(policy, char, 3, {}), obs, char)
    np.testing.assert_allclose(action, np.clip(policy.mean_action(obs), -1, 1), atol=1e-5)
    with pytest.raises(UserError, match="the policy has .* observations .*; valid: .* as dino has"):
        export.model_of(policy, character.load("dino"), 3, {})


def test_metadata():
    """Every number of the observation has its name, in order; units of all inputs and outputs; the hinges driven."""
    for name in ("jesse", "dino"):
        char = character.load(name)
        notes = export.described(char, 3)
        inputs = json.loads(notes["inputs"])
        assert [f"{t}.{n}" for t, names in inputs.items() for n in names] == input_names(char, 3, asymmetric=False)
        assert set(json.loads(notes["units"])) == {*inputs, "action", "torque"}
        assert len(json.loads(notes["outputs"])) == len(char.limits) == len(json.loads(notes["torque_limits"]))
        assert notes["control_rate"] == "30 Hz" and "z up" in notes["frame"]


def test_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export.main(["oppy"])
    assert "oppy.onnx: q 40, qd 46, x" in capsys.readouterr().out
    model = onnx.load(tmp_path / "oppy.onnx")
    notes = {p.key: p.value for p in model.metadata_props}
    assert "Attribution-NonCommercial" in notes["licence"] and notes["character"] == "oppy"
    with pytest.raises(UserError, match="nobody"):
        export.main(["nobody"])
