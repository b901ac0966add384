"""One short test per equation of [Reda23], to be read beside the paper: its symbols, each number computed another way.

Longer tests of the same functions, with every corner, are in tests/test_env.py, test_ppo.py, test_retarget.py and
test_characters.py.  Where the paper is silent the choice is ASSUMED and listed in REPRODUCE.md.
"""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import expit
from scipy.stats import norm
from test_env import fresh, velocity

import character
import env as rules
import human
import nn
import ppo
import retarget
from env import Env
from policy import Policy

N, γ, ε = 4, 0.97, 0.2
FRAMES = (20, 40, 80, 100)  # of the reference, where the characters start


def rotation(quat):
    return Rotation.from_quat(quat, scalar_first=True)


@pytest.fixture(scope="module")
def weighed(char):
    """Jesse, whose contact weight is 0 in Table 2, with Oppy's: every term counts."""
    return replace(char, reward=char.reward | {"contact": (1.5, 1.0)})


@pytest.fixture(scope="module")
def env(weighed, ref):
    """Four characters a few steps after their start: away from the reference, all alive."""
    env = Env(weighed, ref, N, seed=1, threads=1)
    env.reset(frames=FRAMES)
    for a in 0.1 * np.random.default_rng(0).standard_normal((4, N, env.action_size)):
        env.step(a)
    assert (env.steps == 4).all()
    return env


@pytest.fixture
def rng():
    return np.random.default_rng(2023)


def floor_frame(root, R):
    """§3.3: a point in the frame on the floor below the root, turned with its heading; and a vector in it."""
    left = R[:, 1]
    forward = np.array([left[1], -left[0], 0.0]) / math.hypot(left[0], left[1])
    axes = np.array([forward, [-forward[1], forward[0], 0.0], [0.0, 0.0, 1.0]])  # rows: forward, left, up
    return (lambda p: axes @ (p - root * [1, 1, 0])), (lambda v: axes @ v)


def o_sim(env, n):
    """Eq. 3, from MuJoCo's arrays, link by link."""
    d, links = fresh(env, n), env.char.obs_links
    point, vector = floor_frame(d.qpos[:3], d.xmat[env.char.root].reshape(3, 3))
    spin, _ = velocity(d, env.char.root)
    x = [point(d.xpos[i]) for i in links]
    R = [vector(d.xmat[i].reshape(3, 3))[:, :2].ravel() for i in links]  # the first two columns
    return np.concatenate([d.qpos[7:], vector(d.qvel[:3]), vector(spin), d.qvel[6:], *x, *R])


def o_user(env, n, t):
    """Eq. 4, device by device; in the frame of the present state, whatever the frame t of the motion."""
    d, ref = fresh(env, n), env.ref
    point, vector = floor_frame(d.qpos[:3], d.xmat[env.char.root].reshape(3, 3))
    hlr = [point(p) for p in ref.sensor_pos[t]]
    return np.concatenate([*hlr, *(vector(rotation(q).as_matrix())[:, :2].ravel() for q in ref.sensor_quat[t])])


# ------------------------------------------------------------------------------------ §3.1 and Appendix B


def test_eq_1_discounted_return(rng):
    """J = E[Σ_t γ^t r_t]: with V = 0 everywhere and λ = 1 the advantage of the first step is this sum."""
    r, zero, never = rng.standard_normal((30, 1)), np.zeros((30, 1)), np.zeros((30, 1), bool)
    A, _ = ppo.gae(r, zero, zero, never, γ, 1.0)
    assert A[0, 0] == pytest.approx(sum(γ**t * r[t, 0] for t in range(30)))


def episode(rng, T=12):
    """r_t, V_old(o_t), V_old(o_{t+1}) of one trajectory that does not end."""
    r, V_old = rng.standard_normal((T, 1)), rng.standard_normal((T + 1, 1))
    return r, V_old[:-1], V_old[1:]


def test_app_b_return_recursion(rng):
    """V(o_t) = r_t + γ V(o_{t+1}), with λ = 1: solved at once as the linear system (I − γ S) V = r + γ b."""
    r, V_old, V_next = episode(rng)
    _, V = ppo.gae(r, V_old, V_next, np.zeros(r.shape, bool), γ, 1.0)
    b = np.append(np.zeros(len(r) - 1), V_next[-1])  # the bootstrap of the last step
    np.testing.assert_allclose(V[:, 0], np.linalg.solve(np.eye(len(r)) - γ * np.eye(len(r), k=1), r[:, 0] + γ * b))


