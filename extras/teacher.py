r"""Teachers that are copied: one that sees the pose, so that arms follow before they are rewarded for it, and experts
of single motions, so that one policy does what several learnt  (ours).

    python -m extras.teacher --character jesse --motion FOLDER --init characters/jesse.npz --steps 1500000 --out runs/t
    python ppo.py --character jesse --motion FOLDER --init runs/t --out runs/a               then PPO goes on from it
    python -m extras.teacher --character jesse --motion FOLDER --init characters/jesse.npz --expert 'back_*=runs/b' …
    python -m extras.teacher --character jesse --motion FOLDER --init characters/jesse.npz --pull 0.02 …    PPO, pulled

Eq. 8's kernel is flat where an arm is far from the user's: with Table 2's k a hanging arm that should be raised earns
e^-10 of its reward, and a little higher earns no more.  So PPO leaves it hanging, and elbows alone bend.  What an arm
should do is no secret, though: the kinematic pose is known in training, and a PD controller on it says which torque
leads there.

    state ──► student's noisy action ──► next state                          the student drives [Ross11]
      ├─────► teacher: PD torque of the arms, the old policy's action elsewhere ──┐
      └─────► student's mean action ──────────────────────────────────────────────┴─► squared error, Adam

An expert is a policy that learnt a few kinds of motion alone, steps backwards for example, and forgot the others
meanwhile.  In sequences that are its own the student copies it, arms too, and in all others the old policy.  An average
of their weights does not step backwards (LOG.md, 2026-11-29).  A student that has not yet taken a step back sees only
how one falls, and is told there what an expert would do that never gets there: so the expert itself drives `drive` of
the characters in its sequences, the mixture of [Ross11].

Arms that suddenly do as they are taught throw over legs that never knew such arms.  With `--pull` the student does not
copy: PPO goes on, and its loss has the teacher's arms beside it ([Schmitt18]), so that the legs learn meanwhile:

    loss = −L(θ) + β mean over samples of Σ over taught motors (μ_i(o) − a*_i)² / (2 σ_i²)

The student sees sensors alone, as ever.  Its normaliser stays as it was, but for `--pull`; its critic learns what the
new actions are worth.

[Ross11]  Ross, Gordon and Bagnell, A reduction of imitation learning and structured prediction to no-regret online
          learning, AISTATS 2011
[Schmitt18]  Schmitt et al., Kickstarting deep reinforcement learning, arXiv 1803.03835, 2018
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from fnmatch import fnmatchcase
from statistics import fmean

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import mujoco
import numpy as np

import ppo
from character import Character, driven_groups
from env import Env
from extras import train
from extras.policies import pairs_of
from nn import clip_grad_norm
from plumbing.cli import NONNEGATIVE, POSITIVE, UNIT, UserError, arg, run_main
from plumbing.training import given_names, progress_line, read_options
from policy import check_fits, load_policy, widths

RATE, DAMPING = 6.0, 0.7  # rad/s and of critical damping, ASSUMED: of the teacher's arms, spring included
FARTHEST, FASTEST = 0.5, 6.0  # rad, rad/s, ASSUMED: an arm farther off is pulled no harder, none is asked for more


@dataclass
class Options(train.Options):
    """extras/train.py's options, and which joints are taught."""

    BY = "extras.teacher"

    joints: tuple[str, ...] = arg(("shoulder", "elbow"), "groups of driven joints that are taught", metavar="NAME,…")
    expert: tuple[str, ...] = arg(
        (), "instead of the arms: whom to copy in which sequences, by shell patterns", metavar="PATTERN=POLICY,…"
    )
    drive: float = arg(0.0, "share of the characters that experts drive, in their sequences", check=UNIT)
    teacher_lr: float = arg(3e-4, "learning rate of the student's copying", check=POSITIVE)
    pull: float = arg(0.0, "instead of copying, PPO: so much the teacher's arms weigh in its loss", check=NONNEGATIVE)


