"""Metrics: each against a slow loop, and on motions whose value is known; tables."""

import json
from collections import Counter
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp
from test_mocap import walk

import character
import metrics
import retarget
from env import too_far
from headset.player import Ride, recorded
from headset.reader import controllers_hang
from human import PARENTS, SEGMENTS, heading, quat_about, quat_mul
from metrics import Recording
from mocap.data import load
from plumbing.cli import UserError
from retarget import forward_kinematics

KEYS = (  # spec: every key of every row
    "clips completed survival root_cm head_cm hands_cm joint_pos_cm head_deg joint_rot_deg sip_deg foot_slide_cm_s "
    "penetration_mm contact_agreement jitter_m_s3 human_jitter_m_s3 steps_per_m human_steps_per_m head_wobble_deg_s "
    "torque_rms saturation own_slide_cm_s self_penetration_mm self_penetration_share spring_share"
).split()
FIELD = [k for k, *_ in metrics.FIELD]
BESIDE = [*(c for c in metrics.COLUMNS if c[0] in ("completed", "survival")), *metrics.FIELD]  # and who they are of
GROUPS = [f"spring_share.{g}" for g in ("ankle", "elbow", "head", "hip", "knee", "neck", "shoulder", "spine")]
KEYS += GROUPS


@pytest.fixture(scope="module")
def char():
    return character.load("jesse")


@pytest.fixture(scope="module")
def ref(char):
    walk, stand = (load("builtin", clips=c)[0] for c in ("walk_005", "stand_007"))
    return retarget.reference(char, [walk[:40], stand[:90], walk[60:90]])


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


# ------------------------------------------------------------------------------------ one function each


def angle(a, b):
    """Between two rotation matrices, by the trace."""
    return np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1)))


def matrix(q):
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(q, float))
    return out.reshape(3, 3)


def rotation_of(q):
    return Rotation.from_quat(q, scalar_first=True)


def resting_pairs(char):
    """Pairs of shapes that do not count: of one body, of bodies at most two joints apart, or overlapping at rest."""
    m, data, out = char.model, mujoco.MjData(char.model), set()
    data.qpos[:] = char.upright
    mujoco.mj_forward(m, data)
    geoms = [g for g in range(m.ngeom) if m.geom_conaffinity[g] and m.geom_bodyid[g]]

    def way(body):
        path = [body]
        while path[-1]:
            path.append(m.body_parentid[path[-1]])
        return path[:-1]  # up to the root, without the world

    for a in geoms:
        for b in geoms:
            one, two = way(m.geom_bodyid[a]), way(m.geom_bodyid[b])
            shared = len(set(one) & set(two))
            apart = len(one) + len(two) - 2 * shared
            if apart <= 2 or mujoco.mj_geomDistance(m, data, a, b, 1.0, None) <= 0:
                out.add((a, b))
    return out


def own_depth(m, data, never):
    """Deepest overlap of any other pair in a pose [m]."""
    geoms = [g for g in range(m.ngeom) if m.geom_conaffinity[g] and m.geom_bodyid[g]]
    pairs = [(a, b) for a in geoms for b in geoms if a < b and (a, b) not in never]
    return max(0.0, *(-mujoco.mj_geomDistance(m, data, a, b, 1.0, None) for a, b in pairs))


