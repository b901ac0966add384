"""Tests of env.py: reward, observation, termination and physics, each against one slow MjData an environment."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import character
import retarget
from character import TERMS
from env import (
    FORCE_LIMIT,
    WITHOUT,
    Env,
    HeadingFrame,
    Uniform,
    ablated,
    action_diff,
    action_min,
    contact_distance,
    fallen,
    headset_only,
    kernel,
    observation_terms,
    orientation_distance,
    too_far,
    total_reward,
    weighted_distance,
)
from human import Clip, heading, place, resample
from mocap import data, gait
from plumbing.cli import UserError
from retarget import STAGE_VEL

N = 8
IMITATION = ("q", "qd", "x", "xd", "orientation")


def clip_of(kind, seconds=6.0, seed=0, **params) -> Clip:
    m = gait.generate(kind, seconds, seed=seed, **params)
    return Clip(f"{kind}_{seed}", kind, m["rate"], m["pos"], m["quat"], m["ball"])


@pytest.fixture(scope="module")
def clips():
    return [clip_of("walk"), clip_of("turn", turn_rate=0.8), clip_of("gesture", 4.0, gesture="both_up")]


@pytest.fixture(scope="module")
def shared():
    return character.load("jesse")


@pytest.fixture
def char(shared):
    """A character whose reward table a test may change; contact and every other term counts."""
    return dataclasses.replace(shared, reward=shared.reward | {"contact": (1.5, 1.0)})


@pytest.fixture(scope="module")
def ref(shared, clips):
    return retarget.reference(shared, clips)


@pytest.fixture
def rng():
    return np.random.default_rng(20230)


def wander(env, rng, steps=5, size=0.3):
    """A few steps with small random actions: a state that is not on the reference."""
    for _ in range(steps):
        out = env.step(size * rng.standard_normal((env.n, env.action_size)))
    return out


def fresh(env, i):
    """A new MjData of environment i's state, everything computed."""
    d = mujoco.MjData(env.char.model)
    d.qpos[:], d.qvel[:] = env.qpos[i], env.qvel[i]
    mujoco.mj_forward(env.char.model, d)
    return d


def velocity(d, body):
    """Angular and linear velocity of a body's origin, world."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(d.model, d, mujoco.mjtObj.mjOBJ_XBODY, body, out, 0)
    return out[:3], out[3:]


def rotation(quat):
    return Rotation.from_quat(quat, scalar_first=True)


# ----------------------------------------------------------------------------------------- observation


def slow_observation(env, i):
    """Eqs. 2 to 4 and the critic's part for one environment, written from the paper."""
    d, ref, f, m = fresh(env, i), env.ref, env.frame[i], env.char.model
    start, end = next((a, b) for a, b in zip(ref.first, ref.last, strict=True) if a <= f <= b)
    left = d.xmat[env.char.root].reshape(3, 3)[:, 1]  # the body's left axis, laid on the floor
    to_heading = Rotation.from_euler("z", math.atan2(-left[0], left[1])).inv().as_matrix()
    origin = np.array([d.qpos[0], d.qpos[1], 0.0])

    def point(p):
        return to_heading @ (np.asarray(p, float) - origin)

    def six(r):
        return (to_heading @ np.asarray(r, float))[:, :2].ravel()  # rows of the first two columns

    def user(f):
        quats = [rotation(q).as_matrix() for q in ref.sensor_quat[f]]
        return np.concatenate([*(point(p) for p in ref.sensor_pos[f]), *(six(r) for r in quats)])

    spin, _ = velocity(d, env.char.root)
    links = [m.body(n).id for n in ("pelvis", "spine3", "head", "hand_l", "hand_r", "foot_l", "foot_r")]
    terms = {
        "q": d.qpos[7:],
        "qd": np.concatenate([to_heading @ d.qvel[:3], to_heading @ spin, d.qvel[6:]]),
        "x": np.concatenate([point(d.xpos[b]) for b in links]),
        "R": np.concatenate([six(d.xmat[b].reshape(3, 3)) for b in links]),
        "user_previous": user(max(f - 1, start)),  # in the frame of time t
        "user": user(f),
        "human_pos": np.concatenate([point(p) for p in ref.human_pos[f]]),
        "human_rot": np.concatenate([(to_heading @ r).ravel() for r in ref.human_rot[f]]),
    }
    for k in (1, 5, 15):
        terms[f"human_pos_in_{k}"] = np.concatenate([point(p) for p in ref.human_pos[min(f + k, end)]])
    return terms


def test_observation_terms(shared, ref, rng):
    """Every term of every environment, after some steps and after a reset, in order; also near a sequence's end."""
    env = Env(shared, ref, N, horizon=500)
    ends = np.array([ref.last[0] - 8, ref.last[1] - 7, ref.first[2] + 3, 40, 41, ref.first[1], 200, 0])
    env.reset(3, frames=ends)
    for steps in (0, 5):
        if steps:
            wander(env, rng, steps)
        for i in range(N):
            want = slow_observation(env, i)
            assert list(want) == list(env.slices)
            for name, value in want.items():
                found = env.full[i, env.slices[name]]
                np.testing.assert_allclose(found, value, rtol=1e-5, atol=2e-5, err_msg=f"{name} of {i}")
    j, links = 33, 7
    sizes = dict(q=j, qd=6 + j, x=3 * links, R=6 * links, user_previous=27, user=27)
    assert env.terms["actor"] == sizes == observation_terms(shared)["actor"]
    assert env.obs_size == sum(sizes.values()) == 189 and env.action_size == 33
    assert env.critic_size == 189 + 15 * 3 + 15 * 6 + 3 * 15 * 3 == env.full.shape[1]
    # The difference of the two user parts is how far the devices went: o_{t-1} is in the frame of t.
    moved = env.full[3, env.slices["user"]] - env.full[3, env.slices["user_previous"]]
    f = env.frame[3]
    want = np.linalg.norm(ref.sensor_pos[f] - ref.sensor_pos[f - 1], axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved[:9].reshape(3, 3), axis=1), want, atol=1e-5)


