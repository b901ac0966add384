"""extras/teacher.py: torques that lead to the kinematic pose, and a student that copies them."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.stats import norm
from test_ppo import TINY, assert_same_run, policy_batch

import ppo
from env import Env
from extras import teacher, train
from plumbing.cli import UserError, run_main
from plumbing.runs import CHECKPOINT, load_checkpoint
from policy import load_policy


def run(out, updates, *more):
    """Run (or resume) the command line in this process, to `updates` updates in all."""
    args = list(more) if "--resume" in more else [*TINY, *more]
    teacher.main([*args, "--out", str(out), "--steps", str(64 * updates)])
    return load_checkpoint(Path(out) / CHECKPOINT)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A run to begin from."""
    out = tmp_path_factory.mktemp("start") / "a"
    train.main([*TINY, "--out", str(out), "--steps", "64"])
    return out


def test_taught(char):
    """Groups of joints by name; another name is refused with the valid ones."""
    names = [char.hinges[char.driven[j]] for j in teacher.taught(char, ("shoulder", "elbow"))]
    assert len(names) == 8 and all(n.startswith(("shoulder", "elbow")) for n in names)
    with pytest.raises(UserError, match="--joints tail: valid: .*knee"):
        teacher.taught(char, ("shoulder", "tail"))


def test_teacher_holds_an_arm(char, ref):
    """At rest in a raised pose its torque is what MuJoCo's inverse dynamics asks for to stay there.  Beside the pose,
    or moving, the arm accelerates with ω² and 2ζω, and no harder beyond FARTHEST and FASTEST; the
    inertia is mj_inverse's, too."""
    arms = teacher.taught(char, ("shoulder",))
    q, v = 7 + char.driven[arms], 6 + char.driven[arms]
    raised = 0.3 * np.sign(char.model.jnt_range[v - 5].sum(axis=1))
    wanted = np.tile(ref.qpos[:1], (len(ref), 1))
    wanted[:, q] = raised
    env = Env(char, replace(ref, qpos=wanted, qvel=0 * ref.qvel), 3, threads=1, autoreset=False)
    env.reset(frames=np.repeat(ref.first[0], 3))
    act = teacher.Teacher(env)
    env.qpos[1, q] -= 0.1
    env.qpos[2, q] -= 0.6
    env.refresh()
    m, data, at = char.model, mujoco.MjData(char.model), teacher.inertia(char)[arms]
    data.qpos[:], data.qpos[2] = env.qpos[0], 5.0  # in the air: no contact
    mujoco.mj_inverse(m, data)
    torque = act()[:, arms] * char.limits[arms]
    np.testing.assert_allclose(torque[0], data.qfrc_inverse[v], rtol=1e-6, atol=1e-6)
    pulled = at * teacher.RATE**2
    strong = pulled > m.jnt_stiffness[v - 5]  # elsewhere the spring alone is quicker
    assert strong.sum() == 4  # about the long axis of the arm it is
    for k, error in ((1, 0.1), (2, teacher.FARTHEST)):
        gain = torque[k] - act.bias[k, v] - act.spring[arms] * (raised - act.rest[arms])
        np.testing.assert_allclose(gain, error * np.maximum(pulled - act.spring[arms], 0.0), rtol=1e-6, atol=1e-6)
    env.qpos[1], env.qvel[1, v] = env.qpos[0], 0.01  # too slow for Coriolis forces
    env.refresh()
    slowed = (act()[1, arms] * char.limits[arms] - torque[0]) / -0.01
    critical = 2 * teacher.DAMPING * at * teacher.RATE - m.dof_damping[v]
    np.testing.assert_allclose(slowed, np.maximum(critical, 0.0), atol=2e-3)

    for asked, given in ((0.5, 0.5), (99.0, teacher.FASTEST)):  # a pose that moves: dampers are helped, and it is met
        env.ref.qvel[:, v] = asked
        ahead = act()[0, arms] * char.limits[arms] - torque[0]
        np.testing.assert_allclose(ahead, given * (m.dof_damping[v] + np.maximum(critical, 0.0)), atol=1e-6)

    data.qpos[:2], data.qpos[3:7], data.qpos[7:] = 0.0, char.rest[char.root], char.default
    mujoco.mj_inverse(m, data)
    still = data.qfrc_inverse[v].copy()
    for j, dof in enumerate(v):  # the torque that gives this hinge alone 1 rad/s²
        data.qacc[:] = 0.0
        data.qacc[dof] = 1.0
        mujoco.mj_inverse(m, data)
        np.testing.assert_allclose(data.qfrc_inverse[dof] - still[j], at[j], rtol=1e-6)