def test_app_b_bootstrap(rng):
    """V(o_T) = r_T + γ V_old(o_{T+1}) at the trajectory's end, and where an episode was cut; 0 beyond a failure."""
    r, V_old, V_next = episode(rng)
    done = np.zeros(r.shape, bool)
    done[[3, 7]], V_next[3], V_next[7] = True, 5.0, 0.0  # step 3: time is up in a state worth 5; step 7: a fall
    _, V = ppo.gae(r, V_old, V_next, done, γ, 1.0)
    assert V[-1, 0] == pytest.approx(r[-1, 0] + γ * V_next[-1, 0])
    assert V[3, 0] == pytest.approx(r[3, 0] + γ * 5.0) and V[7, 0] == pytest.approx(r[7, 0])
    assert V[2, 0] == pytest.approx(r[2, 0] + γ * V[3, 0])


def test_app_b_old_network_bootstraps(char, ref):
    """What the trajectory's last step is continued with is V_old of the observation after it."""
    opt = ppo.Options(envs=3, horizon=2, minibatch=6, hidden=(5,), value_hidden=(5,), threads=1)
    t = ppo.Trainer(opt, Env(char, ref, 3, threads=1))
    t.start()
    t.env.reset(frames=FRAMES[:3])
    t.collect()
    assert not (t.terminated | t.truncated).any()
    V_old = [t.policy.value_scale * t.policy.critic(t.policy.norm(t.env.full[n : n + 1]))[0, 0] for n in range(3)]
    np.testing.assert_allclose(t.next_value[-1], V_old, rtol=1e-5)
    np.testing.assert_allclose(t.next_value[0], t.old_value[1])  # V(o_{t+1}) of the step before


def test_app_b_advantage(rng):
    """A_t = V(o_t) − V_old(o_t), with λ = 1; Â_t has mean 0 and standard deviation 1 (ASSUMED)."""
    r, V_old, V_next = episode(rng)
    A, V = ppo.gae(r, V_old, V_next, np.zeros(r.shape, bool), γ, 1.0)
    T = len(r)
    slow = [sum(γ**k * r[t + k, 0] for k in range(T - t)) + γ ** (T - t) * V_next[-1, 0] for t in range(T)]
    np.testing.assert_allclose(V[:, 0], slow)
    np.testing.assert_allclose(A[:, 0], np.array(slow) - V_old[:, 0])
    np.testing.assert_allclose(ppo.standardise(A[:, 0]), (A[:, 0] - sum(A[:, 0]) / T) / np.sqrt(np.var(A)), atol=1e-6)


def test_app_b_ratio(rng):
    """ρ_t = π_θ(a_t|o_t) / π_θ_old(a_t|o_t): a quotient of products of SciPy's normal densities."""
    a, μ, μ_old, σ = *rng.normal(size=(3, 5, 2)), np.array([0.5, 0.9])
    logp, logp_old = (nn.gaussian_logp(a, m, np.log(σ)) for m in (μ, μ_old))
    ρ = ppo.clipped_surrogate(logp, logp_old, np.ones(5), ε)[2]
    np.testing.assert_allclose(ρ, norm.pdf(a, μ, σ).prod(1) / norm.pdf(a, μ_old, σ).prod(1))


def test_app_b_clipped_loss():
    """L = mean_t min(ρ Â, clip(ρ, 1−ε, 1+ε) Â), ε = 0.2, in numbers; the optimiser minimises −L."""
    ρ, Â = np.array([0.5, 1.0, 1.5, 0.5, 1.0, 1.5]), np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    loss, dlogp, _ = ppo.clipped_surrogate(np.log(ρ), np.zeros(6), Â, ε)
    assert loss == pytest.approx(-(0.5 + 1.0 + 1.2 - 0.8 - 1.0 - 1.5) / 6)
    np.testing.assert_allclose(dlogp, -np.array([0.5, 1.0, 0.0, 0.0, -1.0, -1.5]) / 6)  # none where it is clipped


