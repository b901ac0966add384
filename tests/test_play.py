"""Play: every metric against a slow loop and on motions whose value is known; running, failing, choosing."""

import functools
import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import character
import mocap
import play
import retarget
from env import Env, too_far
from play import Recording
from ppo import Policy
from retarget import forward_kinematics
from runs import UserError, save_checkpoint

KEYS = (  # spec: every key of every row
    "clips completed survival root_cm head_cm hands_cm joint_pos_cm head_deg joint_rot_deg sip_deg foot_slide_cm_s "
    "penetration_mm contact_agreement jitter_m_s3 human_jitter_m_s3 steps_per_m human_steps_per_m head_wobble_deg_s "
    "torque_rms saturation"
).split()


pytestmark = pytest.mark.usefixtures("motions_once")


@pytest.fixture(scope="module")
def char():
    return character.load("jesse")


@pytest.fixture(scope="module")
def ref(char):
    walk, stand = (mocap.load("builtin", clips=c)[0] for c in ("walk_005", "stand_007"))
    return retarget.reference(char, [walk[:40], stand[:90], walk[60:90]])


@pytest.fixture(scope="module")
def long(char):
    return retarget.reference(char, mocap.load("builtin", clips="stand_007"))


def cheat(env):
    """No torque, but the state is put back on the reference first: it survives for as long as there are frames."""
    env.qpos[:], env.qvel[:] = env.ref.qpos[env.frame], env.ref.qvel[env.frame]
    return play.zero_action(env)


def still(char, ref, t=31, yaw=0.0):
    """A reference and a recording of t frames in the default pose, upright: the blank page of hand-made motions."""
    f = np.arange(t)
    qpos = np.zeros((t, char.model.nq))
    qpos[:, 2], qpos[:, 3], qpos[:, 7:] = char.hip_height, 1.0, char.default
    fk = forward_kinematics(char, qpos)
    changes = dict(first=np.array([0]), last=np.array([t - 1]), qpos=qpos, qvel=np.zeros((t, char.model.nv)))
    changes |= dict(sensor_pos=fk.site_xpos.copy(), orientation=fk.xquat[:, [char.root, char.head]].copy())
    changes |= dict(contact=np.zeros((t, 2), bool), human_pos=np.zeros((t, 15, 3), np.float32))
    action = np.zeros((t, len(char.limits)))
    return replace(ref, **changes), Recording(f, qpos.copy(), np.zeros((t, 2), bool), action, False, t - 1)


# ------------------------------------------------------------------------------------ pushes


def test_push(char, ref):
    """What the flag says, when the force acts, and the momentum it gives: N × 0.2 s along the heading."""
    assert play.parse_push(None) is None and play.parse_push("200@2") == play.Push(200.0, 2.0, 0.0)
    assert play.parse_push("50.5@.5:left") == play.Push(50.5, 0.5, np.pi / 2)
    for text in ("200", "200@", "-3@2", "200@2:up", "nan@2", "200@2:leftx"):
        with pytest.raises(UserError, match="valid: N@T or N@T:DIRECTION.*forward, left, back, right"):
            play.parse_push(text)
    push = play.parse_push("300@0.1:right")
    times = np.array([0.0, 0.09, 0.1, 0.29, 0.3, 1.0])
    assert np.flatnonzero(np.linalg.norm(push.force(times, np.zeros(6)), axis=1)).tolist() == [2, 3]
    assert np.allclose(push.force(0.1, np.pi / 2), [300, 0, 0])  # its right, when it looks along y
    env = Env(char, ref, 1, threads=1, autoreset=False, horizon=1000)
    env.reset(frames=[1])
    env.qpos[:, 2] += 5.0  # in the air nothing else pushes
    env.qvel[:] = 0.0
    yaw, xfrc, com = mocap.heading(env.qpos[0, 3:7]), env.batch.bind("xfrc_applied"), []
    env.batch.forward(np.arange(1), retarget.STAGE_VEL)
    for _ in range(15):
        xfrc[:, char.root, :3] = push.force(env.steps * env.dt, yaw)
        com.append(env.com[0, char.root].copy())
        env.step(play.zero_action(env))
    velocity = (com[14] - com[12]) / (2 * env.dt)
    gain = 300 * play.PUSH_SECONDS / char.model.body_subtreemass[0]
    np.testing.assert_allclose(velocity[:2], gain * np.array([np.sin(yaw), -np.cos(yaw)]), rtol=0.02, atol=0.01)


