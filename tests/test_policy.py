"""policy.py: what is saved is what was trained, and broken files are refused."""

import numpy as np
import pytest
from test_ppo import trainer_of

from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, save_checkpoint
from policy import Policy, check_fits, load_policy, sensors_of, total_steps, trained_as


def test_policy_round_trip(tmp_path, char, ref):
    """What is played is what was trained: the normaliser is in the file, and frozen."""
    t = trainer_of(char, ref)
    t.collect(), t.update()
    t.save(tmp_path / CHECKPOINT, {"options": {"character": "jesse"}})
    for path in (tmp_path, tmp_path / CHECKPOINT):
        policy, meta = load_policy(path)
        assert meta["steps"] == t.steps and meta["options"]["character"] == "jesse"
        for name, value in t.policy.arrays().items():
            np.testing.assert_array_equal(policy.arrays()[name], value, err_msg=name)
        obs = t.env.full[:, : t.env.obs_size]
        expected = t.policy.actor(t.policy.norm.normalise(t.env.full)[:, : t.env.obs_size])
        np.testing.assert_array_equal(policy.mean_action(obs), expected)
        assert policy.norm.frozen and np.abs(policy.norm.mean).max() > 0.1
        policy.norm.update(np.full((100, t.env.critic_size), 50.0))
        np.testing.assert_array_equal(policy.mean_action(obs), expected)
    check_fits(policy, t.env, tmp_path)


def test_broken_policies(tmp_path):
    policy = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    arrays, meta = policy.arrays(), {"policy": policy.shape()}
    path = tmp_path / "p.npz"
    save_checkpoint(path, arrays, meta)
    whole = path.read_bytes()
    assert load_policy(path)[0].shape() == policy.shape()

    def saved(new_arrays=arrays, new_meta=meta):
        save_checkpoint(path, new_arrays, new_meta)

    def foreign():
        np.savez(path, a=np.zeros(3))

    nan = arrays["policy.pi"].copy()
    nan[3] = np.nan
    cases = [
        lambda: path.write_bytes(whole[: len(whole) // 2]),
        lambda: path.write_bytes(b""),
        lambda: path.write_text("not a zip"),
        foreign,
        lambda: saved(new_meta={}),
        lambda: saved(new_meta={"policy": 3}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"hidden": [5]}}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"hidden": ["x"]}}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"more": 1}}),
        lambda: saved({k: v for k, v in arrays.items() if k != "policy.pi"}),
        lambda: saved({k: v for k, v in arrays.items() if k != "policy.norm.count"}),
        lambda: saved(arrays | {"policy.pi": np.zeros(1, np.float32)}),  # would broadcast
        lambda: saved(arrays | {"policy.norm.mean": np.zeros(3)}),
        lambda: saved(arrays | {"policy.pi": nan}),
    ]
    for i, breaks in enumerate(cases):
        breaks()
        with pytest.raises(UserError, match="p.npz") as error:
            load_policy(path)
        assert len(str(error.value).splitlines()) == 1, i
    for missing in (tmp_path / "none.npz", tmp_path / "none"):
        with pytest.raises(UserError, match="no checkpoint"):
            load_policy(missing)
    path.unlink()
    with pytest.raises(UserError, match="holds no checkpoint"):
        load_policy(tmp_path)


def test_play_clips_observations_as_training(char, ref):
    t = trainer_of(char, ref)
    far = t.env.full + 100.0
    want = t.policy.actor(t.policy.norm.normalise(far)[:, : t.env.obs_size])
    np.testing.assert_allclose(t.policy.mean_action(far[:, : t.env.obs_size]), want, rtol=1e-5, atol=1e-6)


def test_sensors_of_a_policy():
    """What a file says it was trained with, and what it may not say."""
    assert sensors_of({}, "p.npz") == sensors_of({"options": {}}, "p.npz") == "full"
    assert sensors_of({"options": {"sensors": "hmd"}}, "p.npz") == "hmd"
    for odd in ({"sensors": "three"}, {"sensors": 3}, "hmm"):
        with pytest.raises(UserError, match="p.npz: its options have sensors .*; valid: full, hmd"):
            sensors_of({"options": odd}, "p.npz")
    assert total_steps({"steps": 5, "before": 7}) == 12 and total_steps({"steps": "5"}) == 0
    assert trained_as({"options": {"character": "oppy", "scale": 1.5}}, "p.npz").scale == 1.5
    assert trained_as({"options": {}}, "p.npz") is None