def test_app_b_policy_gradient(rng):
    """∇_θ of −L through the network, along a random direction in θ, by a central difference."""
    policy = Policy(3, 3, 2, (4,), (4,), 0.5, 1.0, rng, dtype=np.float64, activation="tanh")
    o, a, logp_old, Â = rng.normal(size=(8, 3)), rng.normal(size=(8, 2)), rng.normal(-2, 0.1, 8), rng.normal(size=8)
    _, gradient, _ = ppo.policy_loss(policy, o, a, logp_old, Â, ε)
    θ, u, h, L = policy.theta_pi.copy(), rng.normal(size=gradient.shape), 1e-6, []
    for side in (h, -h):
        policy.theta_pi[:] = θ + side * u
        L.append(ppo.policy_loss(policy, o, a, logp_old, Â, ε)[0])
    assert gradient @ u == pytest.approx((L[0] - L[1]) / (2 * h), rel=1e-6)


def test_app_b_value_loss(rng):
    """The value network learns by supervision: ½ mean (V(o_t) − target)²."""
    policy = Policy(3, 5, 2, (4,), (4,), 0.5, 1.0, rng, dtype=np.float64)
    o, target = rng.normal(size=(8, 5)), rng.normal(size=8)
    slow = sum((policy.critic(o[n : n + 1])[0, 0] - target[n]) ** 2 for n in range(8)) / 16
    assert ppo.critic_loss(policy, o, target)[0] == pytest.approx(slow)


# ------------------------------------------------------------------------------------ §3.3 observations


def test_eq_2_observation(env):
    """o_t = [o_{t,sim}, o_{t−1,user}, o_{t,user}]."""
    for n in range(N):
        t = env.frame[n]
        o = np.concatenate([o_sim(env, n), o_user(env, n, t - 1), o_user(env, n, t)])
        assert o.shape == (env.obs_size,)
        np.testing.assert_allclose(env.full[n, : env.obs_size], o, rtol=1e-5, atol=2e-5)


def test_eq_3_character(env):
    """o_sim = [q, q̇, x, R], by the environment's arrays; q̇ begins with the root's six (ASSUMED)."""
    c, j, links = env.char, env.char.j, len(env.char.obs_links)
    frame = rules.HeadingFrame(env.qpos[:, :3], env.qpos[:, 3:7])
    x, R = env.xpos[:, c.obs_links], env.xmat[:, c.obs_links].reshape(N, links, 3, 3)[..., :2]
    out = np.zeros((N, 2 * j + 6 + 9 * links))
    rules.observe_sim(frame, env.qpos, env.qvel, env.cvel[:, c.root, :3], x, R, out)
    for n in range(N):
        np.testing.assert_allclose(out[n], o_sim(env, n), atol=1e-9)


def test_eq_4_user(env):
    """o_user = [h, l, r, R_h, R_l, R_r]."""
    frame, t, ref = rules.HeadingFrame(env.qpos[:, :3], env.qpos[:, 3:7]), env.frame, env.ref
    out = rules.observe_user(frame, ref.sensor_pos[t], ref.sensor_rot[t], np.zeros((N, 27)))
    for n in range(N):
        np.testing.assert_allclose(out[n], o_user(env, n, t[n]), atol=1e-6)


def test_3_3_frame_turns_with_the_heading(rng):
    """p' = R_z(−ψ)(p − root on the floor): what is 1 m ahead and 1 m up is so for every ψ, bent over or not."""
    for ψ, pitch in rng.uniform([-3, -2.5], [3, 2.5], (20, 2)):
        q = Rotation.from_euler("ZY", [ψ, pitch]).as_quat(scalar_first=True)
        root = np.array([4.0, -3.0, 0.9])
        p = root * [1, 1, 0] + [math.cos(ψ), math.sin(ψ), 1.0]
        placed = rules.HeadingFrame(root[None], q[None]).place(p[None, None], np.zeros((1, 1, 3)))
        np.testing.assert_allclose(placed[0, 0], [1.0, 0.0, 1.0], atol=1e-12)


def test_3_3_critic_sees_the_human_and_its_future(env):
    """Joints of the mocap pose now, and 1, 5 and 15 frames ahead; the actor's part holds none of it."""
    for n in range(N):
        d, t = fresh(env, n), env.frame[n]
        point, _ = floor_frame(d.qpos[:3], d.xmat[env.char.root].reshape(3, 3))
        end = env.ref.last[env.sequence[n]]
        for name, k in (("human_pos", 0), ("human_pos_in_1", 1), ("human_pos_in_5", 5), ("human_pos_in_15", 15)):
            wanted = np.concatenate([point(p) for p in env.ref.human_pos[min(t + k, end)]])
            np.testing.assert_allclose(env.full[n, env.slices[name]], wanted, atol=2e-5)
            assert env.slices[name].start >= env.obs_size