def test_copy(start):
    """The step is along the squared error's gradient: against central differences in float64; the noise stays."""
    small = dict(clips="*stand*", envs=4, horizon=4, threads=1, hidden=(8,), value_hidden=(8,))
    opt = teacher.Options(init=str(start), **small)
    student = teacher.Student(opt, ppo.make_env(opt))
    policy, rng, seen = student.policy, np.random.default_rng(0), []
    x, wanted = rng.standard_normal((6, policy.obs_size)), rng.standard_normal((6, policy.action_size))
    student.adam_pi.step = lambda theta, gradient: seen.append(gradient.copy())
    before, n, actor = policy.theta_pi.copy(), policy.actor.n_params, policy.actor
    loss = student.copy(x.astype(np.float32), wanted.astype(np.float32))
    assert not seen[0][n:].any() and np.array_equal(policy.theta_pi, before)
    error = lambda theta: (setattr(actor, "theta", theta), np.mean((actor.forward(x)[0] - wanted) ** 2))[1]  # noqa: E731
    exact = before[:n].astype(float)
    np.testing.assert_allclose(loss, error(exact), rtol=1e-5)
    found = []
    for k in (some := rng.choice(n, 40, replace=False)):
        step = np.eye(1, n, k)[0] * 1e-6
        found.append((error(exact + step) - error(exact - step)) / 2e-6)
    given = seen[0][some]
    cosine = given @ found / np.linalg.norm(given) / np.linalg.norm(found)  # clipping keeps the direction
    assert cosine > 1 - 1e-6


def test_student_copies(start, tmp_path):
    """Arms come nearer to the teacher, the rest stays near what it was; PPO goes on from it."""
    run(tmp_path / "a", 50, "--init", str(start), "--epochs", "4", "--teacher-lr", "0.003")
    rows = [row.split(",") for row in (tmp_path / "a" / "metrics.csv").read_text().splitlines()]
    taught, kept = (np.array([float(r[rows[0].index(name)]) for r in rows[1:]]) for name in ("taught_rms", "kept_rms"))
    assert taught[-10:].mean() < 0.85 * taught[:3].mean() and kept[-10:].mean() < 0.1
    old, new = load_policy(start)[0], load_policy(tmp_path / "a")[0]
    assert np.array_equal(old.norm.mean, new.norm.mean) and np.array_equal(old.log_std, new.log_std)
    train.main([*TINY, "--init", str(tmp_path / "a"), "--out", str(tmp_path / "b"), "--steps", "64"])


def test_pulled():
    """The loss is −β log π(a*) of the taught motors but for a constant, by SciPy; with it the gradient of PPO's loss is
    its difference quotient, and σ feels PPO alone."""
    policy, x, action, logp_old, adv, _ = policy_batch()
    rng, motors, x = np.random.default_rng(4), np.array([0, 2]), x[:, :5]
    wanted = rng.standard_normal(action.shape)
    also = lambda mu: teacher.pulled(mu, wanted, motors, policy.log_std, 0.3)  # noqa: E731

    def slow(mu):
        return -0.3 * norm.logpdf(wanted[:, motors], mu[:, motors], np.exp(policy.log_std)[motors]).sum(1).mean()

    one, two = policy.actor(x), policy.actor(x) + rng.standard_normal(action.shape)
    assert also(one)[0] - also(two)[0] == pytest.approx(slow(one) - slow(two))
    assert not also(one)[1][:, 1].any()
    whole = lambda: ppo.policy_loss(policy, x, action, logp_old, adv, 0.2, also)  # noqa: E731
    given, theta, plain = whole()[1], policy.theta_pi, ppo.policy_loss(policy, x, action, logp_old, adv, 0.2)
    for k in rng.choice(policy.actor.n_params, 30, replace=False):
        was, found = theta[k], []
        for h in (1e-6, -1e-6):
            theta[k] = was + h
            found.append(whole()[0])
        theta[k] = was
        assert given[k] == pytest.approx((found[0] - found[1]) / 2e-6, rel=1e-5, abs=1e-8)
    np.testing.assert_array_equal(given[-3:], plain[1][-3:])
    assert whole()[0] == pytest.approx(plain[0] + also(one)[0])


def test_pulled_student(start, tmp_path):
    """Arms come nearer to the teacher while PPO goes on; without a pull they do not.  Two and two updates are four."""
    found = []
    for name, pull in (("a", "3"), ("b", "1e-9")):
        flags = f"--init {start} --lr 0.001 --epochs 4 --target-kl 0.2 --pull {pull}"
        run(tmp_path / name, 40, *flags.split())
        rows = [row.split(",") for row in (tmp_path / name / "metrics.csv").read_text().splitlines()]
        taught = np.array([float(r[rows[0].index("taught_rms")]) for r in rows[1:]])
        found.append(taught[-10:].mean() / taught[:3].mean())
    assert found[0] < 0.9 and found[1] > 1.0
    run(tmp_path / "whole", 4, "--init", str(start), "--pull", "1")
    run(tmp_path / "c", 2, "--init", str(start), "--pull", "1")
    run(tmp_path / "c", 4, "--resume")
    assert_same_run(tmp_path / "whole", tmp_path / "c")