@pytest.mark.parametrize("pitch", [0.0, 1.2, 2.2, -1.9])  # upright, bent over, head down, looking up and beyond
def test_heading_invariance(char, clips, ref, rng, pitch):
    """The whole world turned and shifted: same observation, same reward."""
    yaw, shift = rng.uniform(-3, 3), rng.uniform(-50, 50, 2)
    there = retarget.reference(char, [place(c, yaw, (0, 0), shift) for c in clips])
    a, b = Env(char, ref, N, seed=1), Env(char, there, N, seed=1)
    a.reset(), b.reset()
    np.testing.assert_array_equal(a.frame, b.frame)
    np.testing.assert_allclose(a.full, b.full, atol=5e-5)
    wander(a, rng)
    tilt = Rotation.from_euler("ZYX", [(rng.uniform(-3, 3), pitch, rng.uniform(-0.3, 0.3)) for _ in range(N)])
    a.qpos[:, 3:7] = tilt.as_quat(scalar_first=True)
    turn = Rotation.from_euler("z", yaw)
    for name in ("qpos", "qvel", "frame", "sequence", "action"):
        getattr(b, name)[:] = getattr(a, name)
    b.contact = a.contact
    b.qpos[:, :3] = turn.apply(a.qpos[:, :3]) + [*shift, 0]
    b.qpos[:, 3:7] = (turn * rotation(a.qpos[:, 3:7])).as_quat(scalar_first=True)
    b.qvel[:, :3] = turn.apply(a.qvel[:, :3])  # the root's angular velocity is in its own frame
    for e in (a, b):
        e.batch.forward(None, STAGE_VEL)
        e.observe(slice(None))
    np.testing.assert_allclose(a.full, b.full, rtol=1e-5, atol=5e-5)
    action = rng.uniform(-1, 1, (N, 33))
    ta, tb = a.reward_terms(action), b.reward_terms(action)
    for name in TERMS:
        np.testing.assert_allclose(ta[name], tb[name], rtol=1e-4, atol=1e-7, err_msg=name)


def test_headset_only(shared, ref, rng):
    """§4.2: the observation without the controllers' numbers, and nothing else is different."""
    less = headset_only(ref)
    assert less.sensor_pos.shape == (len(ref), 1, 3) and ref.sensor_pos.shape == (len(ref), 3, 3)
    for asymmetric in (True, False):
        a, b = (Env(shared, r, N, seed=1, asymmetric=asymmetric) for r in (ref, less))
        a.reset(), b.reset()
        for _ in range(3):
            action = 0.2 * rng.standard_normal((N, 33))
            out_a, out_b = a.step(action), b.step(action)
            np.testing.assert_array_equal(out_a[1], out_b[1])
        gone = [a.slices[term].start + k for term in ("user_previous", "user") for k in (*range(3, 9), *range(15, 27))]
        keep = np.setdiff1d(np.arange(a.full.shape[1]), gone)  # of the three positions and rotations the first
        assert b.obs_size == a.obs_size - 2 * 18 and b.full.shape[1] == a.full.shape[1] - 36 == len(keep)
        np.testing.assert_array_equal(b.full, a.full[:, keep])
        np.testing.assert_array_equal(b.full[:, : b.obs_size], a.full[:, keep[: b.obs_size]])
        for i in range(N):
            want = slow_observation(a, i)
            for name in ("user_previous", "user"):  # headset's position and six numbers of its rotation
                nine = np.concatenate([want[name][:3], want[name][9:15]])
                np.testing.assert_allclose(b.full[i, b.slices[name]], nine, atol=2e-5)


def test_symmetric_critic(shared, ref, rng):
    """§5.3: the critic sees what the actor sees; the actor, the rewards and the motion do not change."""
    a, b = Env(shared, ref, N, seed=1, horizon=6), Env(shared, ref, N, seed=1, horizon=6, asymmetric=False)
    a.reset(), b.reset()
    assert b.critic_size == b.obs_size == a.obs_size < a.critic_size and b.terms["critic"] == {}
    for _ in range(8):  # across resets
        action = 0.2 * rng.standard_normal((N, 33))
        (obs_a, reward_a, *ends_a, info_a), (obs_b, reward_b, *ends_b, info_b) = a.step(action), b.step(action)
        np.testing.assert_array_equal(obs_a, obs_b)
        np.testing.assert_array_equal(reward_a, reward_b)
        np.testing.assert_array_equal(ends_a, ends_b)
        assert info_b["critic"].shape == obs_b.shape
        assert ("final_obs" in info_a) == ("final_obs" in info_b)
        if "final_obs" in info_a:
            np.testing.assert_array_equal(info_a["final_obs"], info_b["final_critic"])


def test_heading_does_not_flip():
    """Bending over to looking straight up: the devices in front stay in front."""
    pitch = np.linspace(-3.0, 3.0, 61)
    quat = (Rotation.from_euler("z", 0.7) * Rotation.from_euler("y", pitch[:, None])).as_quat(scalar_first=True)
    root = np.tile([3.0, -2.0, 0.9], (61, 1))
    ahead = np.array([math.cos(0.7), math.sin(0.7), 0.0])
    frame = HeadingFrame(root, quat)
    placed = frame.place((root + ahead)[:, None], np.zeros((61, 1, 3)))
    np.testing.assert_allclose(placed[:, 0], np.tile([1.0, 0.0, 0.9], (61, 1)), atol=1e-12)
    turned = frame.turn(np.tile(ahead, (61, 1, 1)), np.zeros((61, 1, 3)))
    np.testing.assert_allclose(turned[:, 0], np.tile([1.0, 0.0, 0.0], (61, 1)), atol=1e-12)