# ------------------------------------------------------------------------------------ §3.4 training data


@pytest.fixture(scope="module")
def walk():
    from mocap import data

    return data.load("builtin", clips="walk_005")[0][:60]


def test_3_4_sensors(walk):
    """Headset and controllers: the joint of head and wrist, and an offset that turns with it (its size ASSUMED)."""
    pos, quat = human.sensors(walk)
    for device, segment in enumerate(("head", "hand_l", "hand_r")):
        joint, turn = walk.pos[30, human.SEG[segment]], rotation(walk.quat[30, human.SEG[segment]])
        np.testing.assert_allclose(pos[30, device], joint + turn.as_matrix() @ human.SENSOR_OFFSETS[device])
        np.testing.assert_allclose(rotation(quat[30, device]).as_matrix(), turn.as_matrix())


def test_3_4_joint_angles(char, walk):
    """Selected human joint angles on the character's joints: its upper arm turns against its chest as the user's."""
    qpos, d = retarget.retarget(char, walk).qpos, mujoco.MjData(char.model)
    for t in (10, 40):
        d.qpos[:] = qpos[t]
        mujoco.mj_kinematics(char.model, d)
        chest, arm = (rotation(d.xquat[b]) * rotation(char.rest[b]).inv()
                      for b in (char.model.body("spine3").id, char.model.body("upper_arm_l").id))  # fmt: skip
        user = [rotation(walk.quat[t, human.SEG[s]]) for s in ("chest", "upper_arm_l")]
        np.testing.assert_allclose((chest.inv() * arm).as_rotvec(), (user[0].inv() * user[1]).as_rotvec(), atol=1e-6)


def test_3_4_scaled_root(char, walk):
    """x and y as the user goes, z times the ratio of the hips' heights (ASSUMED, Fig. 5)."""
    thigh, shin, foot = (walk.pos[0, human.SEG[s]] for s in ("thigh_l", "shin_l", "foot_l"))
    leg = math.dist(thigh, shin) + math.dist(shin, foot)  # both legs are alike
    hips = leg + np.mean([np.percentile(walk.pos[:, f, 2], 5) for f in human.FEET])
    scaled = walk.pos[:, 0] * [1.0, 1.0, char.hip_height / hips]
    np.testing.assert_allclose(retarget.retarget(char, walk).qpos[:, :3], scaled, rtol=1e-6)


# ------------------------------------------------------------------------------------ §3.5 reward


def random_terms(rng):
    return {name: rng.uniform(0, 3, N) for name in character.TERMS}


def test_eq_5_reward(rng):
    """r = r(imitation) + r(contact) + r(action): a unit of any term is a unit of the reward."""
    terms = random_terms(rng)
    r = rules.total_reward(terms)
    for name in character.TERMS:
        np.testing.assert_allclose(rules.total_reward(terms | {name: terms[name] + 1.0}), r + 1.0)
    np.testing.assert_allclose(r, [sum(terms[name][n] for name in character.TERMS) for n in range(N)])


def test_eq_6_imitation(rng):
    """r(imitation) = r(q) + r(q̇) + r(x) + r(ẋ) + r(orientation)."""
    terms, zero = random_terms(rng), dict.fromkeys(character.TERMS, np.zeros(N))
    five = {name: terms[name] for name in ("q", "qd", "x", "xd", "orientation")}
    np.testing.assert_allclose(rules.total_reward(zero | five), np.sum([*five.values()], axis=0))


def test_eq_7_action(rng):
    """r(action) = r(action diff) + r(action min)."""
    terms, zero = random_terms(rng), dict.fromkeys(character.TERMS, np.zeros(N))
    two = {name: terms[name] for name in ("action_diff", "action_min")}
    np.testing.assert_allclose(rules.total_reward(zero | two), terms["action_diff"] + terms["action_min"])


def test_eq_8_kernel():
    """r(s) = w exp(−k d): 4 at d = 0, halved where k d = ln 2, by the logistic function elsewhere."""
    w, k = 4.0, 25.0  # Table 2: Jesse's q
    assert rules.kernel(w, k, np.array([0.0, math.log(2.0) / k])).tolist() == pytest.approx([4.0, 2.0])
    d = np.linspace(0.0, 0.4, 9)
    np.testing.assert_allclose(rules.kernel(w, k, d), [w * expit(-k * x) / expit(k * x) for x in d])


