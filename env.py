r"""The environment: N characters, each driven by a headset and two controllers  [Reda23 §3.3, §3.5, §3.6].

    action ──► torque ──► MuJoCo (its own thread pool, 4 × 1/120 s) ──► refresh ──► reward, termination ──► observation

    observe      Eqs. 2 to 4      what the actor sees: character and sensors, in the heading frame
                 §3.3             and what only the critic sees: the human's full pose, now and in the future
    kernel       Eq. 8            a term of the reward, of the distances of Eqs. 9 to 11; Table 2: characters/NAME.toml
    ablated      §3.5.1, §4.3     the same with less reward; `headset_only` (§4.2) and `asymmetric` (§5.3): less to see
    Uniform      §3.6             where episodes start; another object with its methods and `owner` may stand in
    Env          §3.6, §3.7       reset and step as Gymnasium's vector environments have them

After a physics step MuJoCo's positions, velocities and contacts still belong to the state before the last substep;
`Env.refresh` recomputes positions and velocities at the new state.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from character import TERMS, Character, geom_lowest
from human import heading, quat_angle
from plumbing.cli import UserError
from plumbing.runs import rng_from_state, rng_state
from retarget import STAGE_VEL, Reference, body_velocity, standing

ROOT_LIMIT = 0.30  # m  [Reda23 §3.6]; ASSUMED in 3-D
FORCE_LIMIT = 1.0  # N  [Reda23 App. A]
EPISODE_STEPS = 500  # [Reda23 §3.6]
SUBSTEPS = 4  # ASSUMED: 1/120 s physics at 30 Hz control (a prototype did not learn at 1/60 s)
FUTURES = (1, 5, 15)  # ASSUMED: future frames shown to the critic, in control steps
NO_FORCES = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_SENSOR)
BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
DEVICE_SIZE = 3 + 6  # position, first two columns of the rotation
SENSORS = ("full", "hmd")  # what drives the character: headset and two controllers, or the headset alone [§4.2]
WITHOUT = {  # what can be left out [§4.3, §5.3]: terms of the reward, or what only the critic sees
    "contact": ("contact",),
    "orientation": ("orientation",),
    "action": ("action_diff", "action_min"),
    "imitation": ("q", "qd", "x", "xd"),
    "asymmetric": (),
}
TRACK = ("all", "root")  # what of the kinematic pose is imitated [§3.5.1]

# ------------------------------------------------------------------------------------ observation


class HeadingFrame:
    r"""The frame of every observation: on the floor below the root, turned with the root's heading  [Reda23 §3.3].

    Equation  p' = R_z(−ψ) (p − (x_root, y_root, 0)),  R' = R_z(−ψ) R
    Symbols   ψ = `human.heading`, of the body's left axis: does not flip when it bends over
    Args      root_pos (N, 3) [m], root_quat (N, 4) w, x, y, z, world
    Test      tests/test_env.py::test_heading_invariance, test_observation_terms
    """

    def __init__(self, root_pos, root_quat):
        yaw = heading(root_quat)
        self.c, self.s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]  # (N, 1)
        self.origin = root_pos.copy()
        self.origin[:, 2] = 0.0

    def turn(self, v, out):
        """Rotate vectors (N, P, 3), or the columns of matrices (N, P, 3, 2), into the frame."""
        if v.ndim == 4:  # one column at a time: NumPy is three times as slow with two in its innermost loop
            for k in range(2):
                self.turn(v[..., k], out[..., k])
            return out
        x, y = v[..., 0], v[..., 1]
        out[..., 0] = self.c * x + self.s * y
        out[..., 1] = self.c * y - self.s * x
        out[..., 2] = v[..., 2]
        return out

    def place(self, p, out):
        """Move and rotate points (N, P, 3) into the frame."""
        return self.turn(p - self.origin[:, None], out)


def observe_user(frame: HeadingFrame, pos, rot, out):
    r"""Sensor part of the observation  [Reda23 Eq. 4]: o_user = [h, l, r, R_h, R_l, R_r]; [h, R_h] of a headset alone.

    Args      pos (N, d, 3) [m], rot (N, d, 3, 2) first two columns of the rotations, world, mapped by the sensor scale,
              of d = 3 devices or 1; out (N, 9 d)
    Test      tests/test_env.py::test_observation_terms, test_headset_only
    """
    n, d = pos.shape[:2]
    frame.place(pos, out[:, : 3 * d].reshape(n, d, 3))
    frame.turn(rot, out[:, 3 * d :].reshape(n, d, 3, 2))
    return out


def observe_sim(frame: HeadingFrame, qpos, qvel, spin, link_pos, link_rot, out):
    r"""Character part of the observation  [Reda23 Eq. 3]: o_sim = [q, q̇, x, R].

    ASSUMED   q̇ of the root (its linear and angular velocity, turned into the frame) leads q̇; q of the root is in
              x and R
    Args      qpos (N, 7+j), qvel (N, 6+j); spin (N, 3) [rad/s] root angular velocity, world;
              link_pos (N, l, 3) [m], link_rot (N, l, 3, 2) first two columns of the rotations, world
              out (N, j + 6 + j + 9 l)
    Test      tests/test_env.py::test_observation_terms
    """
    n, j, links = len(qpos), qpos.shape[1] - 7, link_pos.shape[1]
    out[:, :j] = qpos[:, 7:]
    frame.turn(qvel[:, None, :3], out[:, j : j + 3].reshape(n, 1, 3))
    frame.turn(spin[:, None], out[:, j + 3 : j + 6].reshape(n, 1, 3))
    out[:, j + 6 : 2 * j + 6] = qvel[:, 6:]
    rest = out[:, 2 * j + 6 :]
    frame.place(link_pos, rest[:, : 3 * links].reshape(n, links, 3))
    frame.turn(link_rot, rest[:, 3 * links :].reshape(n, links, 3, 2))
    return out


def observation_terms(char: Character, devices=3, asymmetric=True) -> dict:
    """{"actor": {name: size}, "critic": {name: size}}, in the order of the vector: the actor's [Eq. 2] first.

    ASSUMED   o_{t-1,user} is expressed in the frame of time t, so that its difference to o_{t,user} is a velocity.
    Args      devices : 3, or 1 for a headset alone [§4.2]; asymmetric : the critic sees more than the actor [§5.3]
    Test      tests/test_env.py::test_observation_terms, test_headset_only, test_symmetric_critic"""
    j, links, user = char.j, len(char.obs_links), DEVICE_SIZE * devices
    actor = dict(q=j, qd=6 + j, x=3 * links, R=6 * links, user_previous=user, user=user)
    critic = dict(human_pos=45, human_rot=90) | {f"human_pos_in_{k}": 45 for k in FUTURES}
    return {"actor": actor, "critic": critic if asymmetric else {}}


def slices_of(terms: dict) -> dict:
    """Where each term is in the vector: name -> slice.  Test: tests/test_env.py::test_observation_terms"""
    slices, start = {}, 0
    for name, size in (terms["actor"] | terms["critic"]).items():
        slices[name] = slice(start, start + size)
        start += size
    return slices


def headset_only(ref: Reference) -> Reference:
    """The reference without controllers; an `Env` of it observes the headset alone  [Reda23 §4.2].

    Test      tests/test_env.py::test_headset_only"""
    names = ("sensor_pos", "sensor_rot", "sensor_quat")
    return replace(ref, **{name: np.ascontiguousarray(getattr(ref, name)[:, :1]) for name in names})


def observe(sim, ids, before, now, out) -> HeadingFrame:
    r"""The actor's observation [Reda23 Eq. 2]: o_t = [o_{t,sim}, o_{t-1,user}, o_{t,user}].

    Args      sim : has char, slices, and the bound arrays qpos, qvel, cvel, xpos, xmat: an Env, or
              `headset.player.Player`
              ids : rows of it; before, now : (pos, rot) of the devices as `observe_user` takes them
              out (N, at least the actor's size) is filled
    Returns   the heading frame
    Test      tests/test_env.py::test_observation_terms, tests/headset/test_stream.py::test_player_observes_as_env
    """
    char, s, links = sim.char, sim.slices, sim.char.obs_links
    qpos, qvel = sim.qpos[ids], sim.qvel[ids]
    frame = HeadingFrame(qpos[:, :3], qpos[:, 3:7])
    pos = sim.xpos[ids].take(links, axis=1)
    rot = sim.xmat[ids].take(links, axis=1).reshape(*pos.shape, 3)[..., :2]
    observe_sim(frame, qpos, qvel, sim.cvel[ids, char.root, :3], pos, rot, out[:, s["q"].start : s["R"].stop])
    observe_user(frame, *before, out[:, s["user_previous"]])
    observe_user(frame, *now, out[:, s["user"]])
    return frame


# ------------------------------------------------------------------------------------ reward


def kernel(w, k, d):
    r"""[Reda23 Eq. 8] r(s) = w_s exp(−k_s d(s_sim, s_kin)).  d (N,) -> (N,).

    Test      tests/test_env.py::test_reward_terms"""
    return w * np.exp(-k * d)


def weighted_distance(sim, ref, weights):
    r"""[Reda23 Eq. 11] d = Σ_i w_i ‖x_{i,sim} − x_{i,gt}‖²; i runs over joint angles (N, j) or links (N, l, 3).

    The weights come normalised to sum 1 (ASSUMED, `character.normalised`).  -> (N,)
    Test      tests/test_env.py::test_reward_terms
    """
    d = sim - ref
    return (np.square(d) if d.ndim == 2 else np.einsum("nli,nli->nl", d, d)) @ weights


def orientation_distance(quat_sim, quat_human):
    r"""[Reda23 §3.5.1, App. A] orientation of root and head against the HUMAN's.

    Equation  d = mean over root and head of ‖log(q_gt q_sim^{-1})‖, an angle
    ASSUMED   one kernel over both, their mean
    Args      quat_sim, quat_human : (N, 2, 4), world
    Returns   (N,) [rad]
    Test      tests/test_env.py::test_reward_terms
    """
    return quat_angle(quat_human, quat_sim).mean(-1)


def contact_distance(c_sim, c_human):
    r"""[Reda23 §3.5.2, App. A] do the feet's contacts coincide?

    Equation  d = ‖c_sim − c_human‖ over the two feet's booleans: 0, 1 or √2 (ASSUMED: not squared)
    Args      c_sim : (N, 2) bool, contact force > 1 N; c_human : (N, 2) bool
    Returns   (N,)
    Test      tests/test_env.py::test_reward_terms
    """
    return np.sqrt(np.sum(c_sim != c_human, axis=-1))


def action_diff(a_prev, a):
    r"""[Reda23 Eq. 9] d = (1/N) Σ_i (a_{t−1,i} − a_{t,i})².

    ASSUMED   the actions (N, u) are those that the physics gets: clipped
    Test      tests/test_env.py::test_reward_terms"""
    return np.square(a_prev - a).mean(-1)


def action_min(a):
    r"""[Reda23 Eq. 10] d = (1/N) Σ_i a_{t,i}².  Test: tests/test_env.py::test_reward_terms"""
    return np.square(a).mean(-1)


def total_reward(terms: dict):
    r"""[Reda23 Eqs. 5 to 7] r = r(imitation) + r(contact) + r(action).

    imitation = q + qd + x + xd + orientation;  action = action_diff + action_min
    Test      tests/test_env.py::test_total_reward
    """
    imitation = terms["q"] + terms["qd"] + terms["x"] + terms["xd"] + terms["orientation"]
    action = terms["action_diff"] + terms["action_min"]
    return imitation + terms["contact"] + action


def ablated(char: Character, without=(), track="all") -> Character:
    r"""The character with less reward  [Reda23 §3.5.1, §4.3]: what is left out has weight 0.

    ASSUMED   `imitation` is q, q̇, x and ẋ, what the kinematic pose teaches; orientation, which Eq. 6 counts among
              them, comes from the human (§3.5.1) and is a name of its own, because §4.3.2 takes it away alone.
              `track` "root", the least supervision that §3.5.1 speaks of, keeps x of the root; q, q̇ and ẋ go, and
              orientation stays, which §3.5.1 always rewards
    Args      without : names in WITHOUT; track : one of TRACK
    Returns   a copy; the model is shared
    Raises    UserError: another name, nothing left to track, or no reward left
    Test      tests/test_env.py::test_ablated
    """
    for name in without:
        if name not in WITHOUT:
            raise UserError(f"--without {name}: unknown; valid: {', '.join(WITHOUT)}")
    if track not in TRACK:
        raise UserError(f"--track {track}: unknown; valid: {', '.join(TRACK)}")
    gone = {term for name in without for term in WITHOUT[name]}
    if track == "root":
        if "x" in gone or not char.reward["x"][0]:
            raise UserError("--track root imitates x of the root: it needs x's weight, and no --without imitation")
        gone |= {"q", "qd", "xd"}
        char = replace(char, reward_links=np.array([char.root]), link_weights=np.ones(1))
    less = replace(char, reward=char.reward | {term: (0.0, char.reward[term][1]) for term in gone})
    if not any(less.reward[term][0] for term in TERMS):
        raise UserError(f"--without {','.join(without)}: no reward is left; valid: leave a term that weighs something")
    return less


# ------------------------------------------------------------------------------------ termination


def fallen(fall_height):
    """[Reda23 §3.6] the upper body touches the ground: its lowest point, fall_height (N,) [m], is not above the floor.

    Test      tests/test_env.py::test_fall_is_contact"""
    return fall_height <= 0.0


def too_far(root_pos, root_target, limit=ROOT_LIMIT):
    """[Reda23 §3.6] the root is more than 0.30 m from the scaled mocap root, both (N, 3), in 3-D (ASSUMED).

    Test      tests/test_env.py::test_termination, test_root_limit"""
    return np.linalg.norm(root_pos - root_target, axis=-1) > limit


# ------------------------------------------------------------------------------------ where episodes start


class Uniform:
    """Every frame that has one before it and one after it, each as likely as any other  [Reda23 §3.6].

    A start needs the frame before it, of o_{t-1,user}, and one to go to.
    frames : (f,) all of them; owner : (F,) the sequence of each frame of the reference
    Test     tests/test_env.py::test_reset_frames
    """

    def __init__(self, ref: Reference):
        self.ref = ref
        self.frames = np.concatenate([np.arange(a + 1, b) for a, b in zip(ref.first, ref.last, strict=True)])
        if not len(self.frames):
            raise UserError(f"{', '.join(ref.names[:3])}: too short; a start needs a sequence of three frames or more")
        self.owner = np.repeat(np.arange(len(ref.first)), ref.last - ref.first + 1)

    def draw(self, rng, n):
        """n start frames (n,), and which of them start in the default pose instead of the reference's (n,) bool."""
        return rng.choice(self.frames, n), np.zeros(n, bool)

    def count(self, rng, frames, failed, steps):
        """m episodes have ended: at which frames (m,), whether as failures, after how many steps.  All one to it."""

    def state(self) -> dict:
        """Arrays that a resumed run needs: none."""
        return {}

    def load_state(self, arrays):
        """Continue from what `state` returned."""


# ------------------------------------------------------------------------------------ environment


class Env:
    """N characters following random places of a reference  [Reda23 §3.6].

    As Gymnasium's vector environments with autoreset in the same step: `step` returns the observation of the new
    episode where one ended, and info["final_obs"] the observation it ended with.

    char, ref : `character.load`, `retarget.reference`; control runs at the reference's rate
    n         : number of environments
    threads   : physics threads, 0 = all cores; results do not depend on it
    horizon   : control steps to truncation
    disturbance : what training adds to sensors and bodies (`extras.train.Disturbance`); nothing by default
    starts    : where episodes start, `Uniform` by default; root_limit : of `too_far` [m], or (F,) by frames
    asymmetric : the critic's observation has more than the actor's [§5.3]
    autoreset : start anew where an episode ended; without it the caller resets, and reads the state that ended
    """

    ENDS = ("fall", "far", "bad", "time", "clip")  # why an episode ends: three failures, two truncations
    TERMS = TERMS  # of the reward
    OWN = ("frame", "steps", "available", "action")  # arrays of its own that a resumed run needs

    def __init__(
        self,
        char: Character,
        ref: Reference,
        n: int,
        seed=0,
        threads=0,
        horizon=EPISODE_STEPS,
        substeps=SUBSTEPS,
        autoreset=True,
        disturbance=None,
        asymmetric=True,
        starts=None,
        root_limit=ROOT_LIMIT,
    ):
        self.char, self.ref, self.n, self.horizon, self.substeps = char, ref, n, horizon, substeps
        self.name, self.disturbance, self.root_limit = char.name, disturbance, np.broadcast_to(root_limit, len(ref))
        self.starts = starts or Uniform(ref)
        self.parts = {"starts": self.starts} | ({"disturbance": disturbance} if disturbance else {})
        self.autoreset, self.dt = autoreset, 1.0 / ref.rate
        char.model.opt.timestep = self.dt / substeps
        self.attach(char.batch(n, threads))
        self.devices = ref.sensor_pos.shape[1]  # 1: `headset_only`
        self.asymmetric = asymmetric
        self.terms = observation_terms(char, self.devices, asymmetric)
        self.slices = slices_of(self.terms)
        self.obs_size = sum(self.terms["actor"].values())
        self.critic_size = self.obs_size + sum(self.terms["critic"].values())
        self.action_size = len(char.limits)
        self.full = np.zeros((n, self.critic_size), np.float32)  # actor's observation, then the critic's
        self.frame, self.sequence = np.zeros(n, int), np.zeros(n, int)  # of the reference, at the present state
        self.steps = np.zeros(n, int)
        self.available = np.ones(n, int)  # control steps from the start to the clip's end or the horizon
        self.action = np.zeros((n, self.action_size))
        self.contact = np.zeros((n, 2), bool)
        self.rng = np.random.default_rng(seed)

    def attach(self, batch):
        """Where the simulations are: state and kinematics as arrays that share their memory."""
        self.batch, bind = batch, batch.bind
        self.qpos, self.qvel, self.ctrl = bind("qpos"), bind("qvel"), bind("ctrl")
        self.warmstart = bind("qacc_warmstart")
        self.xpos, self.xmat, self.xquat = bind("xpos"), bind("xmat"), bind("xquat")
        self.cvel, self.com, self.sensordata = bind("cvel"), bind("subtree_com"), bind("sensordata")
        self.geom_xpos, self.geom_xmat = bind("geom_xpos"), bind("geom_xmat")
        self.disabled = self.batch.expand("opt.disableflags")

    def value_scale(self, gamma):
        """The largest return, which makes a critic's output of order 1.  Test: tests/test_env.py::test_value_scale"""
        return sum(self.char.reward[t][0] for t in TERMS) / max(1.0 - gamma, 1e-3)

    def reset(self, seed: int | None = None, frames=None):
        """Start all environments, at random reference frames or at the given ones.

        Args      seed : starts the random numbers anew; frames : (N,) int, none the last of its sequence
        Returns   obs (N, obs_size) float32, info with "critic" (N, critic_size); views, as in `step`
        Raises    ValueError: a frame without a successor, or not one frame an environment
        Test      tests/test_env.py::test_reset_reproduces_reference
        """
        if frames is not None:
            ok = np.isin(frames, np.arange(len(self.ref))) & ~np.isin(frames, self.ref.last)
            if np.shape(frames) != (self.n,) or not ok.all():
                most = len(self.ref) - 1
                raise ValueError(f"frames {frames!r}: expected {self.n} of 0..{most}, none the last of a sequence")
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self._reset(np.arange(self.n), frames)
        self.observe(slice(None))
        return self.full[:, : self.obs_size], {"critic": self.full}

    def _reset(self, ids, frames=None):
        """Reference-state initialisation: a random mocap frame, retargeted, position and velocity."""
        f, upright = self.starts.draw(self.rng, len(ids)) if frames is None else (np.asarray(frames), ())
        self.frame[ids], self.sequence[ids], self.steps[ids] = f, self.starts.owner[f], 0
        self.available[ids] = np.minimum(self.horizon, self.ref.last[self.sequence[ids]] - f)
        self.qpos[ids], self.qvel[ids] = self.ref.qpos[f], self.ref.qvel[f]
        if len(upright) and upright.any():
            self._stand(ids[upright])
        if self.disturbance:
            self.disturbance.begin(self, ids)
        self.action[ids], self.ctrl[ids], self.warmstart[ids] = 0.0, 0.0, 0.0  # ASSUMED: a_{−1} = 0 in Eq. 9
        self.refresh(ids)

    def _stand(self, ids):
        """Environments ids start as a stream does (`headset.player.Player`): in the default pose under the headset, as
        fast as it; where the root would be too far from the human's (a user who crouches, leans), as before.

        Why       a user who puts the headset on, or whose character has fallen, is not in the default pose
        Test      tests/test_env.py::test_standing_starts"""
        ref, f = self.ref, self.frame[ids]
        pose = standing(self.char, ref.sensor_pos[f, 0], ref.sensor_quat[f, 0])
        near = ~too_far(pose[:, :3], ref.qpos[f, :3], self.root_limit[f])
        ids, f = ids[near], f[near]
        self.qpos[ids], self.qvel[ids] = pose[near], 0.0
        self.qvel[ids, :2] = (ref.sensor_pos[f, 0] - ref.sensor_pos[f - 1, 0])[:, :2] / self.dt

    def refresh(self, ids=None):
        """Positions and velocities of all bodies at the present state, of the environments ids or of all.

        Contacts and limits are left out: nothing reads them between steps, and they cost as much as all the rest.
        Test      tests/test_env.py::test_kinematics_are_fresh, test_refresh_changes_nothing"""
        self.disabled |= NO_FORCES
        self.batch.forward(ids, STAGE_VEL)
        self.disabled &= ~NO_FORCES

    def step(self, action):
        """Advance one control step.

        Args      action : (N, u) unclipped, as the policy drew it
        Returns   obs (N, obs_size) float32, reward (N,), terminated (N,), truncated (N,) bool, info:
                  critic       : (N, critic_size) observation and privileged part
                  final_obs, final_critic, _final_obs : the same before the reset, and where they hold
                  length, available : (N,) control steps lived, and that could have been lived
                  terms        : name -> (N,) reward term, 0 where the state was bad; ends : name -> (N,) bool
                  obs and critic are views of `full`, which the next step overwrites: copy what you keep
        Raises    ValueError: an action is not finite, or not one row an environment
        Test      tests/test_env.py::test_step_contract
        """
        if np.shape(action) != self.action.shape:
            raise ValueError(f"action has shape {np.shape(action)}, expected {self.action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action of environment {int(np.argmin(np.isfinite(action).all(1)))} is not finite")
        a = np.clip(action, -1.0, 1.0)  # for the physics and Eqs. 9, 10; PPO's log π has what was drawn
        if self.disturbance:
            self.disturbance.step(self)
        self.ctrl[:] = a
        self.batch.step(nstep=self.substeps)
        contact = self._contact()
        self.refresh()
        self.frame = np.minimum(self.frame + 1, self.ref.last[self.sequence])  # without autoreset the last frame stays
        self.steps += 1
        bad = self._recover()
        f = self.frame
        self.contact = contact & ~bad[:, None]
        terms = self.reward_terms(a)
        if bad.any():
            terms = {name: np.where(bad, 0.0, value) for name, value in terms.items()}
        lowest = geom_lowest(self.char.model, self.char.fall_geoms, self.geom_xpos, self.geom_xmat).min(1)
        ends = {"fall": fallen(lowest) & ~bad, "bad": bad}
        ends["far"] = too_far(self.qpos[:, :3], self.ref.qpos[f, :3], self.root_limit[f]) & ~bad & ~ends["fall"]
        terminated = ends["fall"] | ends["far"] | ends["bad"]
        ends["clip"] = (f >= self.ref.last[self.sequence]) & ~terminated
        ends["time"] = (self.steps >= self.horizon) & ~terminated & ~ends["clip"]
        truncated = ends["clip"] | ends["time"]
        reward = total_reward(terms) + np.where(terminated, self.char.reward["fail"], 0.0)  # ASSUMED: −5 is added
        self.action[:] = a
        self.observe(slice(None))
        done = np.flatnonzero(terminated | truncated) if self.autoreset else ()
        info = {"terms": terms, "ends": ends, "_final_obs": terminated | truncated}
        info |= {"length": self.steps.copy(), "available": self.available.copy()}
        if len(done):
            info["final_critic"] = self.full.copy()
            info["final_obs"] = info["final_critic"][:, : self.obs_size]
            self.starts.count(self.rng, f[done], terminated[done], self.steps[done])
            self._reset(done)
            self.observe(done)
        info["critic"] = self.full
        return self.full[:, : self.obs_size], reward, terminated, truncated, info

    def _recover(self):
        """Environments whose state is not finite, or that MuJoCo had to reset: put back on the reference, ended as
        failures, so that nothing non-finite reaches the networks.  -> (N,) bool

        Test      tests/test_env.py::test_bad_state_ends_alone"""
        bad = ~(np.isfinite(self.qpos).all(1) & np.isfinite(self.qvel).all(1))
        bad |= (self.batch.warning[:, BAD, 1] > 0).any(1)
        if bad.any():
            ids = np.flatnonzero(bad)
            self.batch.warning[ids] = 0
            self.qpos[ids], self.qvel[ids] = self.ref.qpos[self.frame[ids]], self.ref.qvel[self.frame[ids]]
            self.warmstart[ids] = 0.0
            self.refresh(ids)
        return bad

    def _contact(self):
        """Feet whose normal force on the floor exceeds 1 N during the last substep (ASSUMED: which, when).  (N, 2) bool

        To be called right after the physics: `refresh` computes no forces, and leaves in sensordata whatever simulation
        the thread ran before.

        Test      tests/test_env.py::test_contact_forces"""
        return np.abs(self.sensordata[:, self.char.contact_adr]) > FORCE_LIMIT

    def reward_terms(self, a) -> dict:
        """Every term of Eqs. 5 to 7 at the present state, by name; a term of weight 0 is 0.  a (N, u) clipped.

        Test      tests/test_env.py::test_reward_terms, test_zero_weight_adds_nothing"""
        c, ref, f = self.char, self.ref, self.frame
        head = np.array([c.root, c.head])
        d = dict(
            q=weighted_distance(self.qpos[:, 7:], ref.qpos[f, 7:], c.joint_weights),
            qd=weighted_distance(self.qvel[:, 6:], ref.qvel[f, 6:], c.joint_weights),
            x=weighted_distance(self.xpos.take(c.reward_links, axis=1), ref.link_pos[f], c.link_weights),
            xd=weighted_distance(self.link_velocity(), ref.link_vel[f], c.link_weights),
            orientation=orientation_distance(self.xquat.take(head, axis=1), ref.orientation[f]),
            contact=contact_distance(self.contact, ref.contact[f]),
            action_diff=action_diff(self.action, a),
            action_min=action_min(a),
        )
        return {term: kernel(*c.reward[term], d[term]) for term in TERMS}

    def link_velocity(self):
        """Of the reward links' origins, (N, l, 3) [m/s], world.  Test: tests/test_env.py::test_kinematics_are_fresh"""
        links = self.char.reward_links
        return body_velocity(self.cvel.take(links, axis=1), self.xpos.take(links, axis=1), self.com[:, self.char.root])

    def observe(self, ids):
        """Fill the rows `ids` of self.full (a slice or indices).  Test: tests/test_env.py::test_observation_terms"""
        ref, f = self.ref, self.frame[ids]
        s, every = self.slices, isinstance(ids, slice)
        out = self.full if every else np.empty((len(f), self.critic_size), np.float32)
        before = np.maximum(f - 1, ref.first[self.sequence[ids]])  # a sequence's first frame has none before it
        user = [(ref.sensor_pos[k], ref.sensor_rot[k]) for k in (before, f)]
        frame = observe(self, ids, *user, out)
        if self.disturbance:
            for name, error in zip(("user_previous", "user"), self.disturbance.errors(ids)):
                out[:, s[name]][:, : 3 * self.devices] += error
        if self.asymmetric:
            self._observe_human(frame, ids, out)
        if not every:
            self.full[ids] = out

    def _observe_human(self, frame, ids, out):
        """What only the critic sees  [Reda23 §3.3]: the human's pose, and its joints in the future.

        Test      tests/test_env.py::test_observation_terms"""
        ref, f, s = self.ref, self.frame[ids], self.slices
        n = len(f)
        frame.place(ref.human_pos[f], out[:, s["human_pos"]].reshape(n, 15, 3))
        frame.turn(ref.human_rot[f], out[:, s["human_rot"]].reshape(n, 15, 3, 2))
        ahead = np.minimum(f[:, None] + np.array(FUTURES), ref.last[self.sequence[ids]][:, None])  # (n, futures)
        futures = out[:, s["human_rot"].stop :].reshape(n, -1, 3)
        frame.place(ref.human_pos[ahead].reshape(futures.shape), futures)

    def state(self) -> tuple[dict, dict]:
        """Arrays and JSON that `load_state` continues from bit-exactly.

        Test      tests/test_env.py::test_state_continues_exactly, tests/test_ppo.py::test_resume_is_exact"""
        arrays = {k: getattr(self, k).copy() for k in self.OWN}
        for name, part in self.parts.items():
            arrays |= {f"{name}.{k}": v for k, v in part.state().items()}
        return {"state": self.batch.state.copy()} | arrays, {"rng": rng_state(self.rng)}

    def load_state(self, arrays, meta):
        """Continue from what `state` returned.  -> obs, info as from `reset`

        Raises    ValueError: another environment's state
        Test      tests/test_env.py::test_state_continues_exactly, tests/robustness/test_fuzz.py::test_run_folders"""
        for name, need in self.state()[0].items():
            have = arrays[name]
            if have.shape != need.shape or have.dtype.kind != need.dtype.kind or not np.isfinite(have).all():
                raise ValueError(f"env.{name} is {have.dtype} {have.shape}, expected finite {need.dtype} {need.shape}")
            if need.dtype.kind == "i" and have.min(initial=0) < 0:
                raise ValueError(f"env.{name} is negative")
        if arrays["frame"].max() >= len(self.ref):
            raise ValueError(f"env.frame is beyond the motions' {len(self.ref)} frames")
        for name, part in self.parts.items():
            part.load_state({k.partition(".")[2]: v for k, v in arrays.items() if k.startswith(f"{name}.")})
        self.batch.state[:] = arrays["state"]
        for name in self.OWN:
            getattr(self, name)[:] = arrays[name]
        self.sequence[:] = self.starts.owner[self.frame]
        self.rng = rng_from_state(meta["rng"])
        self.refresh()
        self.observe(slice(None))
        return self.full[:, : self.obs_size], {"critic": self.full}