# ----------------------------------------------------------------------------------------- reward


def test_reward_terms(char, ref, rng):
    """Eqs. 8 to 11 and the App. A distances as loops; first the functions, then the environment's own terms."""
    w, k = 2.5, 6.0
    q, q2, weights = rng.normal(size=(3, 33)), rng.normal(size=(3, 33)), character.normalised(rng.uniform(0, 1, 33))
    x, x2, wl = rng.normal(size=(3, 6, 3)), rng.normal(size=(3, 6, 3)), character.normalised([1, 1, 2, 0, 3, 1])
    quat, quat2 = (Rotation.random(6, rng=rng).as_quat(scalar_first=True).reshape(3, 2, 4) for _ in range(2))
    c, c2 = np.array([[1, 0], [1, 1], [0, 1]], bool), np.array([[1, 0], [0, 0], [1, 1]], bool)
    for n in range(3):
        d_q = sum(weights[i] * (q[n, i] - q2[n, i]) ** 2 for i in range(33))
        d_x = sum(wl[i] * sum((x[n, i, a] - x2[n, i, a]) ** 2 for a in range(3)) for i in range(6))
        d_o = sum((rotation(quat2[n, i]) * rotation(quat[n, i]).inv()).magnitude() for i in range(2)) / 2
        d_c = math.sqrt(sum((int(c[n, i]) - int(c2[n, i])) ** 2 for i in range(2)))
        d_diff = sum((q2[n, i] - q[n, i]) ** 2 for i in range(33)) / 33
        d_min = sum(q[n, i] ** 2 for i in range(33)) / 33
        for found, d in (
            (weighted_distance(q, q2, weights), d_q), (weighted_distance(x, x2, wl), d_x),
            (orientation_distance(quat, quat2), d_o), (orientation_distance(-quat, quat2), d_o),
            (contact_distance(c, c2), d_c), (action_diff(q2, q), d_diff), (action_min(q), d_min),
        ):  # fmt: skip
            assert found.shape == (3,) and found[n] == pytest.approx(d, rel=1e-9)
            assert kernel(w, k, found)[n] == pytest.approx(w * math.exp(-k * d), rel=1e-9)

    env = Env(char, ref, N, seed=5)
    env.reset()
    wander(env, rng, 3)
    before = env.action.copy()
    action = rng.uniform(-1, 1, (N, 33))
    found, m = env.reward_terms(action), char.model
    links = [m.body(n).id for n in ("pelvis", "head", "hand_l", "hand_r", "foot_l", "foot_r")]
    for i in range(N):
        d, f = fresh(env, i), env.frame[i]
        # the reference's links and velocities from a second MjData at the reference's pose
        e = mujoco.MjData(m)
        e.qpos[:], e.qvel[:] = ref.qpos[f], ref.qvel[f]
        mujoco.mj_forward(m, e)
        human = rotation(ref.orientation[f])
        feet = [env.contact[i, s] != ref.contact[f, s] for s in range(2)]
        distance = dict(
            q=sum((d.qpos[7 + h] - ref.qpos[f, 7 + h]) ** 2 for h in range(33)) / 33,
            qd=sum((d.qvel[6 + h] - ref.qvel[f, 6 + h]) ** 2 for h in range(33)) / 33,
            x=sum(np.sum((d.xpos[b] - e.xpos[b]) ** 2) for b in links) / 6,
            xd=sum(np.sum((velocity(d, b)[1] - velocity(e, b)[1]) ** 2) for b in links) / 6,
            orientation=sum((human[p] * rotation(d.xquat[b]).inv()).magnitude()
                            for p, b in enumerate((m.body("pelvis").id, m.body("head").id))) / 2,
            contact=math.sqrt(sum(feet)),
            action_diff=sum((action[i] - before[i]) ** 2) / 33,
            action_min=sum(action[i] ** 2) / 33,
        )  # fmt: skip
        for name in TERMS:
            w, k = char.reward[name]
            assert found[name][i] == pytest.approx(w * math.exp(-k * distance[name]), rel=1e-4), name


def test_total_reward(rng):
    """Eqs. 5 to 7: imitation (five terms), contact, action (two)."""
    t = {name: rng.normal(size=4) for name in TERMS}
    imitation = sum(t[name] for name in IMITATION)
    np.testing.assert_allclose(total_reward(t), imitation + t["contact"] + (t["action_diff"] + t["action_min"]))
    assert set(TERMS) == {*IMITATION, "contact", "action_diff", "action_min"}


def test_zero_weight_adds_nothing(shared, char, ref, rng):
    """Jesse's contact weight is 0; any other term can be taken out alone."""
    for name in TERMS:
        less = dataclasses.replace(char, reward=char.reward | {name: (0.0, char.reward[name][1])})
        a, b = Env(char, ref, N, seed=2), Env(less, ref, N, seed=2)
        a.reset(), b.reset()
        action = rng.uniform(-1, 1, (N, 33))
        _, ra, *_, ia = a.step(action)
        _, rb, *_, ib = b.step(action)
        assert not ib["terms"][name].any() and ia["terms"][name].all()
        np.testing.assert_allclose(ra - rb, ia["terms"][name], atol=1e-12)
    env = Env(shared, ref, N, seed=2)
    env.reset()
    assert not wander(env, rng, 1)[4]["terms"]["contact"].any()