def test_eq_8_every_term_by_its_distance(env, rng):
    """Each of the environment's terms is Table 2's w exp(−k d) of Eqs. 9 to 11 and of the two distances of App. A."""
    a, ref, t, c = rng.uniform(-1, 1, (N, env.action_size)), env.ref, env.frame, env.char
    terms = env.reward_terms(a)
    for n in range(N):
        q = sum((env.qpos[n, 7 + i] - ref.qpos[t[n], 7 + i]) ** 2 for i in range(c.j)) / c.j
        mj = fresh(env, n)
        q̇ = np.mean((env.qvel[n, 6:] - ref.qvel[t[n], 6:]) ** 2)
        x = np.mean(np.sum((mj.xpos[c.reward_links] - ref.link_pos[t[n]]) ** 2, axis=1))
        turns = [Rotation.from_quat(np.roll(p, -1)).inv() * Rotation.from_quat(np.roll(r, -1))
                 for p, r in zip(mj.xquat[[c.root, c.head]], ref.orientation[t[n]], strict=True)]  # fmt: skip
        ẋ = [velocity(mj, b)[1] for b in c.reward_links]
        angle = np.mean([turn.magnitude() for turn in turns])
        d = dict(q=q, qd=q̇, x=x, orientation=angle, xd=np.mean(np.sum((ẋ - ref.link_vel[t[n]]) ** 2, axis=1)),
                 contact=np.linalg.norm(1.0 * env.contact[n] - ref.contact[t[n]]),
                 action_diff=np.mean((a[n] - env.action[n]) ** 2), action_min=np.mean(a[n] ** 2))  # fmt: skip
        assert set(d) == set(terms)
        for name, distance in d.items():
            w, k = c.reward[name]
            assert terms[name][n] == pytest.approx(w * math.exp(-k * distance), rel=1e-4), name


def test_eq_9_action_difference(rng):
    """d = (1/N) Σ_i (a_{t−1,i} − a_{t,i})²."""
    a_before, a = rng.uniform(-1, 1, (2, 3, 33))
    slow = [sum((a_before[n, i] - a[n, i]) ** 2 for i in range(33)) / 33 for n in range(3)]
    np.testing.assert_allclose(rules.action_diff(a_before, a), slow)


def test_eq_10_action_minimum(rng):
    """d = (1/N) Σ_i a_{t,i}²."""
    a = rng.uniform(-1, 1, (3, 33))
    np.testing.assert_allclose(rules.action_min(a), [sum(v**2 for v in row) / 33 for row in a])
    assert rules.action_min(np.array([[3.0, 4.0]]))[0] == 12.5


def test_eq_11_weighted_distance(rng):
    """d = Σ_i w_i ‖x_{i,sim} − x_{i,gt}‖², over joint angles and over links; the weights sum to 1 (ASSUMED)."""
    w = character.normalised([1.0, 3.0])
    q, x = np.array([[0.2, 0.1]]), np.array([[[0.0, 3.0, 4.0], [1.0, 2.0, 2.0]]])
    assert rules.weighted_distance(q, 0 * q, w)[0] == pytest.approx((0.2**2 + 3 * 0.1**2) / 4)
    assert rules.weighted_distance(x, 0 * x, w)[0] == pytest.approx((5.0**2 + 3 * 3.0**2) / 4)
    x, x_gt, w = *rng.normal(size=(2, 4, 6, 3)), character.normalised(rng.uniform(size=6))
    slow = [sum(w[i] * math.dist(x[n, i], x_gt[n, i]) ** 2 for i in range(6)) for n in range(4)]
    np.testing.assert_allclose(rules.weighted_distance(x, x_gt, w), slow)


def test_3_5_orientation_distance(rng):
    """The norm of the axis-angle of q_gt q_sim^{-1}, by SciPy; mean of root and head (ASSUMED)."""
    q_sim, q_gt = (Rotation.random(2 * N, rng=rng) for _ in range(2))
    slow = np.linalg.norm((q_gt * q_sim.inv()).as_rotvec(), axis=1).reshape(N, 2).mean(1)
    sim, gt = (q.as_quat(scalar_first=True).reshape(N, 2, 4) for q in (q_sim, q_gt))
    np.testing.assert_allclose(rules.orientation_distance(sim, gt), slow)
    np.testing.assert_allclose(rules.orientation_distance(-sim, gt), slow)  # q and −q are one rotation