def test_metrics_against_slow_loop(char, ref):
    """Every key, one frame and one body at a time, through mj_forward and rotation matrices."""
    recordings = metrics.simulate(char, ref, metrics.pd_action, threads=1)
    rng = np.random.default_rng(0)
    for r in recordings:  # noise, so that no metric is near its ideal
        r.qpos[1:, 7:] += 0.05 * rng.standard_normal(r.qpos[1:, 7:].shape)
        r.contact[1:] ^= rng.random(r.contact[1:].shape) < 0.2
        r.qpos[1:, 2] -= 0.02 * rng.random(len(r.qpos) - 1)
        r.qpos[1:, 7 + char.hinges.index("shoulder_l_x")] -= 0.5  # an arm through the trunk
    found = metrics.measure(char, ref, recordings)
    m, rate = char.model, 30.0
    sim, kin = mujoco.MjData(m), mujoco.MjData(m)
    bodies = [m.body(n).id for n in char.spec["map"]]
    joints = sorted({*bodies, m.body("hand_l").id, m.body("hand_r").id})
    sip = [m.body(f"{part}_{side}").id for part in ("upper_arm", "thigh") for side in "lr"]
    s = {k: [] for k in KEYS}
    walked, human_walked, falls, human_falls = 0.0, 0.0, 0, 0
    depths, torques, never = [], {}, resting_pairs(char)
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
            if k % metrics.EVERY == 0:
                depth = own_depth(m, sim, never)
                depths.append(1000 * depth)
            if k:
                before = rec.contact[max(k - 1, 1)]  # the start's is the first step's
                for i in range(2):
                    if rec.contact[k, i] and before[i]:
                        low = soles[k][i][:, 2].argmin()
                        way = soles[k][i][low] - soles[k - 1][i][low]
                        s["own_slide_cm_s"].append(100 * rate * np.hypot(*way[:2]))
                for u, h in enumerate(char.driven):
                    group = "".join(c for c in char.hinges[h].split("_")[0] if not c.isdigit())
                    spring = -m.jnt_stiffness[1 + h] * (rec.qpos[k, 7 + h] - m.qpos_spring[7 + h])
                    for name in (group, ""):
                        torques.setdefault(name, []).append((spring**2, (rec.action[k, u] * char.limits[u]) ** 2))
                s["contact_agreement"] += [float(rec.contact[k, i] == ref.contact[f, i]) for i in range(2)]
                s["torque_rms"] += list(rec.action[k] ** 2)
                s["saturation"] += [float(abs(a) > 0.99) for a in rec.action[k]]
                walked += np.hypot(*(rec.qpos[k] - rec.qpos[k - 1])[:2])
                human_walked += np.hypot(*(ref.human_pos[f, 0] - ref.human_pos[f - 1, 0])[:2] / ref.scale[f, :2])
                falls += sum(rec.contact[k, i] and not before[i] for i in range(2))
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
    expected["self_penetration_mm"] = np.percentile(depths, 95)
    expected["self_penetration_share"] = np.mean(np.array(depths) > 10)
    for name, pairs in torques.items():
        spring, motor = np.sqrt(np.mean(pairs, axis=0))
        expected["spring_share" + (f".{name}" if name else "")] = spring / (spring + motor)
    expected |= dict(clips=3, steps_per_m=falls / walked, human_steps_per_m=human_falls / human_walked)
    expected["completed"] = np.mean([not r.failed for r in recordings])
    expected["survival"] = np.mean([(len(r.frames) - 1) / (b - a) for r, a, b in zip(recordings, ref.first, ref.last)])
    assert set(found) - set(FIELD) == set(KEYS) == set(expected) and set(FIELD) < set(found)
    for key in KEYS:
        assert found[key] == pytest.approx(expected[key], rel=1e-5, abs=1e-5), key
        assert expected[key] > 0 or key == "completed", key