def test_experts(start, tmp_path):
    """Each sequence is the first expert's whose pattern fits its name, or nobody's; what fits nothing is refused."""
    opt = teacher.Options(init=str(start), clips="*", envs=4, horizon=4, threads=1)
    env = ppo.make_env(opt)
    names = [n for n in env.ref.names]
    first = names[0]
    policies, whose = teacher.experts((f"{first}={start}", f"*={start}"), env)
    assert len(policies) == 2 and whose.tolist() == [0 if n == first else 1 for n in names] and len(set(names)) > 1
    assert (teacher.experts((f"{first}={start}",), env)[1] < 0).sum() == len(names) - 1
    assert teacher.experts((), env)[0] == []
    for bad in ("*walk*", "=x", f"nobody*={start}"):
        with pytest.raises(UserError, match="valid: PATTERN=POLICY"):
            teacher.experts((bad,), env)
    with pytest.raises(UserError, match="Oppy|oppy|observations"):
        teacher.experts((f"*={Path(ppo.__file__).parent / 'characters' / 'oppy.npz'}",), env)


def test_student_of_an_expert(start, tmp_path):
    """It is told the expert's action in the expert's sequences and its own old one elsewhere, one character at a time;
    and comes nearer to the expert's."""
    train.main([*TINY, "--out", str(tmp_path / "expert"), "--steps", "64", "--seed", "5"])
    opt = teacher.Options(init=str(start), clips="*", envs=16, horizon=4, threads=1, expert=("x",))
    name = ppo.make_env(opt).ref.names[0]
    opt = replace(opt, expert=(f"{name}={tmp_path / 'expert'}",))
    student = teacher.Student(opt, ppo.make_env(opt), load_policy(start)[0])
    student.env.reset(seed=1)
    old, expert = (load_policy(path)[0] for path in (start, tmp_path / "expert"))
    seen, own = student.env.full[:, : student.env.obs_size].copy(), student.env.sequence == 0
    student.collect()
    assert 0 < own.sum() < 16
    for i in range(16):
        told = (expert if own[i] else old).mean_action(seen[i : i + 1])[0]
        np.testing.assert_allclose(student.wanted[0, i], told, atol=1e-6)
        assert student.by_teacher[0, i].all() if own[i] else not student.by_teacher[0, i].any()
    more = "--epochs", "4", "--teacher-lr", "0.003", "--expert", f"{name}={tmp_path / 'expert'}"
    run(tmp_path / "a", 30, "--init", str(start), "--clips", "*", *more)
    rows = [row.split(",") for row in (tmp_path / "a" / "metrics.csv").read_text().splitlines()]
    taught = np.array([float(r[rows[0].index("taught_rms")]) for r in rows[1:]])
    assert taught[-10:].mean() < 0.8 * taught[:3].mean()


def test_an_expert_drives(start, tmp_path):
    """A share of the characters does what the expert would, in the expert's sequences; all others what the student
    would; and the noise is the student's."""
    train.main([*TINY, "--out", str(tmp_path / "expert"), "--steps", "64", "--seed", "5"])
    opt = teacher.Options(init=str(start), clips="*", envs=16, horizon=4, threads=1, drive=0.5, expert=("x",))
    env = ppo.make_env(opt)
    env.reset(seed=3)
    opt = replace(opt, expert=(f"{env.ref.names[env.sequence[0]]}={tmp_path / 'expert'}",))
    student = teacher.Student(opt, env, load_policy(start)[0])
    student.policy.log_std[:] = -20.0
    own = (env.sequence == env.sequence[0]) & (np.arange(16) < 8)
    student.collect()
    assert 0 < own.sum() < 8
    for i in range(16):
        told = student.wanted if own[i] else student.mu
        np.testing.assert_allclose(student.action[0, i], told[0, i], atol=1e-6)
    assert np.abs(student.wanted - student.mu)[0, own].max() > 1e-3


def test_resume_is_exact(start, tmp_path):
    """Two updates, then two more, are four."""
    run(tmp_path / "whole", 4, "--init", str(start))
    run(tmp_path / "a", 2, "--init", str(start))
    run(tmp_path / "a", 4, "--resume")
    assert_same_run(tmp_path / "whole", tmp_path / "a")


def test_command(start, tmp_path, capsys):
    """Without a student it says what it needs, in one line; so it does of flags that would do nothing."""
    with pytest.raises(SystemExit):
        run_main(teacher.main, [*TINY, "--out", str(tmp_path / "a")])
    assert "--init: a teacher needs a student" in capsys.readouterr().err
    for flags, says in (
        (["--gpu"], "--gpu: a student copies on the processor"),
        (["--expert", "*=x.npz", "--joints", "tail"], "--joints: beside --expert no joints are taught"),
        (["--drive", "0.5"], "--drive: an expert drives: valid with --expert"),
        (["--pull", "0.1", "--teacher-lr", "0.1"], "--teacher-lr: is of copying: beside --pull"),
        (["--pull", "0.1", "--expert", "*=x.npz"], "--pull: pulls arms to the teacher's: leave out --expert"),
        (["--joints", ""], "--joints: none; valid: ankle"),
        (["--expert", f"*={tmp_path / 'gone.npz'}"], "gone.npz"),
    ):
        with pytest.raises(SystemExit):
            run_main(teacher.main, [*TINY, "--init", str(start), *flags, "--out", str(tmp_path / "a")])
        said = capsys.readouterr()
        assert says in said.err and "reading" not in said.out  # motions