def test_largest_push(char, ref, monkeypatch):
    """What it reports is survived, and a little more is not; without a survivor it says so."""
    monkeypatch.setattr(play, "RECOVERY", 1.0)
    found = play.largest_push(char, ref, cheat, 0.5, 60_000.0, rounds=5, threads=1)
    assert found["tried"] == 1 and found["resolution"] == 60_000 / 32
    for name, angle in play.DIRECTIONS.items():
        (most,) = found[name]
        assert 0 < most < 60_000
        for newtons, fails in ((most, False), (most + found["resolution"], True)):
            rec = play.simulate(char, ref, cheat, only=[1], threads=1, push=play.Push(newtons, 0.5, angle))[0]
            assert rec.failed is fails
    text = play.push_report(found, play.Push(60_000.0, 0.5))
    assert "1 of 1 sequences" in text and text.count("median") == 4
    limp = play.largest_push(char, ref, lambda env: np.ones((env.n, env.action_size)), 0.5, 100.0, threads=1)
    assert len(limp["left"]) == 0 and "0 of 1 sequences" in play.push_report(limp, play.Push(100.0, 0.5))
    with pytest.raises(UserError, match="no sequence is 31.0 s long"):
        play.largest_push(char, ref, cheat, 30.0, 100.0)


# ------------------------------------------------------------------------------------ what drives it


def test_pd_action(char, ref):
    env = Env(char, ref, 5, threads=1)
    env.reset(0)
    rng = np.random.default_rng(0)
    env.qpos[:, 7:] += 0.2 * rng.standard_normal((5, char.j))
    env.qvel[:] += rng.standard_normal(env.qvel.shape)
    a = play.pd_action(env)
    assert a.shape == (5, char.model.nu) and np.abs(a).max() == 1.0 and (np.abs(a) < 1).any()
    for n in range(5):
        for k in range(char.model.nu):
            joint = char.model.actuator_trnid[k, 0]
            p, v = char.model.jnt_qposadr[joint], char.model.jnt_dofadr[joint]
            goal_p, goal_v = ref.qpos[env.frame[n], p], ref.qvel[env.frame[n], v]
            x = play.PD_STIFFNESS * (goal_p - env.qpos[n, p]) + play.PD_DAMPING * (goal_v - env.qvel[n, v])
            assert a[n, k] == pytest.approx(max(-1.0, min(1.0, x)))
    env.reset(0)
    np.testing.assert_allclose(play.pd_action(env), 0.0, atol=1e-12)  # on the reference there is nothing to correct
    np.testing.assert_array_equal(play.zero_action(env), np.zeros((5, char.model.nu)))


def test_policy_action_is_the_mean(char, ref):
    env = Env(char, ref, 4, threads=1)
    env.reset(0)
    rng = np.random.default_rng(0)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (8,), (4,), 5.0, 1.0, rng)
    act = play.policy_action(policy)
    np.testing.assert_array_equal(act(env), act(env))  # no noise, whatever σ
    np.testing.assert_array_equal(act(env), policy.mean_action(env.full[:, : env.obs_size]))
    before = act(env)
    env.full[:, env.obs_size :] += 1.0  # what only the critic may see
    np.testing.assert_array_equal(act(env), before)