def taught(char: Character, groups) -> np.ndarray:
    """The motors of groups of joints.  UserError: none, or a group that the character has not

    Test      tests/extras/test_teacher.py::test_taught"""
    motors = driven_groups(char)
    if not groups:
        raise UserError(f"--joints: none; valid: {', '.join(motors)}")
    if odd := set(groups) - set(motors):
        raise UserError(f"--joints {','.join(sorted(odd))}: valid: {', '.join(motors)}")
    return np.array(sorted({motor for group in groups for motor in motors[group].tolist()}), int)


def inertia(char: Character) -> np.ndarray:
    """What each driven hinge turns in the default pose: the joint-space inertia's diagonal.  (u,) [kg m²]

    Test      tests/extras/test_teacher.py::test_teacher_holds_an_arm"""
    m, data, full = char.model, mujoco.MjData(char.model), np.zeros((char.model.nv, char.model.nv))
    data.qpos[:] = char.upright
    mujoco.mj_forward(m, data)
    mujoco.mj_fullM(m, data, full)
    return np.diag(full)[6 + char.driven].copy()


class Teacher:
    r"""Torques that bring driven joints to the kinematic pose, as actions.

    Equation  τ = c + k (q* − q_spring) + d q̇* + (I ω² − k) clip(q* − q) + (2 ζ I ω − d) (q̇* − q̇)
              a = clip(τ / τ_max, −1, 1)
    Symbols   q*, q̇* of the next frame; c gravity and Coriolis torques; k of the joint's spring, d its damping; I
              `inertia`; ω RATE; ζ DAMPING; neither bracket below 0; q* − q within FARTHEST, q̇* within FASTEST
    Why       spring and damper do their part by themselves, so that together the joint answers as I (ω², 2ζω); much
              stiffer, an arm that is bent, and so lighter, would shake at 30 torques a second
    Test      tests/extras/test_teacher.py::test_teacher_holds_an_arm
    """

    def __init__(self, env: Env):
        char, m, dof = env.char, env.char.model, 6 + env.char.driven
        self.env, self.bias, self.dof = env, env.batch.bind("qfrc_bias"), dof
        i = inertia(char)
        self.spring, self.rest = m.jnt_stiffness[dof - 5], m.qpos_spring[dof + 1]
        self.stiffness = np.maximum(i * RATE**2 - self.spring, 0.0)
        self.damper = m.dof_damping[dof]
        self.damping = np.maximum(2.0 * DAMPING * i * RATE - self.damper, 0.0)
        self.limits = char.limits

    def __call__(self):
        """(N, u) of the present states."""
        env, ref = self.env, self.env.ref
        f = np.minimum(env.frame + 1, ref.last[env.sequence])
        wanted, speed = ref.qpos[f][:, 1 + self.dof], np.clip(ref.qvel[f][:, self.dof], -FASTEST, FASTEST)
        error = np.clip(wanted - env.qpos[:, 1 + self.dof], -FARTHEST, FARTHEST)
        torque = self.bias[:, self.dof] + self.spring * (wanted - self.rest) + self.damper * speed
        torque += self.stiffness * error + self.damping * (speed - env.qvel[:, self.dof])
        return np.clip(torque / self.limits, -1.0, 1.0)


def experts(asked, env: Env) -> tuple[list, np.ndarray]:
    """The policies of --expert, and whose each sequence is: the first whose pattern fits its name, or -1.

    Raises    UserError: not PATTERN=POLICY, no sequence of that name, or a policy of another body
    Test      tests/extras/test_teacher.py::test_experts"""
    policies, whose = [], np.full(len(env.ref.names), -1)
    for k, (pattern, path) in enumerate(pairs_of(asked)):
        fits = np.array([fnmatchcase(name, pattern) for name in env.ref.names])
        if not (path and fits.any()):
            names = ", ".join(env.ref.names[:6])
            raise UserError(f"--expert {asked[k]}: valid: PATTERN=POLICY, the pattern of sequences such as {names}")
        policy, _ = load_policy(path)
        check_fits(policy, env, path)
        policies.append(policy)
        whose[fits & (whose < 0)] = k
    return policies, whose