def test_3_5_orientation_is_the_humans(env, ref):
    """q_gt of root and head: the human's rotation times the character's own at rest, not the retargeted pose."""
    c, t = env.char, env.frame
    terms, (w, k) = env.reward_terms(np.zeros((N, env.action_size))), env.char.reward["orientation"]
    for n in range(N):
        M = ref.human_rot[t[n]][[human.SEG["pelvis"], human.SEG["head"]]]  # two columns; the third is their product
        user = Rotation.from_matrix(np.dstack([M[..., 0], M[..., 1], np.cross(M[..., 0], M[..., 1])]))
        gt, sim = user * rotation(c.rest[[c.root, c.head]]), rotation(fresh(env, n).xquat[[c.root, c.head]])
        angle = (gt * sim.inv()).magnitude().mean()
        assert terms["orientation"][n] == pytest.approx(w * math.exp(-k * angle), rel=1e-4)


def test_3_5_contact_distance():
    """‖c_sim − c_human‖ over two feet: 0, 1 or √2, whichever foot it is (not squared, ASSUMED)."""
    none, left, right, both = [0, 0], [1, 0], [0, 1], [1, 1]
    c_sim, c_human = np.array([both, left, left, none], bool), np.array([both, both, right, both], bool)
    np.testing.assert_allclose(rules.contact_distance(c_sim, c_human), [0.0, 1.0, math.sqrt(2), math.sqrt(2)])


def test_3_5_human_contact_labels(walk):
    """A foot touches where it is below 0.20 m and slower than 0.4 m/s, on the human as recorded."""
    t, still = np.arange(60)[:, None] / walk.rate, np.zeros((60, 1))
    pos, ball = np.full_like(walk.pos, 1.0), np.full_like(walk.ball, 1.0)  # balls a metre up: the ankles decide
    for height, speed, touches in ((0.19, 0.39, True), (0.21, 0.39, False), (0.19, 0.41, False), (0.0, 0.0, True)):
        pos[:, human.FEET[0]] = np.hstack([speed * t, still, still + height])
        c = human.contacts(replace(walk, pos=pos, ball=ball))
        assert (c[:, 0] == touches).all() and not c[:, 1].any()


def test_3_5_character_contact_labels(weighed, ref):
    """A foot touches where the contact's normal force is above 1 N."""
    env = Env(weighed, ref, 4, threads=1)
    env.sensordata = np.zeros_like(env.sensordata)
    env.sensordata[:, weighed.contact_adr] = [[0.0, 0.99], [1.01, 0.0], [1.01, 300.0], [0.99, 0.99]]
    assert env._contact().tolist() == [[False, False], [True, False], [True, True], [False, False]]


@pytest.mark.parametrize("name, passive", [("oppy", ("tail", "ear")), ("dino", ("tail",)), ("jesse", ())])
def test_3_5_tails_and_ears_are_not_imitated(name, passive):
    """They have no human motion: weight 0 in q and q̇.  Lower-body joints: 0.3 (Jesse: 1) of the others' weight."""
    c = character.load(name)
    for hinge, w in zip(c.hinges, c.joint_weights):
        lower = hinge.startswith(("hip", "knee", "ankle")) and name != "jesse"
        relative = 0.0 if hinge.startswith(passive or ("none",)) else 0.3 if lower else 1.0
        assert w == pytest.approx(relative * c.joint_weights.max()), hinge


# ------------------------------------------------------------------------------------ §3.6 termination


def test_3_6_upper_body_on_the_ground(char, ref, rng):
    """A failure where MuJoCo finds a contact of the floor with any body but the legs."""
    env = Env(char, ref, 60, threads=1)
    env.reset()
    env.qpos[:, 3:7] = Rotation.random(60, rng=rng).as_quat(scalar_first=True)
    env.qpos[:, 2] = rng.uniform(0.2, 0.8, 60)
    env.refresh()
    fallen = rules.fallen(character.geom_lowest(char.model, char.fall_geoms, env.geom_xpos, env.geom_xmat).min(1))
    for n in range(60):
        d = fresh(env, n)
        bodies = {char.model.body(char.model.geom_bodyid[g]).name for c in d.contact[: d.ncon] for g in c.geom}
        assert fallen[n] == bool({b for b in bodies if not b.startswith(("world", "thigh", "shin", "foot"))})
    assert 10 < fallen.sum() < 50