def test_simulate(char, ref):
    recordings = play.simulate(char, ref, play.zero_action, threads=1)
    assert len(recordings) == 3 and any(r.failed for r in recordings)
    for i, rec in enumerate(recordings):
        env = Env(char, ref, 1, threads=1, autoreset=False)
        env.reset(frames=ref.first[[i]])
        np.testing.assert_array_equal(rec.qpos[0], ref.qpos[ref.first[i]])
        np.testing.assert_array_equal(rec.contact[0], ref.contact[ref.first[i]])
        assert rec.available == ref.last[i] - ref.first[i] and not rec.action[0].any()
        for k in range(1, rec.available + 2):
            if k == len(rec.frames):
                break
            _, _, terminated, truncated, _ = env.step(np.zeros((1, env.action_size)))
            assert not terminated[0]  # no state that failed is in the recording
            np.testing.assert_allclose(rec.qpos[k], env.qpos[0], atol=1e-9)
            np.testing.assert_array_equal(rec.contact[k], env.contact[0])
            assert rec.frames[k] == env.frame[0] == ref.first[i] + k
        if rec.failed:
            assert env.step(np.zeros((1, env.action_size)))[2][0] and len(rec.frames) <= rec.available
        else:
            assert truncated[0] and rec.frames[-1] == ref.last[i] and len(rec.frames) == rec.available + 1
    only = play.simulate(char, ref, play.zero_action, threads=1, only=[1])
    assert len(only) == 1 and len(only[0].frames) == len(recordings[1].frames)
    np.testing.assert_allclose(only[0].qpos, recordings[1].qpos, atol=1e-9)


def test_what_happens_after_the_end_does_not_count(char, ref):
    """Sequences of other lengths go on beside one that is complete; it may fall then."""

    def fall_later(env):
        action = cheat(env)
        if env.steps[0] > 32:
            env.qpos[2, 0] += 5.0
        return action

    first, second, third = play.simulate(char, ref, fall_later, threads=1)
    assert not (first.failed or second.failed or third.failed)
    assert [len(r.frames) for r in (first, second, third)] == [40, 90, 30]


def test_simulate_stops_at_500_steps(char, long):
    assert len(long) > 600
    (rec,) = play.simulate(char, long, cheat, threads=1)
    assert not rec.failed and rec.available == 500 and len(rec.frames) == 501 and rec.frames[-1] == 500
    (kin,) = play.kinematic(char, long)
    assert kin.available == 500 and len(kin.frames) == 501
    (short,) = play.simulate(char, long, cheat, horizon=7, threads=1)
    assert short.available == 7 and len(short.frames) == 8 and not short.failed


def test_time_to_failure(char, long):
    assert play.time_to_failure(char, long, cheat, n=3, seconds=1.0, threads=1) == float("inf")
    found = play.time_to_failure(char, long, play.zero_action, n=6, seconds=3.0, seed=4, threads=1)
    env = Env(char, long, 6, threads=1, autoreset=False)
    draw = np.random.default_rng(4)  # the starts that the environment draws, replayed by hand
    env.reset(frames=draw.choice(env.starts, 6))
    failures = 0
    for _ in range(90):
        _, _, terminated, truncated, _ = env.step(np.zeros((6, env.action_size)))
        failures += terminated.sum()
        done = np.flatnonzero(terminated | truncated)
        if len(done):
            env._reset(done, draw.choice(env.starts, len(done)))
    assert failures >= 3 and found == pytest.approx(6 * 3.0 / failures)


# ------------------------------------------------------------------------------------ metrics


def angle(a, b):
    """Between two rotation matrices, by the trace."""
    return np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1)))


def matrix(q):
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(q, float))
    return out.reshape(3, 3)