class Student(ppo.Trainer):
    """Collects as PPO does, and copies: the teacher's arms or the experts, and what it was itself elsewhere.

    wanted, by_teacher : (horizon, N, u) the actions to copy, and which of them are a teacher's or an expert's
    Test     tests/extras/test_teacher.py::test_student_copies, test_student_of_an_expert, test_resume_is_exact"""

    def __init__(self, opt: Options, env: Env, policy=None):
        super().__init__(opt, env, policy)
        self.old, _ = load_policy(opt.init)
        self.experts, self.whose = experts(opt.expert, env)
        self.arms = np.array([], int) if opt.expert else taught(env.char, opt.joints)
        self.teacher = None if opt.expert else Teacher(env)
        self.driven = np.arange(env.n) < opt.drive * env.n
        self.wanted, self.by_teacher = np.zeros_like(self.mu), np.zeros(self.mu.shape, bool)
        self.adam_pi.lr = opt.teacher_lr

    def step(self, t):
        """As PPO's, and what the student should have done."""
        seen, wanted, by_teacher = self.env.full[:, : self.env.obs_size], self.wanted[t], self.by_teacher[t]
        wanted[:], by_teacher[:] = self.old.mean_action(seen), False
        if len(self.arms):
            wanted[:, self.arms], by_teacher[:, self.arms] = self.teacher()[:, self.arms], True
        for k, expert in enumerate(self.experts):
            rows = self.whose[self.env.sequence] == k
            wanted[rows], by_teacher[rows] = expert.mean_action(seen[rows]), True
        super().step(t)

    def driving(self, t):
        """The student's mean actions, and the experts' where they drive.  (N, u)

        Test      tests/extras/test_teacher.py::test_an_expert_drives"""
        rows = self.driven & (self.whose[self.env.sequence] >= 0)
        return np.where(rows[:, None], self.wanted[t], self.mu[t])

    def update(self) -> dict:
        r"""Epochs of minibatches of the two losses.

        Equation  mean over samples and motors of (μ(o) − a*)²; the critic's is PPO's
        """
        opt, batch, epochs = self.opt, self.samples(), []
        wanted = self.wanted.reshape(batch.mu.shape)
        for _ in range(opt.epochs):
            parts = self.minibatches(len(batch.adv))
            losses = [self.copy(batch.x[rows], wanted[rows]) for rows in parts]
            epochs.append({"policy_loss": fmean(losses), "value_loss": self.fit_critic(batch, parts)})
        found = {k: fmean(e[k] for e in epochs) for k in epochs[0]}
        error, by_teacher = np.square(batch.mu - wanted), self.by_teacher.reshape(wanted.shape)
        found["taught_rms"], found["kept_rms"] = (
            float(np.sqrt(error[part].mean())) if part.any() else 0.0 for part in (by_teacher, ~by_teacher)
        )
        return self.told(found | {"kl": 0.0, "clip_fraction": 0.0}, batch.explained)

    def copy(self, x, wanted) -> float:
        """One step of the actor's weights; the noise stays.  -> the loss

        Test      tests/extras/test_teacher.py::test_copy"""
        policy = self.policy
        mu, cache = policy.actor.forward(x[:, : policy.obs_size])
        error = mu - wanted
        _, gradient = policy.actor.backward(2.0 * error / error.size, cache, want_dx=False)
        gradient = np.concatenate([gradient, np.zeros_like(policy.log_std)])
        clip_grad_norm(gradient, ppo.MAX_GRAD_NORM)
        self.adam_pi.step(policy.theta_pi, gradient)
        return float(np.mean(np.square(error)))

    @staticmethod
    def line(stats) -> dict:
        """The progress line: how far the student is from its teacher, as shares of the torque limits."""
        plain = {k: v for k, v in progress_line(stats).items() if k not in ("kl", "clip")}
        return plain | {"taught": f"{stats['taught_rms']:.3f}", "kept": f"{stats['kept_rms']:.3f}"}