def test_field_units_against_slow_loop(char, ref):
    """One joint and one frame at a time: MuJoCo's poses, SciPy's splines and rotations."""
    recordings, rng = metrics.kinematic(char, ref), np.random.default_rng(1)
    for rec, aside in zip(recordings, (0.0, 0.1, 0.6)):  # one fails, one is held, one is too far away
        rec.qpos = rec.qpos + np.append([0.0, aside, 0.0], np.zeros(rec.qpos.shape[1] - 3))
        rec.qpos[:, 7:] += 0.05 * rng.standard_normal(rec.qpos[:, 7:].shape)
    recordings[0].failed = True
    found, m, data = metrics.measure(char, ref, recordings), char.model, mujoco.MjData(char.model)
    body = {s: m.body("spine3" if s == "chest" else s).id for s in SEGMENTS}
    rest = mujoco.MjData(m)
    rest.qpos[:] = char.upright
    mujoco.mj_forward(m, rest)
    rests = {s: rotation_of(rest.xquat[b]) for s, b in body.items()}
    sums, phc, height = {k: [] for k in FIELD}, [], []
    for rec in recordings:
        n, p, q = len(rec.frames), {s: [] for s in SEGMENTS}, {s: [] for s in SEGMENTS}
        for qpos in rec.qpos:
            data.qpos[:] = qpos
            mujoco.mj_forward(m, data)
            for s, b in body.items():
                p[s].append(data.xpos[b].copy())
                q[s].append((rotation_of(data.xquat[b]) * rests[s].inv()).as_quat())
        truth = {s: ref.human_pos[rec.frames, i].astype(float) for i, s in enumerate(SEGMENTS)}
        columns = ref.human_rot[rec.frames].astype(float)
        t, fine = np.arange(n) / 30.0, np.arange(2 * n - 1) / 60.0
        at = lambda x, t=t, fine=fine: make_interp_spline(t, np.array(x), k=3)(fine)  # noqa: E731
        x, h = ({s: at(v[s]) for s in SEGMENTS} for v in (p, truth))
        turns = {s: Slerp(t, Rotation.from_quat(q[s]))(fine) for s in SEGMENTS}
        frames = np.concatenate([columns, np.cross(columns[..., 0], columns[..., 1])[..., None]], axis=-1)
        wanted = {s: Slerp(t, Rotation.from_matrix(frames[:, i]))(fine) for i, s in enumerate(SEGMENTS)}
        moved = {s: x[s] + h["head"] - x["head"] for s in SEGMENTS}
        for i, s in enumerate(SEGMENTS):
            off = [100 * np.linalg.norm(a - b) for a, b in zip(moved[s], h[s])]
            sums["mpjpe_cm"] += off
            legs = s == "pelvis" or s.startswith(("thigh", "shin", "foot"))
            sums["lower_pe" if legs else "upper_pe"] += off
            sums["root_pe"] += off if s == "pelvis" else []
            sums["hand_pe"] += off if s.startswith("hand") else []
            for f in range(1, len(fine)):
                v, w = (60 * (k[s][f] - k[s][f - 1]) for k in (moved, h))
                sums["mpjve_cm_s"].append(100 * np.linalg.norm(v - w))
            for f in range(3, len(fine)):
                third = x[s][f] - 3 * x[s][f - 1] + 3 * x[s][f - 2] - x[s][f - 3]
                sums["jitter_km_s3"].append(np.linalg.norm(third) * 60**3 / 1000)
            if i and not s.startswith("hand"):  # Jesse's hands have no joint
                above = SEGMENTS[PARENTS[i]]
                a, b = ((k[above].inv() * k[s]).as_rotvec() for k in (turns, wanted))
                sums["mpjre_deg"] += list(np.degrees(np.abs(a - b)).ravel())
        mean = np.mean([np.linalg.norm(x[s] - h[s], axis=1) for s in SEGMENTS], axis=0)
        held = ("pelvis", "foot_l", "foot_r", "hand_l", "hand_r")
        low = max(np.abs(x[s][:, 2] - h[s][:, 2]).max() for s in held)
        facing = (turns["pelvis"].inv() * wanted["pelvis"]).magnitude().max()
        phc.append(not rec.failed and mean.max() <= 0.5)
        height.append(not rec.failed and low <= 0.25 and facing <= 1.0)
    expected = {k: np.mean(v) for k, v in sums.items() if v}
    expected |= {"success_phc": np.mean(phc), "success_height": np.mean(height)}
    assert set(expected) == set(FIELD)
    assert expected["success_phc"] == pytest.approx(1 / 3) and expected["success_height"] == pytest.approx(2 / 3)
    for key in FIELD:
        assert found[key] == pytest.approx(expected[key], rel=1e-4), key


def test_metrics_of_kinematic(char, ref):
    """The reference itself: no error against itself; the human's figures are the ones that `mocap` counts."""
    recordings = metrics.kinematic(char, ref)
    assert [len(r.frames) for r in recordings] == [40, 90, 30] and [r.available for r in recordings] == [39, 89, 29]
    row = metrics.measure(char, ref, recordings)
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
    assert not any(r.contact.any() for r in metrics.kinematic(char, replace(ref, qpos=lifted)))