def test_metrics_against_slow_loop(char, ref):
    """Every key, one frame and one body at a time, through mj_forward and rotation matrices."""
    recordings = play.simulate(char, ref, play.pd_action, threads=1)
    rng = np.random.default_rng(0)
    for r in recordings:  # noise, so that no metric is near its ideal
        r.qpos[1:, 7:] += 0.05 * rng.standard_normal(r.qpos[1:, 7:].shape)
        r.contact[1:] ^= rng.random(r.contact[1:].shape) < 0.2
        r.qpos[1:, 2] -= 0.02 * rng.random(len(r.qpos) - 1)
    found = play.measure(char, ref, recordings)
    m, rate = char.model, 30.0
    sim, kin = mujoco.MjData(m), mujoco.MjData(m)
    bodies = [m.body(n).id for n in char.spec["map"]]
    joints = sorted({*bodies, m.body("hand_l").id, m.body("hand_r").id})
    sip = [m.body(f"{part}_{side}").id for part in ("upper_arm", "thigh") for side in "lr"]
    s = {k: [] for k in KEYS}
    walked, human_walked, falls, human_falls = 0.0, 0.0, 0, 0
    for rec in recordings:
        places, heads, human_heads, soles = [], [], [], []
        for k, f in enumerate(rec.frames):
            for data, qpos in ((sim, rec.qpos[k]), (kin, ref.qpos[f])):
                data.qpos[:] = qpos
                mujoco.mj_forward(m, data)
            s["root_cm"].append(100 * np.linalg.norm(sim.qpos[:3] - kin.qpos[:3]))
            gaps = [100 * np.linalg.norm(sim.site_xpos[char.sensor_sites[i]] - ref.sensor_pos[f, i]) for i in range(3)]
            s["head_cm"].append(gaps[0])
            s["hands_cm"] += gaps[1:]
            for b in joints:
                off = (sim.xpos[b] - sim.xpos[char.root]) - (kin.xpos[b] - kin.xpos[char.root])
                s["joint_pos_cm"].append(100 * np.linalg.norm(off))
            for b in bodies:
                p = m.body_parentid[b]
                local = [d.xmat[p].reshape(3, 3).T @ d.xmat[b].reshape(3, 3) for d in (sim, kin)]
                s["joint_rot_deg"].append(angle(*local))
            s["sip_deg"] += [angle(sim.xmat[b].reshape(3, 3), kin.xmat[b].reshape(3, 3)) for b in sip]
            s["head_deg"].append(angle(sim.xmat[char.head].reshape(3, 3), matrix(ref.orientation[f, 1])))
            places.append([sim.xpos[b].copy() for b in joints])
            heads.append(sim.xmat[char.head].reshape(3, 3).copy())
            human_heads.append(matrix(ref.orientation[f, 1]))
            points = retarget.sole_points(char, sim.geom_xpos[None], sim.geom_xmat[None])[0]  # (2, p, 3)
            soles.append(points)
            body_geoms = [g for g in range(m.ngeom) if m.geom(g).name != "floor"]
            low = character.geom_lowest(m, body_geoms, sim.geom_xpos[None], sim.geom_xmat[None]).min()
            if low < 0:
                s["penetration_mm"].append(-1000 * low)
            if k:
                s["contact_agreement"] += [float(rec.contact[k, i] == ref.contact[f, i]) for i in range(2)]
                s["torque_rms"] += list(rec.action[k] ** 2)
                s["saturation"] += [float(abs(a) > 0.99) for a in rec.action[k]]
                walked += np.hypot(*(rec.qpos[k] - rec.qpos[k - 1])[:2])
                human_walked += np.hypot(*(ref.human_pos[f, 0] - ref.human_pos[f - 1, 0])[:2] / ref.scale[f, :2])
                falls += sum(rec.contact[k, i] and not rec.contact[k - 1, i] for i in range(2))
                human_falls += sum(ref.contact[f, i] and not ref.contact[f - 1, i] for i in range(2))
        last = len(rec.frames) - 1
        for k, f in enumerate(rec.frames):
            a, b = max(k - 1, 0), min(k + 1, last)
            for i in range(2):
                if ref.contact[f, i]:
                    low = soles[k][i][:, 2].argmin()
                    s["foot_slide_cm_s"].append(
                        100 * np.hypot(*(soles[b][i][low] - soles[a][i][low])[:2]) * rate / (b - a)
                    )
            both = []
            for h in (heads, human_heads):
                turn = h[k].T @ (h[b] @ h[a].T) @ h[k]  # in the head's own axes
                vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
                theta = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
                scale = theta / (2 * np.sin(theta)) if theta > 1e-7 else 0.5
                both.append(np.degrees(vector * scale * rate / (b - a)))
            s["head_wobble_deg_s"] += [(both[0] - both[1])[0] ** 2, (both[0] - both[1])[2] ** 2]
        x, h = np.array(places), ref.human_pos[rec.frames].astype(float) / ref.scale[rec.frames][:, None]
        for k in range(len(x) - 3):
            third = lambda v: np.linalg.norm(v[k + 3] - 3 * v[k + 2] + 3 * v[k + 1] - v[k], axis=-1) * rate**3  # noqa
            s["jitter_m_s3"] += list(third(x))
            s["human_jitter_m_s3"] += list(third(h))
    expected = {k: np.mean(v) for k, v in s.items() if v}
    expected["head_wobble_deg_s"] **= 0.5
    expected["torque_rms"] **= 0.5
    expected |= dict(clips=3, steps_per_m=falls / walked, human_steps_per_m=human_falls / human_walked)
    expected["completed"] = np.mean([not r.failed for r in recordings])
    expected["survival"] = np.mean([(len(r.frames) - 1) / (b - a) for r, a, b in zip(recordings, ref.first, ref.last)])
    assert set(found) == set(KEYS) == set(expected)
    for key in KEYS:
        assert found[key] == pytest.approx(expected[key], rel=1e-5, abs=1e-5), key
        assert expected[key] > 0 or key == "completed", key