def test_ablated(shared, char, clips, ref, rng):
    """§3.5.1, §4.3: exactly the terms named are gone; the others, and the character, stay."""
    names = {"contact": {"contact"}, "orientation": {"orientation"}, "action": {"action_diff", "action_min"}}
    names |= {"imitation": {"q", "qd", "x", "xd"}, "asymmetric": set()}
    assert set(WITHOUT) == set(names)
    full = Env(char, ref, N, seed=2)
    full.reset()
    action = rng.uniform(-1, 1, (N, 33))
    _, reward, *_, info = full.step(action)
    for without in (*((n,) for n in names), ("contact", "imitation"), ("orientation", "action")):
        gone = set().union(*(names[n] for n in without))
        less = ablated(char, without)
        assert {t for t in TERMS if less.reward[t][0] == 0.0} == gone
        assert all(less.reward[t] == char.reward[t] for t in TERMS if t not in gone)
        env = Env(less, ref, N, seed=2)
        env.reset()
        _, found, *_ = env.step(action)
        np.testing.assert_allclose(found, reward - sum(info["terms"][t] for t in gone), atol=1e-12)
    assert char.reward["q"][0] > 0 and char.reward["fail"] == ablated(char, ("action",)).reward["fail"]

    root = ablated(char, track="root")
    assert {t for t in TERMS if root.reward[t][0] == 0.0} == {"q", "qd", "xd"}
    env = Env(root, retarget.reference(root, clips), N, seed=2)
    env.reset()
    terms, (w, k) = env.step(action)[4]["terms"], char.reward["x"]
    for i in np.flatnonzero(env.steps):  # those that did not begin anew
        d = np.sum((env.qpos[i, :3] - ref.qpos[env.frame[i], :3]) ** 2)
        assert terms["x"][i] == pytest.approx(w * math.exp(-k * d), rel=1e-6)
        assert terms["orientation"][i] == pytest.approx(info["terms"]["orientation"][i])
    assert len(char.reward_links) == 6  # the argument is as it was
    with pytest.raises(UserError, match="no reward is left"):
        ablated(char, ["imitation", "orientation", "action", "contact"])
    for wrong in ({"without": ["gravity"]}, {"track": "head"}, {"without": ["imitation"], "track": "root"}):
        with pytest.raises(UserError, match="valid: contact, orientation, action|valid: all, root|no --without im"):
            ablated(char, **wrong)


# ----------------------------------------------------------------------------------------- physics


def test_kinematics_are_fresh(shared, ref, rng):
    """After a step every position and velocity belongs to the state after it (not, as after mj_step, before)."""
    env = Env(shared, ref, N, seed=4)
    env.reset()
    wander(env, rng)
    links = shared.reward_links
    velocities = env.link_velocity()
    for i in range(N):
        d = mujoco.MjData(shared.model)
        d.qpos[:] = env.qpos[i]
        mujoco.mj_kinematics(shared.model, d)
        for name in ("xpos", "xquat", "xmat", "geom_xpos", "geom_xmat"):
            np.testing.assert_allclose(getattr(env, name)[i], getattr(d, name), atol=1e-12, err_msg=name)
        d = fresh(env, i)
        np.testing.assert_allclose(env.cvel[i], d.cvel, atol=1e-9)
        np.testing.assert_allclose(env.com[i], d.subtree_com, atol=1e-12)
        np.testing.assert_allclose(velocities[i], [velocity(d, b)[1] for b in links], atol=1e-9)
    env.batch.step()  # without the refresh they would lag
    assert np.abs(env.xpos[0] - fresh(env, 0).xpos).max() > 1e-4