def test_metrics_on_known_motion(char, ref):
    still_ref, rec = still(char, ref)
    nothing = metrics.measure(char, still_ref, [rec])
    for key in ("root_cm", "head_cm", "hands_cm", "head_deg", "jitter_m_s3", "head_wobble_deg_s", "joint_pos_cm"):
        assert nothing[key] == pytest.approx(0.0, abs=1e-5), key
    assert nothing["contact_agreement"] == 1.0

    def changed(f, **more):
        qpos = rec.qpos.copy()
        f(qpos)
        return metrics.measure(char, replace(still_ref, **more), [replace(rec, qpos=qpos)])

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
    total, count = metrics.jitter((t[:, None, None] ** 3) * [[[1.0, 2.0, 2.0], [0.0, 1.0, 0.0]]], 30.0)
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


def test_human_is_measured_before_the_scaling():
    clip, rows = walk(3.0), []
    for change in ((), ("root.scale_xy=0.5",)):
        c = character.load("jesse", set=change)
        r = retarget.reference(c, [clip])
        rows.append(metrics.measure(c, r, metrics.kinematic(c, r)))
    for key in ("human_steps_per_m", "human_jitter_m_s3"):
        assert rows[0][key] == pytest.approx(rows[1][key], rel=1e-3), key


def test_head_is_compared_with_the_humans(char, ref):
    still_ref, rec = still(char, ref)
    nods = quat_mul(quat_about(1, 0.2), still_ref.orientation)  # the human does, the kinematic pose not
    row = metrics.measure(char, replace(still_ref, orientation=nods), [rec])
    assert row["head_deg"] == pytest.approx(np.degrees(0.2))


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
    row = metrics.measure(char, r, [replace(rec, qpos=qpos, contact=contact, action=action)])
    assert metrics.footfalls(contact) == 3  # left at 2 and 6, right at 7; the right foot stood at the start
    assert row["steps_per_m"] == pytest.approx(3 / 2.0) and row["human_steps_per_m"] == pytest.approx(2 / 4.0)
    agree = sum(c == h for c, h in zip(contact[1:].ravel(), human_contact[1:].ravel()))
    assert row["contact_agreement"] == pytest.approx(agree / 20)
    assert row["torque_rms"] == pytest.approx(np.sqrt((5 * 0.25 + 5 * 1.0) / 10)) and row["saturation"] == 0.5


def test_completed_and_survival(char, ref):
    still_ref, rec = still(char, ref, 31)

    def cut(k, failed):
        parts = (v[: k + 1] for v in (rec.frames, rec.qpos, rec.contact, rec.action))
        return Recording(*parts, failed, 30)

    row = metrics.measure(char, still_ref, [cut(30, False), cut(15, True), cut(6, True), cut(29, True)])
    assert row["clips"] == 4 and row["completed"] == 0.25
    assert row["survival"] == pytest.approx((1 + 0.5 + 0.2 + 29 / 30) / 4)


def test_nothing_to_measure(char, ref):
    """A clip that fails in its first step leaves one frame: no division by zero, and no zero that flatters."""
    still_ref, rec = still(char, ref, 31)
    one = Recording(rec.frames[:1], rec.qpos[:1], rec.contact[:1], rec.action[:1], True, 30)
    with np.errstate(all="raise"):
        row = metrics.measure(char, still_ref, [one])
        assert row["completed"] == row["survival"] == 0.0 and row["root_cm"] == 0.0
        assert set(row) == {*KEYS, *FIELD} and row["success_phc"] == row["success_height"] == 0.0
        steps = ("contact_agreement", "jitter_m_s3", "human_jitter_m_s3", "steps_per_m", "human_steps_per_m")
        steps += ("own_slide_cm_s", "foot_slide_cm_s", "head_wobble_deg_s", "torque_rms", "saturation", "spring_share")
        steps += ("mpjve_cm_s", "jitter_km_s3")
        for key in (*steps, *GROUPS):
            assert np.isnan(row[key]), key
        for count in (2, 3):
            few = Recording(*(v[:count] for v in (rec.frames, rec.qpos, rec.contact, rec.action)), True, 30)
            assert np.isnan(metrics.measure(char, still_ref, [few])["jitter_m_s3"])
    json.loads(metrics.as_json({"policy": row}), parse_constant=lambda c: pytest.fail(c))
    text = metrics.report({"policy": row})
    assert "nan" not in text and "inf" not in text and "jitter - m/s³, - steps/m" in text