def test_metrics_of_kinematic(char, ref):
    """The reference itself: no error against itself; the human's figures are the ones that `mocap` counts."""
    recordings = play.kinematic(char, ref)
    assert [len(r.frames) for r in recordings] == [40, 90, 30] and [r.available for r in recordings] == [39, 89, 29]
    row = play.measure(char, ref, recordings)
    assert row["completed"] == row["survival"] == 1.0 and row["clips"] == 3
    for key in ("root_cm", "joint_pos_cm", "joint_rot_deg", "sip_deg"):
        assert row[key] == pytest.approx(0.0, abs=1e-4), key
    assert row["torque_rms"] == row["saturation"] == 0.0
    assert row["head_deg"] < 5.0 and row["head_cm"] < 20.0  # what the character's build leaves
    assert row["contact_agreement"] > 0.7
    for rec in recordings:  # its contact: height < 2 cm and speed < 0.4 m/s
        soles = forward_kinematics(char, ref.qpos[rec.frames]).soles
        for t in range(1, len(rec.frames) - 1):
            for foot in range(2):
                low = soles[t, foot, :, 2].argmin()
                speed = np.hypot(*(soles[t + 1, foot, low] - soles[t - 1, foot, low])[:2]) * 15.0
                assert rec.contact[t, foot] == (soles[t, foot, low, 2] < 0.02 and speed < 0.4)

    lifted = ref.qpos.copy()
    lifted[:, 2] += 0.05
    assert any(r.contact.any() for r in recordings)
    assert not any(r.contact.any() for r in play.kinematic(char, replace(ref, qpos=lifted)))