def test_3_6_root_farther_than_0_30_m():
    """In three dimensions (ASSUMED): 3-4-5 triangles of 0.30 m, and a millimetre more."""
    offset = np.array([[0.18, 0.24, 0], [0, 0.18, 0.24], [0.181, 0.24, 0], [0, 0, -0.301], [0.1, 0.1, 0.1]])
    assert rules.too_far(0.999 * offset, 0 * offset).tolist() == [False, False, True, True, False]


def test_3_6_a_failure_costs_5_and_the_clock_nothing(weighed, ref):
    """r = Σ terms − 5 where an episode fails; a clip's end and 500 steps truncate it, and cost nothing."""
    env = Env(weighed, ref, N, threads=1)
    env.reset(frames=[20, 20, 20, ref.last[0] - 1])
    env.qpos[1, 0] += 0.5  # too far from its target
    env.steps[2] = 499
    _, r, terminated, truncated, info = env.step(np.zeros((N, env.action_size)))
    bonus = r - sum(info["terms"].values())
    np.testing.assert_allclose(bonus, [0.0, -5.0, 0.0, 0.0], atol=1e-12)
    assert terminated.tolist() == [False, True, False, False] and truncated.tolist() == [False, False, True, True]
    assert info["ends"]["time"].tolist() == [False, False, True, False] and info["ends"]["clip"][3]


def test_3_6_reset_to_a_mocap_frame(char, ref):
    """Position and velocity of the retargeted pose: every imitation term is at its maximum w."""
    env = Env(char, ref, 8, seed=3, threads=1)
    env.reset()
    terms = env.reward_terms(np.zeros((8, env.action_size)))
    for name in ("q", "qd", "x", "xd"):
        np.testing.assert_allclose(terms[name], char.reward[name][0], rtol=1e-6)
    assert len(set(env.frame)) > 4  # random frames


# ------------------------------------------------------------------------------------ §3.7 actions

TABLE_4 = {"shoulder": 0.2, "elbow": 0.1, "head": 0.1, "neck": 0.1}
TABLE_4 = {
    "oppy": TABLE_4,
    "dino": TABLE_4 | {"tail0": 0.5, "tail1": 0.4},
    "jesse": TABLE_4 | {f"spine{k}": 0.25 for k in range(4)},
}


@pytest.mark.parametrize("name", TABLE_4)
def test_3_7_torques_by_table_4(name, rng):
    """τ = clip(a, −1, 1) × base × Table 4 (1 where it is empty), as MuJoCo applies them to the joints."""
    c = character.load(name)
    a, d = rng.normal(0, 1, len(c.driven)), mujoco.MjData(c.model)
    d.ctrl[:] = np.clip(a, -1, 1)
    mujoco.mj_forward(c.model, d)
    base, by_joint = 10 / 3 * c.model.body_mass.sum(), TABLE_4[name]  # N m, ASSUMED: 10/3 N m per kg
    for k, h in enumerate(c.driven):
        τ = min(max(a[k], -1.0), 1.0) * base * by_joint.get(c.hinges[h].split("_")[0], 1.0)
        assert d.qfrc_actuator[6 + h] == pytest.approx(τ, rel=3e-3), c.hinges[h]


def test_3_7_passive_joints(rng):
    """Dino's last six tail joints and Oppy's ears: τ = −k (q − q_default) − d q̇, and no motor."""
    for name, passive in (("dino", [f"tail{k}" for k in range(2, 8)]), ("oppy", ["ear"])):
        c = character.load(name)
        m, d = c.model, mujoco.MjData(c.model)
        d.qpos[7:], d.qvel[6:] = c.default + 0.1 * rng.normal(size=c.j), rng.normal(size=c.j)
        mujoco.mj_forward(m, d)
        some = [h for h, n in enumerate(c.hinges) if n.startswith(tuple(passive))]
        assert some and not set(some) & set(c.driven)
        for h in some:
            τ = -m.jnt_stiffness[1 + h] * (d.qpos[7 + h] - c.default[h]) - m.dof_damping[6 + h] * d.qvel[6 + h]
            assert d.qfrc_passive[6 + h] == pytest.approx(τ) and m.jnt_stiffness[1 + h] > 0