def test_a_real_first_step_failure(char, ref):
    def thrown(env):
        env.qpos[:, 0] += 5.0
        return metrics.zero_action(env)

    recordings = metrics.simulate(char, ref, thrown, threads=1)
    assert all(r.failed and len(r.frames) == 1 for r in recordings)
    assert not too_far(recordings[0].qpos[:, :3], ref.qpos[recordings[0].frames, :3]).any()
    row = metrics.measure(char, ref, recordings)
    assert row["completed"] == row["survival"] == 0.0 and row["root_cm"] == 0.0


def test_sip_bodies(char):
    names = {char.model.body(b).name for b in metrics.sip_bodies(char)}
    assert names == {"upper_arm_l", "upper_arm_r", "thigh_l", "thigh_r"}
    spec = {k: v for k, v in char.spec.items() if k != "metrics"}
    assert not len(metrics.sip_bodies(replace(char, spec=spec)))
    for table in ({"sip": ["thigh_l", "wing"]}, {"sip": []}, {}):
        with pytest.raises(UserError, match=r"jesse.toml: \[metrics\] sip.*thigh_l"):
            metrics.sip_bodies(replace(char, spec=char.spec | {"metrics": table}))


def test_table(char, ref):
    row = metrics.measure(char, ref, metrics.kinematic(char, ref))
    rows = {"policy": row | {"fails_every_s": float("inf")}, "kinematic": row}
    text = metrics.report(rows)
    ours, field, _ = text.split("\n\n")
    assert ours == metrics.table(rows) and field == metrics.table(rows, BESIDE)
    found = [c.strip() for c in field.splitlines()[3].split("|")]
    assert found[1:5] == ["kinematic", "-", "-", f"{row['mpjpe_cm']:.1f}"]
    lines = text.splitlines()
    width = len(metrics.COLUMNS) + 1
    assert [line.count("|") for line in lines[:4]] == [width + 1] * 4
    cells = [c.strip() for c in lines[3].split("|")]
    assert cells[1:5] == ["kinematic", "-", "-", "-"] and cells[5 + 2] == "0.0"  # completed by definition: a dash
    assert "never" in lines[2] and "the human: jitter" in text and "3 sequences" in text


def test_comparison(char, ref):
    """`table` turned round: the same cells, a metric a row and a policy a column."""
    row = metrics.measure(char, ref, metrics.kinematic(char, ref))
    results = {"runs/a": row | {"fails_every_s": float("inf")}, "b.npz": row, "kinematic jesse": row}
    grid = lambda text: [[c.strip() for c in r.split("|")[1:-1]] for r in text.splitlines() if "|" in r]  # noqa: E731
    found, turned = grid(metrics.comparison(results)), grid(metrics.table(results))
    assert found[0] == ["", "runs/a", "b.npz", "kinematic jesse"]
    found, turned = (np.array([r for r in g if r[0] != "---"]) for g in (found, turned))
    np.testing.assert_array_equal(found, turned.T)
    assert found[4].tolist() == ["fails every s", "never", "-", "-"] and found[5, 0] == "first fails s"
    ours, field, line = metrics.report(results, metrics.comparison).split("\n\n")
    assert ours == metrics.comparison(results) and field == metrics.comparison(results, BESIDE)
    assert line == metrics.report(results).splitlines()[-1]