def test_metrics_on_known_motion(char, ref):
    still_ref, rec = still(char, ref)
    nothing = play.measure(char, still_ref, [rec])
    for key in ("root_cm", "head_cm", "hands_cm", "head_deg", "jitter_m_s3", "head_wobble_deg_s", "joint_pos_cm"):
        assert nothing[key] == pytest.approx(0.0, abs=1e-5), key
    assert nothing["contact_agreement"] == 1.0

    def changed(f, **more):
        qpos = rec.qpos.copy()
        f(qpos)
        return play.measure(char, replace(still_ref, **more), [replace(rec, qpos=qpos)])

    t = np.arange(31) / 30.0

    def aside(q):
        q[:, 1] += 0.1

    row = changed(aside)  # 10 cm to the side, everything else as it is
    for key in ("root_cm", "head_cm", "hands_cm"):
        assert row[key] == pytest.approx(10.0), key
    for key in ("joint_pos_cm", "joint_rot_deg", "sip_deg", "head_deg"):
        assert row[key] == pytest.approx(0.0, abs=1e-5), key

    hinge = int(next(h[-1] for b, h, *_ in char.chains if b == char.head))

    def nod(q):
        q[:, 7 + hinge] += 0.3

    row = changed(nod)  # one hinge of the head by 0.3 rad
    assert row["head_deg"] == pytest.approx(np.degrees(0.3))
    assert row["joint_rot_deg"] == pytest.approx(np.degrees(0.3) / len(char.chains))
    assert row["sip_deg"] == pytest.approx(0.0, abs=1e-5) and row["root_cm"] == 0.0
    minus = -still_ref.orientation  # q and −q are one rotation
    assert changed(nod, orientation=minus)["head_deg"] == pytest.approx(np.degrees(0.3))

    arm = int(next(h[-1] for b, h, *_ in char.chains if char.model.body(b).name == "upper_arm_l"))

    def reach(q):
        q[:, 7 + arm] += 0.4

    assert changed(reach)["sip_deg"] == pytest.approx(np.degrees(0.4) / 4)  # one of two arms and two thighs

    def spin(q):  # the whole body turns with 2 rad/s: yaw, no roll
        q[:, 3], q[:, 6] = np.cos(t), np.sin(t)

    assert changed(spin)["head_wobble_deg_s"] == pytest.approx(np.degrees(2.0) / np.sqrt(2))

    def bow(q):  # pitch is not wobble
        q[:, 3], q[:, 5] = np.cos(t / 2), np.sin(t / 2)

    assert changed(bow)["head_wobble_deg_s"] == pytest.approx(0.0, abs=1e-4)

    def cubic(q):
        q[:, 0] += 0.7 * t**3

    assert changed(cubic)["jitter_m_s3"] == pytest.approx(6 * 0.7, rel=1e-4)  # its third derivative
    total, count = play.jitter((t[:, None, None] ** 3) * [[[1.0, 2.0, 2.0], [0.0, 1.0, 0.0]]], 30.0)
    assert count == 28 * 2 and total / count == pytest.approx((18.0 + 6.0) / 2)

    contact = np.zeros((31, 2), bool)
    contact[:, 0] = True

    def glide(q):
        q[:, 0] += 0.5 * t

    row = changed(glide, contact=contact)  # 0.5 m/s for 1 s, the left foot said to be on the ground
    assert row["foot_slide_cm_s"] == pytest.approx(50.0)
    assert np.isnan(changed(glide)["foot_slide_cm_s"])  # no contact, no slide

    lowest = forward_kinematics(char, rec.qpos[:1]).soles[..., 2].min()

    def sink(q):
        q[:10, 2] -= lowest + 0.005
        q[10:, 2] += 0.1

    row = changed(sink)
    assert row["penetration_mm"] == pytest.approx(5.0, abs=1e-6)  # over the ten frames below only
    assert nothing["penetration_mm"] == pytest.approx(max(0.0, -1000 * lowest), abs=1e-6)


def test_steps_contacts_and_torques(char, ref):
    still_ref, rec = still(char, ref, 11)
    qpos = rec.qpos.copy()
    qpos[:, 0] = np.linspace(0.0, 2.0, 11)  # 2 m
    human = still_ref.human_pos.copy()
    human[:, 0, 1] = np.linspace(0.0, 4.0, 11)  # 4 m
    left, right = "00110011100", "11100001111"
    contact = np.array([[a == "1", b == "1"] for a, b in zip(left, right)])
    human_contact = np.ones((11, 2), bool)
    human_contact[3] = False
    action = np.full((11, len(char.limits)), 0.5)
    action[0], action[6:] = 7.0, -1.0  # the start's is no action
    r = replace(still_ref, human_pos=human, contact=human_contact)
    row = play.measure(char, r, [replace(rec, qpos=qpos, contact=contact, action=action)])
    assert play.footfalls(contact) == 3  # left at 2 and 6, right at 7; the right foot stood at the start
    assert row["steps_per_m"] == pytest.approx(3 / 2.0) and row["human_steps_per_m"] == pytest.approx(2 / 4.0)
    agree = sum(c == h for c, h in zip(contact[1:].ravel(), human_contact[1:].ravel()))
    assert row["contact_agreement"] == pytest.approx(agree / 20)
    assert row["torque_rms"] == pytest.approx(np.sqrt((5 * 0.25 + 5 * 1.0) / 10)) and row["saturation"] == 0.5