def pulled(mu, wanted, motors, log_std, weight):
    r"""The teacher's pull on the means of some motors: a loss and its gradient with respect to all means.

    Equation  β mean over samples of Σ_i (μ_i − a*_i)² / (2 σ_i²), i over motors: −β log π(a*) of those, less what does
              not depend on μ.  σ is not moved by it
    Args      mu, wanted (B, u); motors : indices; log_std (u,); weight : β
    Returns   loss : float; dmu (B, u)
    Test      tests/extras/test_teacher.py::test_pulled"""
    error, dmu = mu[:, motors] - wanted[:, motors], np.zeros_like(mu)
    dmu[:, motors] = weight / len(mu) * error * np.exp(-2.0 * log_std[motors])
    return 0.5 * float(np.sum(dmu[:, motors] * error)), dmu


class Pulled(ppo.Trainer):
    """PPO as ever, with the teacher's pull on the arms.

    wanted    : (horizon, N, u) the teacher's actions
    Test      tests/extras/test_teacher.py::test_pulled_student"""

    def __init__(self, opt: Options, env: Env, policy=None):
        super().__init__(opt, env, policy)
        self.arms, self.teacher, self.wanted = taught(env.char, opt.joints), Teacher(env), np.zeros_like(self.mu)

    def step(self, t):
        """As PPO's, and what the arms should have done."""
        self.wanted[t] = self.teacher()
        super().step(t)

    def samples(self):
        """PPO's, with the teacher's actions."""
        batch = super().samples()
        batch.wanted = self.wanted.reshape(batch.mu.shape)
        return batch

    def also(self, batch, rows):
        """The pull on a minibatch's means."""
        opt, policy = self.opt, self.policy
        return lambda mu: pulled(mu, batch.wanted[rows], self.arms, policy.log_std, opt.pull)

    def update(self) -> dict:
        """PPO's update; how far the arms were from the teacher's before it."""
        error = (self.mu - self.wanted)[..., self.arms]
        return super().update() | {"taught_rms": float(np.sqrt(np.square(error).mean()))}

    @staticmethod
    def line(stats) -> dict:
        """PPO's progress line, and how far the arms are from their teacher, as a share of the torque limits."""
        return progress_line(stats) | {"taught": f"{stats['taught_rms']:.3f}"}


def main(argv=None):
    """python -m extras.teacher: by the character's recipe.  Test: tests/extras/test_teacher.py::test_command"""
    opt = read_options(Options, argv, "extras.teacher", __doc__, widths)
    if not (opt.init or opt.resume):
        raise UserError("--init: a teacher needs a student that walks; valid: a policy's .npz or a run folder")
    if opt.gpu:
        raise UserError("--gpu: a student copies on the processor alone: leave it out")
    if opt.expert and "joints" in given_names(argv):
        raise UserError("--joints: beside --expert no joints are taught: leave out one of the two")
    if opt.drive and not opt.expert:
        raise UserError("--drive: an expert drives: valid with --expert")
    if opt.pull and opt.expert:
        raise UserError("--pull: pulls arms to the teacher's: leave out --expert, or --pull")
    if opt.pull and "teacher_lr" in given_names(argv):
        raise UserError("--teacher-lr: is of copying: beside --pull the learning rate is --lr")
    if not opt.expert:  # what is wrong is said before motions are read, which takes minutes
        taught(opt.load(), opt.joints)
    for _, path in pairs_of(opt.expert):
        if path:
            load_policy(path)
    ppo.train(opt, train.make_env(opt), trainer=Pulled if opt.pull else Student)


if __name__ == "__main__":
    run_main(main)