def test_json():
    """NaN and infinity are null; everything else stays."""
    rows = {"a": {"x": float("nan"), "y": float("inf"), "z": 1.5, "n": 2}}
    clean = json.loads(metrics.as_json(rows), parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert clean == {"a": {"x": None, "y": None, "z": 1.5, "n": 2}}


# ------------------------------------------------------------------------------------ skating, springs, its own shapes


def test_own_slide():
    """A sole of two points: the lower one counts, only between two steps at which the foot presses."""
    soles = np.zeros((4, 2, 2, 3))
    soles[:, :, 1, 2] = 0.1  # the second point is higher
    soles[:, 0, 0, 0] = [0.0, 0.1, 0.3, 0.6]
    soles[:, 0, 1, 1] = 9.0 * np.arange(4)
    contact = np.array([[1, 0], [1, 0], [1, 0], [0, 0]], bool)
    np.testing.assert_allclose(metrics.own_slide(soles, contact, 30.0), [3.0, 6.0])
    assert not len(metrics.own_slide(soles[:1], contact[:1], 30.0))


def test_spring_share(char, ref):
    """Springs alone: 1; motors alone: 0; as strong as each other: one half."""
    still_ref, rec = still(char, ref)
    bent = rec.qpos.copy()
    knee = [k for k, h in enumerate(char.driven) if char.hinges[h].startswith("knee")]
    hinge = char.driven[knee]
    bent[:, 7 + hinge] += 0.3
    torque = metrics.spring_torque(char, bent)
    assert np.count_nonzero(torque[0]) == 2 and torque[0, knee[0]] == pytest.approx(-0.3 * 60.0)
    row = metrics.measure(char, still_ref, [replace(rec, qpos=bent)])
    assert row["spring_share.knee"] == 1.0 and np.isnan(row["spring_share.hip"])
    action = np.zeros_like(rec.action)
    action[:, knee] = torque[:, knee] / char.limits[knee]
    row = metrics.measure(char, still_ref, [replace(rec, qpos=bent, action=action)])
    assert row["spring_share.knee"] == pytest.approx(0.5) == row["spring_share"]
    assert metrics.measure(char, still_ref, [replace(rec, action=action)])["spring_share.knee"] == 0.0
    groups = character.driven_groups(character.load("dino"))
    assert {"tail", "hip", "spine"} <= set(groups) and len(np.concatenate([*groups.values()])) == 37


@pytest.mark.parametrize("name", ["jesse", "oppy", "dino"])
def test_self_penetration(name):
    """Nothing in the default pose; a forearm swung through the trunk is found, as deep as MuJoCo says."""
    char = character.load(name)
    own, m = character.OwnShapes(char), char.model
    rest = np.concatenate([[0, 0, char.hip_height], char.rest[char.root], char.default])
    assert own.overlap(rest[None])[0] == 0.0 and len(own.pairs) > 50
    through = np.tile(rest, (9, 1))
    through[:, 7 + char.hinges.index("shoulder_l_x")] = np.linspace(0, -1.2, 9)  # towards the body
    depth = own.overlap(through)
    assert depth[0] == 0.0 and depth[-1] > 0.01
    data = mujoco.MjData(m)
    data.qpos[:] = through[-1]
    mujoco.mj_forward(m, data)
    assert depth[-1] == pytest.approx(own_depth(m, data, resting_pairs(char)))


# ------------------------------------------------------------------------------------ as a user plays it


def test_streamed(char, ref):
    """The stream's poses are the human's in the same world; the row counts stands, and scores all frames."""
    clip = load("builtin", clips="walk_005")[0]
    pos, quat, seen, scale = metrics.stream_of(char, clip[30:130])
    led = 45 + 1 + 45 + (100 - 1 - 22.5)  # still, speeding up over 22.5 frames of the clip, the rest
    assert len(pos) == len(quat) == len(seen) and abs(len(pos) - (led - 31)) <= 1
    ref = retarget.reference(char, [seen])
    np.testing.assert_allclose(pos, ref.sensor_pos / ref.sensor_scale[:, None] * scale, atol=1e-6)
    assert np.abs(np.sum(quat * ref.sensor_quat, axis=-1)).min() > 1 - 1e-9
    assert np.linalg.norm(pos[0, 0, :2]) < 1e-6 and abs(heading(quat[0, 0])) < 1e-6  # it begins at the origin, ahead
    assert np.linalg.norm(np.diff(pos[:13], axis=0), axis=-1).max() < 1e-9 < np.linalg.norm(pos[40] - pos[0])
    hung, shown = metrics.stream_of(char, clip[30:130], hang=True), replace(ref, sensor_pos=pos, sensor_quat=quat)
    shown = replace(shown, sensor_scale=np.tile(scale, (len(pos), 1)).astype(np.float32))
    np.testing.assert_allclose(hung[0], controllers_hang(shown).sensor_pos, atol=1e-6)  # from the first tick
    np.testing.assert_array_equal(hung[0][:, 0], pos[:, 0])
    stand = load("builtin", clips="stand_007")[0][:90]
    assert abs(len(metrics.stream_of(char, stand)[0]) - (45 + 90 - 31)) <= 1  # begins still: no speeding up
    long = load("builtin", clips="walk_005")[0]
    assert long.seconds > 25 and recorded(long)[1].seconds == pytest.approx(20.0 + 1.5 + 0.75, abs=0.05)  # 20 s of it

    def nothing(obs):
        return np.zeros((len(obs), len(char.limits)))

    row = metrics.streamed(char, nothing, [clip[30:130], stand])
    assert row["clips"] == 2 and row["completed"] == 0.0 and row["failures"] >= 4
    assert 0 < row["survival"] < 0.7 and row["first_failure_s"] > 0.3
    ticks = sum(len(metrics.stream_of(char, c)[0]) for c in (clip[30:130], stand))
    assert row["fails_every_s"] == pytest.approx(ticks / 30 / row["failures"])
    assert row["root_cm"] > 0 and row["jitter_m_s3"] < 1e5  # a stand is a jump, and no motion
    one = metrics.streamed(char, nothing, [stand])
    assert one["completed"] == 0.0 and set(one) == set(row)
    assert row["success_phc"] == row["success_height"] == 0.0 and row["mpjpe_cm"] > 0


def test_streamed_row_of_known_rides(char, monkeypatch):
    """The row, of rides made by hand: one to the end, one with a failure, one with two; each number another way."""
    walk, stand = (load("builtin", clips=c)[0] for c in ("walk_005", "stand_007"))
    clips, rng = [stand[:90], walk[30:130], walk[200:280]], np.random.default_rng(0)
    cuts, rides, streams = [[0], [0, 40], [0, 10, 30]], [], []
    for clip in clips:  # a headset 5 cm above the human's: errors are against what the character was shown
        pos, *rest = metrics.stream_of(char, clip)
        streams.append((pos + [0.0, 0.0, 0.05], *rest))
    shown = iter(streams)
    monkeypatch.setattr(metrics, "stream_of", lambda *args: next(shown))
    seen = retarget.reference(char, [s[2] for s in streams])
    for start, last, stood in zip(seen.first, seen.last, cuts, strict=True):
        t = last - start + 1
        contact, action = rng.random((t, 2)) < 0.5, rng.uniform(-1, 1, (t, len(char.limits)))
        anew = np.isin(np.arange(t), stood)
        ends, far = Counter(fall=len(stood) - 1), 0.7 if len(stood) == 2 else 1.2
        rides.append(Ride(seen.qpos[start : last + 1].copy(), contact, action, anew, ends, 0.0, 0.0, far))
    monkeypatch.setattr(metrics, "ride", lambda *args: rides)
    row = metrics.streamed(char, None, clips)

    lengths = [len(s[0]) for s in streams]
    assert (row["clips"], row["failures"]) == (3, 3) and row["completed"] == pytest.approx(1 / 3)
    assert row["within_1m"] == 0.0  # who completes was 1.2 m off once; who was near failed
    assert row["survival"] == pytest.approx((1 + 39 / lengths[1] + 9 / lengths[2]) / 3)
    assert row["first_failure_s"] == pytest.approx(24 / 30) and row["fails_every_s"] == pytest.approx(
        sum(lengths) / 30 / 3
    )
    head, hands, torque, agree, mj = [], [], [], [], mujoco.MjData(char.model)
    for (pos, *_), r, start, stood in zip(streams, rides, seen.first, cuts, strict=True):
        for t in range(len(pos)):
            mj.qpos[:] = r.qpos[t]
            mujoco.mj_kinematics(char.model, mj)
            error = np.linalg.norm(mj.site_xpos[char.sensor_sites] - pos[t], axis=-1)
            head.append(error[0])
            hands += error[1:].tolist()
            if t not in stood:  # contact and action are measured after steps
                torque += (r.action[t] ** 2).tolist()
                agree += (r.contact[t] == seen.contact[start + t]).tolist()
    assert row["root_cm"] == pytest.approx(0.0, abs=1e-9)  # every life against its own frames
    assert row["head_cm"] == pytest.approx(100 * np.mean(head)) and row["hands_cm"] == pytest.approx(
        100 * np.mean(hands)
    )
    assert row["success_phc"] == row["success_height"] == pytest.approx(1 / 3)  # of captures, not of lives
    assert row["torque_rms"] == pytest.approx(np.sqrt(np.mean(torque)))
    assert row["contact_agreement"] == pytest.approx(np.mean(agree))


def test_landing_is_no_step(char, ref):
    """A character that is put on its feet makes no step by it, whatever the label of the start says."""
    page, rec = still(char, ref)
    rec.qpos[:, 0] = np.linspace(0.0, 1.0, len(rec.qpos))
    rec.contact[1:] = True
    assert metrics.measure(char, page, [rec])["steps_per_m"] == 0.0
    rec.contact[10:20, 0] = False
    assert metrics.measure(char, page, [rec])["steps_per_m"] == pytest.approx(1.0)


def test_halves(ref, monkeypatch):
    """What policies are chosen on and what is reported have no capture in common, and are all of it; of many captures
    a few, evenly."""
    names = {}
    for half in metrics.HALVES:
        single, long = metrics.motion_of(metrics.Options(motion="standing", half=half))
        names[half] = [c.name for c in single]
        assert all(c.seconds >= 20 for c in long)
    assert not set(names["select"]) & set(names["report"])
    assert sorted(names["select"] + names["report"]) == sorted(names["both"]) and len(names["both"]) == 12
    with pytest.raises(UserError, match="--rows oracle: unknown; valid: streamed, tracked"):
        metrics.motion_of(metrics.Options(rows=("oracle",)))
    one = metrics.Options(clips="walk_105", half="report")
    with pytest.raises(UserError, match="--half report: none of the 1 captures; valid: both, select"):
        metrics.motion_of(one)
    assert metrics.motion_of(replace(one, rows=("tracked",)))[0] == []  # a half is of the streamed row
    monkeypatch.setattr(metrics, "MOST", 4)
    few = metrics.captures_of(metrics.Options(motion="standing"))
    assert [c.name for c in few] == [names["both"][i] for i in (0, 4, 7, 11)]


def test_user_scale():
    """--user-scale: hips as many times as high, of the captures and of the stitched sequences."""
    opt = metrics.Options(clips="walk_1*")
    for lists in zip(metrics.motion_of(opt), metrics.motion_of(replace(opt, user_scale=1.2)), strict=True):
        hips, taller = ([c.hip_height for c in clips] for clips in lists)
        assert len(hips) == 2 and taller == pytest.approx([1.2 * h for h in hips])


def test_single_frames_are_left_out(monkeypatch):
    """A sequence of one frame has no step to play: the others are measured, and alone it is said."""
    whole, opt = load("builtin", clips="walk_105")[0], metrics.Options(clips="walk_105")
    monkeypatch.setattr(metrics.mocap.data, "sequences", lambda *_, **__: [whole[:1], whole])
    assert [len(c) for c in metrics.motion_of(opt)[1]] == [len(whole)]
    monkeypatch.setattr(metrics.mocap.data, "sequences", lambda *_, **__: [whole[:1]])
    with pytest.raises(UserError, match="builtin: a single frame; valid: motion, of two frames or more"):
        metrics.motion_of(opt)


def test_command(tmp_path, capsys, monkeypatch):
    """python metrics.py: the streamed row first, and a JSON of the rows asked for."""
    captures = [load("builtin", clips="walk_005")[0][:50]]
    monkeypatch.setattr(metrics, "motion_of", lambda opt: (captures, captures))
    more = ["--rows", "streamed,kinematic", "--threads", "1", "--json", str(tmp_path / "t.json")]
    metrics.main(["--character", "jesse", *more])
    rows = json.loads((tmp_path / "t.json").read_text())
    assert list(rows) == ["streamed", "kinematic"] and rows["streamed"]["clips"] == 1
    assert "| streamed |" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        metrics.main(["--user-scale", "175"])
    assert "from 0.3 to 2 times" in capsys.readouterr().err

    def closed(*_, file=None, **__):
        if file is None:
            raise BrokenPipeError

    (tmp_path / "t.json").unlink()
    monkeypatch.setattr(metrics, "print", closed, raising=False)
    with pytest.raises(BrokenPipeError):  # as in `… | head`: the table is written
        metrics.main(["--character", "jesse", *more])
    assert json.loads((tmp_path / "t.json").read_text()) == rows