def test_completed_and_survival(char, ref):
    still_ref, rec = still(char, ref, 31)

    def cut(k, failed):
        parts = (v[: k + 1] for v in (rec.frames, rec.qpos, rec.contact, rec.action))
        return Recording(*parts, failed, 30)

    row = play.measure(char, still_ref, [cut(30, False), cut(15, True), cut(6, True), cut(29, True)])
    assert row["clips"] == 4 and row["completed"] == 0.25
    assert row["survival"] == pytest.approx((1 + 0.5 + 0.2 + 29 / 30) / 4)


def test_nothing_to_measure(char, ref):
    """A clip that fails in its first step leaves one frame: no division by zero, and no zero that flatters."""
    still_ref, rec = still(char, ref, 31)
    one = Recording(rec.frames[:1], rec.qpos[:1], rec.contact[:1], rec.action[:1], True, 30)
    with np.errstate(all="raise"):
        row = play.measure(char, still_ref, [one])
        assert row["completed"] == row["survival"] == 0.0 and row["root_cm"] == 0.0 and set(row) == set(KEYS)
        steps = ("contact_agreement", "jitter_m_s3", "human_jitter_m_s3", "steps_per_m", "human_steps_per_m")
        for key in (*steps, "foot_slide_cm_s", "head_wobble_deg_s", "torque_rms", "saturation"):
            assert np.isnan(row[key]), key
        for count in (2, 3):
            few = Recording(*(v[:count] for v in (rec.frames, rec.qpos, rec.contact, rec.action)), True, 30)
            assert np.isnan(play.measure(char, still_ref, [few])["jitter_m_s3"])
    json.loads(play.as_json({"policy": row}), parse_constant=lambda c: pytest.fail(c))
    text = play.table({"policy": row})
    assert "nan" not in text and "inf" not in text and "jitter - m/s³, - steps/m" in text


def test_a_real_first_step_failure(char, ref):
    def thrown(env):
        env.qpos[:, 0] += 5.0
        return play.zero_action(env)

    recordings = play.simulate(char, ref, thrown, threads=1)
    assert all(r.failed and len(r.frames) == 1 for r in recordings)
    assert not too_far(recordings[0].qpos[:, :3], ref.qpos[recordings[0].frames, :3]).any()
    row = play.measure(char, ref, recordings)
    assert row["completed"] == row["survival"] == 0.0 and row["root_cm"] == 0.0


def test_sip_bodies(char):
    names = {char.model.body(b).name for b in play.sip_bodies(char)}
    assert names == {"upper_arm_l", "upper_arm_r", "thigh_l", "thigh_r"}
    for metrics in ({"sip": ["thigh_l", "wing"]}, {"sip": []}, {}):
        with pytest.raises(UserError, match=r"jesse.toml: \[metrics\] sip.*thigh_l"):
            play.sip_bodies(replace(char, spec=char.spec | {"metrics": metrics}))


def test_table(char, ref):
    row = play.measure(char, ref, play.kinematic(char, ref))
    text = play.table({"policy": row | {"fails_every_s": float("inf")}, "kinematic": row})
    lines = text.splitlines()
    width = len(play.COLUMNS) + 1
    assert [line.count("|") for line in lines[:4]] == [width + 1] * 4
    cells = [c.strip() for c in lines[3].split("|")]
    assert cells[1:4] == ["kinematic", "-", "-"] and cells[4 + 1] == "0.0"  # completed by definition: a dash
    assert "never" in lines[2] and "the human: jitter" in text and "3 sequences" in text


# ------------------------------------------------------------------------------------ command line


@pytest.fixture
def policy_file(char, ref, tmp_path):
    env = Env(char, ref, 1, threads=1)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (8,), (4,), 0.1, 1.0, np.random.default_rng(0))
    policy.norm.update(np.random.default_rng(1).standard_normal((50, env.critic_size)))
    save_checkpoint(tmp_path / "p.npz", policy.arrays(), {"policy": policy.shape()})
    return tmp_path / "p.npz"