def test_refresh_changes_nothing(shared, ref, rng):
    """It leaves contacts and limits out; where the bodies are, and all later physics, are as with MuJoCo's own."""
    a, b = Env(shared, ref, N, seed=4), Env(shared, ref, N, seed=4)
    for e in (a, b):
        e.reset()
        e.qpos[0, 2] -= 0.03  # into the floor
    for _ in range(3):
        action = rng.uniform(-1, 1, (N, 33))
        for e in (a, b):
            e.ctrl[:] = action
        a.batch.step(nstep=4)
        a.refresh()
        b.batch.step(nstep=4, stage=STAGE_VEL)
        for name in ("qpos", "qvel", "warmstart", "xpos", "xmat", "xquat", "cvel", "com", "geom_xpos", "geom_xmat"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert np.abs(b.sensordata).max() > 10.0  # feet press on the floor


def test_step_is_four_mj_steps(shared, ref, rng):
    """One control step is 1/30 s: four steps of 1/120 s with torque = limit × clipped action, of one MjData."""
    env = Env(shared, ref, 3, seed=8)
    env.reset()
    assert env.dt == pytest.approx(1 / 30) and env.substeps == 4
    assert shared.model.opt.timestep == pytest.approx(1 / 120)
    datas = [fresh(env, i) for i in range(3)]
    for d in datas:
        d.qacc_warmstart[:] = 0
    action = rng.normal(0, 1, (3, 33))
    env.step(action)
    for i, d in enumerate(datas):
        d.ctrl[:] = np.minimum(np.maximum(action[i], -1), 1)
        for _ in range(4):
            mujoco.mj_step(shared.model, d)
        np.testing.assert_allclose(env.qpos[i], d.qpos, atol=1e-9)
        np.testing.assert_allclose(env.qvel[i], d.qvel, atol=1e-7)
        forces = [shared.limits[k] * min(max(action[i, k], -1), 1) for k in range(33)]
        np.testing.assert_allclose(d.qfrc_actuator[6:], forces, rtol=1e-12)


def test_contact_forces(ref, rng):
    """A statue stands on both feet and they carry its weight; in the air there is no contact at all."""
    statue = character.load("jesse")
    m = statue.model
    m.jnt_stiffness[1:] *= 50.0
    m.dof_damping[6:] *= 50.0
    weight = 9.81 * m.body_mass.sum()
    env = Env(statue, ref, 3)
    env.reset()
    env.qpos[:] = np.concatenate([[0, 0, statue.hip_height - 1e-3, 1, 0, 0, 0], statue.default])
    env.qpos[1, :3] += [3.0, 2.0, 0.5]
    env.qpos[2, 3:7] = Rotation.from_euler("z", 2.0).as_quat(scalar_first=True)
    env.qvel[:], env.ctrl[:] = 0.0, 0.0
    env.batch.step(nstep=1, stage=STAGE_VEL)
    assert env._contact()[[0, 2]].all() and not env._contact()[1].any() and not env.sensordata[1].any()
    env.batch.step(nstep=600, stage=STAGE_VEL)
    assert env._contact().all()
    assert np.abs(env.qvel).max() < 0.05
    normal = env.sensordata[:, statue.contact_adr]
    assert np.all(normal > FORCE_LIMIT)
    np.testing.assert_allclose(normal.sum(axis=1), weight, rtol=0.02)
    for foot, name in enumerate(("contact_l", "contact_r")):
        assert statue.contact_adr[foot] == m.sensor(name).adr[0] + 2  # x, y, z: the third
    env.sensordata = np.zeros((1, m.nsensordata))
    env.sensordata[:, statue.contact_adr] = [0.9, 1.1]
    assert env._contact().tolist() == [[False, True]]  # 1 N


def test_contact_is_that_of_the_last_substep(shared, ref, rng):
    """Against the sum of mj_contactForce over each foot's contacts, turned into the world."""
    env = Env(shared, ref, N, seed=9)
    env.reset()
    m = shared.model
    datas = [mujoco.MjData(m) for _ in range(N)]
    for i, d in enumerate(datas):
        d.qpos[:], d.qvel[:] = env.qpos[i], env.qvel[i]
    seen, forces, contact = set(), [], env._contact
    env._contact = lambda: (forces.append(env.sensordata.copy()), contact())[1]
    for _ in range(3):
        action = 0.2 * rng.standard_normal((N, 33))
        env.step(action)
        assert not env.steps.min() == 0  # nobody was reset
        for i, d in enumerate(datas):
            d.ctrl[:] = action[i]
            for _ in range(4):
                mujoco.mj_step(m, d)
            total = np.zeros((2, 3))
            for c in range(d.ncon):
                foot = np.flatnonzero(m.geom_bodyid[d.contact[c].geom[1]] == shared.feet)
                force = np.zeros(6)
                mujoco.mj_contactForce(m, d, c, force)
                if len(foot):
                    total[foot[0]] += d.contact[c].frame.reshape(3, 3).T @ force[:3]
            np.testing.assert_allclose(forces[-1][i, shared.contact_adr], total[:, 2], rtol=1e-4, atol=1e-3)
            assert list(env.contact[i]) == [abs(total[s, 2]) > 1.0 for s in range(2)]
            seen |= set(env.contact[i].tolist())
    assert seen == {True, False}


# ----------------------------------------------------------------------------------------- reset


def check_reset(char, ref, n=64):
    env = Env(char, ref, n, seed=6)
    env.reset()
    pose_ok = np.array([np.all((q > char.ranges[:, 0]) & (q < char.ranges[:, 1])) for q in env.qpos[:, 7:]])
    assert pose_ok.mean() > 0.9
    terms = env.reward_terms(np.zeros((n, env.action_size)))
    for name in (*IMITATION, "action_diff", "action_min"):
        np.testing.assert_allclose(terms[name][pose_ok], char.reward[name][0], rtol=1e-4, err_msg=name)
    np.testing.assert_array_equal(env.qpos, ref.qpos[env.frame])
    return env


def test_reset_reproduces_reference(char, ref):
    """The reset state earns the maximum of every imitation term; its velocity continues the motion."""
    env = check_reset(char, ref)
    assert not env.steps.any() and not env.action.any() and not env.ctrl.any()
    m, v, h, missed, way = char.model, np.zeros(char.model.nv), 1 / 30, 0.0, 0.0
    for i in range(0, 64, 5):
        f = env.frame[i]
        np.testing.assert_allclose(np.linalg.norm(env.qpos[i, 3:7]), 1.0, atol=1e-9)
        mujoco.mj_differentiatePos(m, v, 2 * h, ref.qpos[f - 1], ref.qpos[f + 1])
        np.testing.assert_allclose(env.qvel[i, [0, 1, 2, *range(6, 39)]], v[[0, 1, 2, *range(6, 39)]], atol=1e-9)
        np.testing.assert_allclose(env.qvel[i, 3:6], v[3:6], atol=0.02 + 0.1 * np.linalg.norm(v[3:6]))
        nxt = env.qpos[i].copy()  # integrated along the velocity the pose comes near the next frame's
        mujoco.mj_integratePos(m, nxt, env.qvel[i], h)
        mujoco.mj_differentiatePos(m, v, 1.0, nxt, ref.qpos[f + 1])
        moved = np.zeros(m.nv)
        mujoco.mj_differentiatePos(m, moved, 1.0, env.qpos[i], ref.qpos[f + 1])
        missed, way = missed + np.linalg.norm(v), way + np.linalg.norm(moved)
    assert missed < 0.4 * way
    wander(env, np.random.default_rng(0))
    assert env.warmstart.any() and env.action.any()
    env.reset()
    assert not env.warmstart.any() and not env.ctrl.any() and not env.action.any()  # nothing of the last episode stays
    # The links' velocities are the rates of their positions.
    rate = (ref.link_pos[2:] - ref.link_pos[:-2]) * 15.0
    inner = np.concatenate([np.arange(a + 2, b - 1) for a, b in zip(ref.first, ref.last, strict=True)])
    assert np.median(np.linalg.norm(rate[inner - 1] - ref.link_vel[inner], axis=-1)) < 0.05


def test_reset_frames(shared, ref):
    """Random starts are all frames but the first and the last of each sequence; given frames are checked."""
    env = Env(shared, ref, 3000, seed=0)
    env.reset(seed=7)
    inside = {f for a, b in zip(ref.first, ref.last, strict=True) for f in range(a + 1, b)}
    assert set(env.frame) <= inside and len(set(env.frame)) > 0.98 * len(inside)
    for f, s, k in zip(env.frame, env.sequence, env.available, strict=True):
        assert ref.first[s] < f < ref.last[s] and k == min(500, ref.last[s] - f)
    assert set(env.starts.frames) == inside and type(env.starts) is Uniform
    again = env.frame.copy()
    env.reset(seed=7)
    np.testing.assert_array_equal(env.frame, again)
    env.reset()
    assert (env.frame != again).any()
    env = Env(shared, ref, 2)
    env.reset(frames=[5, ref.last[1] - 1])
    assert list(env.frame) == [5, ref.last[1] - 1] and env.available[1] == 1
    for wrong in ([5, ref.last[1]], [5, len(ref)], [-1, 5], [5], 5, [5, 6, 7]):
        with pytest.raises(ValueError, match="frames.*expected 2"):
            env.reset(frames=wrong)
    with pytest.raises(UserError, match="walk_0: too short"):
        Env(shared, retarget.reference(shared, [clip_of("walk")[:2]]), 2)


def test_recorded_motion(char, mocap_dir):
    """Recorded clips: the reset pose reproduces them, and a rollout stays finite."""
    files = [*sorted(mocap_dir.rglob("*walk_normal_0*.bvh"))[:2], *sorted(mocap_dir.rglob("*afan1*.bvh"))[:1]]
    if not files:
        pytest.skip(f"{mocap_dir} holds no walk_normal and no LaFAN1 clip")
    ref = retarget.reference(char, [resample(data.from_bvh(f), 30.0) for f in files])
    env = check_reset(char, ref)
    rng = np.random.default_rng(0)
    for _ in range(20):
        obs, reward, *_ = env.step(0.2 * rng.standard_normal((64, 33)))
        assert np.isfinite(obs).all() and np.isfinite(reward).all()


# ----------------------------------------------------------------------------------------- termination


def test_termination(shared, ref):
    """Far from the scaled root in any direction and fallen: failures that pay −5; horizon and clip's end do not."""
    rng = np.random.default_rng(1)
    offset = rng.normal(size=(200, 3)) * 0.2
    want = [math.sqrt(x * x + y * y + z * z) > 0.30 for x, y, z in offset]
    target = rng.normal(size=(200, 3))
    np.testing.assert_array_equal(too_far(target + offset, target), want)
    np.testing.assert_array_equal(fallen(np.array([-0.1, 0.0, 1e-6])), [True, True, False])
    assert 20 < sum(want) < 180

    env = Env(shared, ref, 6, horizon=3)
    env.reset(frames=[20, 20, 20, 20, ref.last[0] - 2, ref.last[1] - 3])
    twin = Env(shared, ref, 6, horizon=3)
    twin.reset(frames=env.frame)
    assert list(env.available) == [3, 3, 3, 3, 2, 3]
    env.qpos[1, :2] += 0.3  # 0.42 m horizontally
    env.qpos[2, 2] += 0.6  # upwards
    env.qpos[3, 2] = 0.05  # on the floor
    env.qpos[3, 3:7] = Rotation.from_euler("y", 1.57).as_quat(scalar_first=True)
    zero = np.zeros((6, 33))
    _, reward, terminated, truncated, info = env.step(zero)
    ends = info["ends"]
    assert set(ends) == set(Env.ENDS)
    assert list(ends["far"]) == [False, True, True, False, False, False]
    assert list(ends["fall"]) == [False, False, False, True, False, False]
    assert list(terminated) == [False, True, True, True, False, False] and not truncated.any()
    total = sum(info["terms"][name] for name in TERMS)
    np.testing.assert_allclose(reward - total, np.where(terminated, -5.0, 0.0), atol=1e-12)
    assert list(env.steps) == [1, 0, 0, 0, 1, 1]  # those that failed began anew
    twin.step(zero)
    _, reward, terminated, truncated, info = twin.step(zero)
    assert list(truncated) == [False] * 4 + [True, False] and list(info["ends"]["clip"]) == list(truncated)
    assert info["length"][4] == info["available"][4] == 2 and twin.steps[4] == 0
    _, reward, terminated, truncated, info = twin.step(zero)
    # at once the horizon and the clip's end: one reason only
    assert list(info["ends"]["time"]) == [True] * 4 + [False, False]
    assert list(info["ends"]["clip"]) == [False] * 5 + [True] and not terminated.any()
    np.testing.assert_allclose(reward, sum(info["terms"].values()), atol=1e-12)


def test_root_limit(shared, ref):
    """Another limit than §3.6's: as far as it, and no farther."""
    env = Env(shared, ref, 3, root_limit=0.6)
    env.reset(frames=[20, 20, 20])
    env.qpos[:, 0] += [0.0, 0.5, 0.7]
    ends = env.step(np.zeros((3, 33)))[4]["ends"]
    assert list(ends["far"]) == [False, False, True]
    assert list(too_far(np.array([[0.5, 0, 0], [0.7, 0, 0]]), np.zeros((2, 3)), 0.6)) == [False, True]


def test_value_scale(shared, ref):
    """What a character earns at most, if it never fails."""
    most = sum(shared.reward[t][0] for t in TERMS)
    assert Env(shared, ref, 1).value_scale(0.9) == pytest.approx(sum(most * 0.9**k for k in range(1000)))


class Upright(Uniform):
    """All start standing."""

    def draw(self, rng, n):
        frames, _ = super().draw(rng, n)
        return frames, np.ones(n, bool)


def test_step_rewards_what_was_done(char, ref, rng):
    """What `step` gives the terms and the limits: this frame's targets, the contact of this step's forces, the clipped
    action and the one before it."""
    env = Env(char, ref, 32, autoreset=False)
    env.reset(5)
    ended = 0
    for _ in range(25):
        before, seen, contact = env.action.copy(), [], env._contact
        env._contact = lambda seen=seen, contact=contact: seen.append(contact()) or seen[-1]
        a = rng.normal(0.0, 0.7, (32, 33))  # some beyond ±1
        info, env._contact = env.step(a)[4], contact
        f, clipped, ends = env.frame, np.clip(a, -1, 1), info["ends"]
        distances = dict(
            action_diff=np.mean((clipped - before) ** 2, axis=1),
            action_min=np.mean(clipped**2, axis=1),
            contact=np.sqrt(np.sum(seen[0] != ref.contact[f], axis=1)),
        )
        for name, d in distances.items():
            w, k = char.reward[name]
            np.testing.assert_allclose(info["terms"][name], w * np.exp(-k * d), rtol=1e-9, err_msg=name)
        far = np.linalg.norm(env.qpos[:, :3] - ref.qpos[f, :3], axis=1) > 0.30
        np.testing.assert_array_equal(ends["far"], far & ~ends["fall"])
        ended += (ends["far"] | ends["fall"]).sum()
    assert ended > 10


def test_any_upper_body_shape_falls(shared, ref):
    """Not the head alone: limp characters fall on hands and hips first."""
    env = Env(shared, ref, 32, autoreset=False, horizon=10**6)
    env.reset(0)
    early = 0
    for _ in range(60):
        fell = env.step(np.zeros((32, 33)))[4]["ends"]["fall"]
        low = character.geom_lowest(shared.model, shared.fall_geoms, env.geom_xpos, env.geom_xmat).min(1)
        np.testing.assert_array_equal(fell, low <= 0)
        early += np.sum(fell & (env.xpos[:, shared.head, 2] > 0.2))
    assert early > 10


def test_fall_is_contact(shared, ref):
    """The lowest point of the upper body is under the floor exactly where MuJoCo finds it in contact with the floor."""
    rng, m = np.random.default_rng(2), shared.model
    n = 200
    env = Env(shared, ref, n)
    env.reset()
    env.qpos[:, 3:7] = Rotation.random(n, rng=rng).as_quat(scalar_first=True)
    env.qpos[:, 7:] = rng.uniform(shared.ranges[:, 0], shared.ranges[:, 1], (n, 33))
    env.qpos[:, 2] = rng.uniform(0.1, 0.9, n)
    env.batch.forward(None, STAGE_VEL)
    found = fallen(character.geom_lowest(m, shared.fall_geoms, env.geom_xpos, env.geom_xmat).min(1))
    legs = 0
    for i in range(n):
        d = fresh(env, i)
        names = {m.body(m.geom_bodyid[g]).name for c in d.contact[: d.ncon] for g in c.geom} - {"world"}
        upper = {s for s in names if s.split("_")[0] not in ("thigh", "shin", "foot")}
        assert found[i] == bool(upper), names
        legs += bool(names) and not upper
    assert 30 < found.sum() < 170 and legs > 5


def test_step_contract(shared, ref, rng):
    """An environment without autoreset tells what final_obs must be, and what the others' observations are."""
    a, b = Env(shared, ref, 32, seed=3, horizon=12), Env(shared, ref, 32, seed=3, horizon=12, autoreset=False)
    a.reset(), b.reset()
    alive, ended, kinds = np.ones(32, bool), 0, set()
    for step in range(12):
        action = rng.normal(0, 1.5, (32, 33)) * np.linspace(0, 1, 32)[:, None]
        given = action.copy()
        obs, reward, terminated, truncated, info = a.step(action)
        np.testing.assert_array_equal(action, given)  # the caller keeps its unclipped action
        obs_b, reward_b, terminated_b, truncated_b, info_b = b.step(action)
        assert obs.dtype == np.float32 and obs.shape == (32, 189) and reward.shape == (32,)
        done = terminated | truncated
        np.testing.assert_array_equal(reward[alive], reward_b[alive])
        np.testing.assert_array_equal(terminated[alive], terminated_b[alive])
        np.testing.assert_array_equal(truncated[alive], truncated_b[alive])
        np.testing.assert_array_equal(obs[alive & ~done], obs_b[alive & ~done])
        np.testing.assert_array_equal(info["_final_obs"], done)
        np.testing.assert_array_equal(sum(e.astype(int) for e in info["ends"].values()), done)  # one reason each
        assert not (terminated & truncated).any() and np.all(info["length"] <= info["available"])
        assert ("final_obs" in info) == done.any()
        ids = np.flatnonzero(alive & done)
        for i in ids:
            np.testing.assert_array_equal(info["final_obs"][i], obs_b[i])
            np.testing.assert_array_equal(info["final_critic"][i], info_b["critic"][i])
            assert info["length"][i] == step + 1 and a.steps[i] == 0 and not a.action[i].any()
            assert np.abs(obs[i] - obs_b[i]).max() > 1e-3  # already the new episode's
            np.testing.assert_array_equal(a.qpos[i], ref.qpos[a.frame[i]])
        kinds |= {name for name, e in info["ends"].items() if e[alive].any()}
        np.testing.assert_array_equal(a.action[~done], np.clip(action, -1, 1)[~done])  # what the physics got
        np.testing.assert_array_equal(info["critic"][:, :189], obs)
        alive &= ~done
        ended += len(ids)
    assert ended == 32 and kinds >= {"far", "time"}  # the horizon ends what was left


def test_wrong_actions(shared, ref):
    env = Env(shared, ref, 4)
    env.reset()
    before = env.qpos.copy()
    for bad in (np.nan, np.inf, -np.inf):
        action = np.zeros((4, 33))
        action[2, 5] = bad
        with pytest.raises(ValueError, match="environment 2 is not finite"):
            env.step(action)
    for shape in ((33,), (3, 33), (4, 32)):
        with pytest.raises(ValueError, match=r"expected \(4, 33\)"):
            env.step(np.zeros(shape))
    np.testing.assert_array_equal(env.qpos, before)  # nothing happened
    assert not env.steps.any()


@pytest.mark.parametrize("field,value", [("qvel", np.nan), ("qvel", 1e12), ("qpos", np.inf), ("qpos", np.nan)])
def test_bad_state_ends_alone(shared, ref, rng, field, value):
    """A non-finite or exploding state ends its environment as a failure and reaches nothing else."""
    env, twin = Env(shared, ref, 4, seed=5), Env(shared, ref, 4, seed=5)
    env.reset(), twin.reset()
    action = 0.1 * rng.standard_normal((4, 33))
    env.step(action), twin.step(action)
    getattr(env, field)[1, 9] = value
    obs, reward, terminated, truncated, info = env.step(action)
    obs_twin, reward_twin, terminated_twin, *_ = twin.step(action)
    assert list(info["ends"]["bad"]) == [False, True, False, False] and terminated[1] and not truncated.any()
    assert reward[1] == -5.0 and all(t[1] == 0.0 for t in info["terms"].values())
    given = [obs, *(info[k] for k in ("critic", "final_critic", "final_obs"))]
    for x in (*given, env.qpos, env.qvel, env.state()[0]["state"]):
        assert np.isfinite(x).all()
    others = [0, 2, 3]
    assert not terminated_twin.any()
    np.testing.assert_array_equal(obs[others], obs_twin[others])
    np.testing.assert_array_equal(reward[others], reward_twin[others])
    *_, info = env.step(action)  # and it is over
    assert not info["ends"]["bad"].any()


# ----------------------------------------------------------------------------------------- determinism


def rollout(env, steps, seed=0):
    rng, rows = np.random.default_rng(seed), []
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(0.8 * rng.standard_normal((env.n, 33)))
        terms = info["terms"].values()
        rows.append(np.column_stack([terminated, truncated, info["critic"], reward, *terms, env.qpos, env.qvel]))
    return np.stack(rows)


def test_same_seed_same_motion(char, ref):
    """Bit by bit, with one thread and with two; another seed gives another."""
    runs = []
    for seed, threads in ((0, 1), (0, 2), (1, 1)):
        env = Env(char, ref, 24, seed=seed, threads=threads)
        first = env.reset()[0].copy()
        runs.append((first, rollout(env, 15)))
    assert runs[0][1][:, :, :2].any()  # some began anew
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    assert (runs[0][0] != runs[2][0]).any()


def test_state_continues_exactly(shared, ref):
    env = Env(shared, ref, 16, seed=0)
    env.reset()
    rollout(env, 8)
    arrays, meta = env.state()
    seen = env.full.copy()
    want = rollout(env, 10, seed=1)
    other = Env(shared, ref, 16, seed=99, threads=1)
    other.reset()
    rollout(other, 3)
    obs, info = other.load_state(arrays, meta)
    np.testing.assert_array_equal(info["critic"], seen)
    np.testing.assert_array_equal(obs, seen[:, :189])
    np.testing.assert_array_equal(rollout(other, 10, seed=1), want)
    assert want[:, :, :2].any()  # a reset was among them


def test_standing_starts(char):
    """Under the headset, upright, moving as it does; not where the root would then be too far from the human's."""
    ref = retarget.reference(char, [c for c in data.builtin_clips() if c.name in ("walk_005", "stand_007", "jog_009")])
    env = Env(char, ref, 400, threads=1, starts=Upright(ref))
    env.reset(3)
    f, rest = env.frame, np.abs(env.qpos[:, 7:] - char.default).max(1) < 1e-12
    env.refresh()
    yaw = heading(ref.sensor_quat[f, 0])
    behind = ref.sensor_pos[f, 0, :2] - retarget.HEADSET_AHEAD[0] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    np.testing.assert_allclose(env.qpos[rest, :2], behind[rest], atol=1e-9)  # where the user's hips are
    low = character.geom_lowest(char.model, char.sole_geoms.ravel(), env.geom_xpos, env.geom_xmat).min(1)
    assert rest.any() and np.abs(low[rest]).max() < 1e-6
    speed = np.linalg.norm((ref.sensor_pos[f, 0] - ref.sensor_pos[f - 1, 0])[:, :2], axis=1) * ref.rate
    np.testing.assert_allclose(np.linalg.norm(env.qvel[rest], axis=1), speed[rest], atol=1e-9)
    assert not too_far(env.qpos[:, :3], ref.qpos[f, :3]).any()
    ref.qpos[:, 2] -= 0.4  # all crouch: none can start upright
    env.reset(3)
    np.testing.assert_array_equal(env.qpos, ref.qpos[env.frame])
    wide = Env(char, ref, 400, threads=1, starts=Upright(ref), root_limit=0.6)
    wide.reset(3)
    assert np.abs(wide.qpos[:, 7:] - char.default).max() < 1e-12  # unless they may be as far
    ref.qpos[:, 2] += 0.4

    env.reset(frames=np.full(400, ref.first[1] + 5))  # a frame that was asked for is taken as it is
    assert (env.qpos == ref.qpos[ref.first[1] + 5]).all()