def test_measure_json(policy_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(mocap, "sequences", lambda *_, **__: [mocap.load("builtin", clips="walk_005")[0][:70]])
    monkeypatch.setattr(play, "time_to_failure", functools.partial(play.time_to_failure, seconds=1.0))
    out = tmp_path / "table.json"
    args = ["--policy", str(policy_file), "--measure", "--json", str(out), "--threads", "1"]
    play.main([*args, "--random-starts", "4"])
    text = capsys.readouterr().out
    rows = json.loads(out.read_text(), parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert list(rows) == ["policy", "kinematic", "zero", "pd"]
    for name, row in rows.items():
        assert set(KEYS) <= set(row), name
        assert ("fails_every_s" in row) == (name != "kinematic")
        assert all(v is None or isinstance(v, int | float) for v in row.values())
        assert f"| {name} |" in text
        assert row["human_jitter_m_s3"] > 0
    assert rows["kinematic"]["completed"] == 1.0 and rows["kinematic"]["root_cm"] == pytest.approx(0.0)
    assert rows["zero"]["torque_rms"] == 0.0 < rows["pd"]["torque_rms"]
    clean = json.loads(play.as_json({"a": {"x": float("nan"), "y": float("inf"), "z": 1.5, "n": 2}}))
    assert clean == {"a": {"x": None, "y": None, "z": 1.5, "n": 2}}


def test_split_and_all(policy_file, monkeypatch):
    asked = []

    def sequences(motion, split, clips, seed, reading):
        asked.append((motion, split, clips, seed))
        raise UserError("enough")

    monkeypatch.setattr(mocap, "sequences", sequences)
    for more in ([], ["--split", "train"], ["--split", "style"], ["--all"], ["--clips", "*walk*", "--seed", "3"]):
        with pytest.raises(UserError, match="enough"):
            play.main(["--measure", "--policy", str(policy_file), *more])
    assert [a[1] for a in asked] == ["validation", "train", "style", "all", "validation"]
    assert asked[-1][2:] == ("*walk*", 3)


def test_which_policy(policy_file, tmp_path, monkeypatch, char, ref):
    with pytest.raises(UserError, match="no policy .*missing.npz: train one .*ppo.py --character jesse"):
        play.main(["--measure", "--policy", str(tmp_path / "missing.npz")])
    monkeypatch.setattr(character, "CHARACTERS", tmp_path)
    with pytest.raises(UserError, match="no policy .*jesse.npz"):
        play.find_policy(play.Options())
    (tmp_path / "jesse.npz").write_bytes(policy_file.read_bytes())
    assert play.find_policy(play.Options())[1] == tmp_path / "jesse.npz"  # shipped beside the character
    elsewhere = tmp_path / "mine" / "bob.toml"
    elsewhere.parent.mkdir()
    with pytest.raises(UserError, match="no policy .*mine/bob.npz"):
        play.find_policy(play.Options(character=str(elsewhere)))
    other = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(tmp_path / "other.npz", other.arrays(), {"policy": other.shape()})
    monkeypatch.undo()
    monkeypatch.setattr(mocap, "sequences", lambda *_, **__: mocap.load("builtin", clips="stand_007"))
    with pytest.raises(UserError, match="other.npz: a policy of 7 observations and 2 actions; jesse needs"):
        play.main(["--measure", "--policy", str(tmp_path / "other.npz")])


def test_what_cannot_be_done_is_said_first(policy_file, tmp_path):
    """Before anything is simulated."""
    with pytest.raises(UserError, match="nothing to do: give --measure"):
        play.main(["--policy", str(policy_file)])
    with pytest.raises(UserError, match="--json writes the table of --measure"):
        play.main(["--policy", str(policy_file), "--json", "x.json", "--png", "x.png"])
    for flag, name in (("--json", "t.json"), ("--png", "t.png"), ("--video", "t.mp4")):
        with pytest.raises(UserError, match=f"cannot write .*{name}: there is no folder"):
            play.main(["--policy", str(policy_file), "--measure", flag, str(tmp_path / "none" / name)])
    with pytest.raises(UserError, match="--sequence 7: there are 1, from 0"):
        play.main(["--policy", str(policy_file), "--measure", "--sequence", "7", "--clips", "walk_005"])
