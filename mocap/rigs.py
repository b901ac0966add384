r"""Capture rigs: which joint is which segment, and how its axes stand  [Reda23 §3.4].

    known joint names ──────► RIGS, CMU_BONES        axes read off standing frames, once
    any other names ────────► guess or joint map ──► measure: axes from positions and from the motion

A rig's rest pose says nothing here (it may be a T-pose, or bones along x): for an unknown rig the axes are measured.

    joint map, TOML           left out: guessed from the names
    unit = "cm"               m, cm, mm, in, cmu (0.0254/0.45 m), or metres a unit; left out: from the body's size
    up = "y"                  x, y, z, -x, -y or -z; left out: from where the head is
    balls = ["LeftToe", "RightToe"]
    [joints]
    pelvis = "Hips"           a joint, or JOINT.end for its End Site; all 15 segments of `human.SEGMENTS`
"""

from __future__ import annotations

import contextlib
import re
import sys
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from human import (
    CONTACT_HEIGHT,
    CONTACT_SPEED,
    FEET,
    SEG,
    SEGMENTS,
    Clip,
    linear_velocity,
    quat_about,
    quat_conj,
    quat_continuous,
    quat_mul,
    quat_rotate,
)
from mocap import amc, bvh
from mocap.mend import ANKLE, REST_SEEN, doubt_rate, floor_of, leading_rest, may_rest
from plumbing.cli import UserError, printable

# ------------------------------------------------------------------------------------ known rigs


@dataclass(frozen=True)
class Rig:
    """How one capture skeleton maps to the canonical human.

    joints : segment -> joint of the file.  pelvis is placed at the midpoint of the thighs' joints
    axes   : segment -> (forward, left, up) in the joint's own frame when standing, each as "-z" or a vector
    pitch  : segment -> degrees by which the joint's forward axis points down when standing; taken out
    balls  : the joints at the balls of the feet, left and right
    """

    joints: dict
    axes: dict
    balls: tuple
    pitch: dict = field(default_factory=dict)
    unit: float = 0.01  # file unit in metres
    signature: tuple = ()
    up: str = "y"  # the file's axis that points up

    def calibration(self, segment: str) -> np.ndarray:
        """Constant rotation anatomical frame -> joint frame (4,).

        Test      tests/mocap/test_mocap.py::test_rigs_stand_upright."""
        cols = np.stack([_axis(a) for a in self.axes[segment]], axis=1)  # (3, 3): forward, left, up as columns
        q = Rotation.from_matrix(cols).as_quat(scalar_first=True)
        return quat_mul(q, quat_about(1, np.radians(-self.pitch.get(segment, 0.0))))


def _axis(a):
    """ "-z" -> (0, 0, -1); a vector passes through, made unit length."""
    if isinstance(a, str):
        v = np.zeros(3)
        v["xyz".index(a[-1])] = -1.0 if a[0] == "-" else 1.0
        return v
    if not np.linalg.norm(a) > 1e-9:
        raise ValueError("joints lie on one another, or an axis along its bone")
    return np.asarray(a, dtype=float) / np.linalg.norm(a)


def axes_of(left, up):
    """(forward, left, up) from a left axis made orthogonal to up.  ValueError: there is no such axis

    Test      tests/mocap/test_rigs.py::test_any_rig"""
    left, up = _axis(left), _axis(up)
    left = _axis(left - up * (left @ up))
    return np.cross(left, up), left, up


def _limbs(frames: dict) -> dict:
    """Spread one frame a limb over its segments, and both sides."""
    out = {}
    for limb, (left_side, right_side) in frames.items():
        for segment in {"leg": ("thigh", "shin"), "arm": ("upper_arm", "forearm", "hand"), "foot": ("foot",)}[limb]:
            out[f"{segment}_l"], out[f"{segment}_r"] = left_side, right_side
    return out


# Axes were read off standing and walking frames: the bones lie along local x in both rigs, knees and elbows turn about
# one local axis.  Pitches: the foot's bone slopes down to the ball by this much when the foot is flat; the Bandai head
# looks down by this much in the mean over `walk_normal`, where people look ahead (ASSUMED).
RIGS = {
    "bandai": Rig(
        signature=("joint_Root", "Hips", "UpperLeg_L", "LowerArm_R"),
        joints=dict(
            pelvis="Hips", chest="Chest", head="Head",
            thigh_l="UpperLeg_L", shin_l="LowerLeg_L", foot_l="Foot_L",
            thigh_r="UpperLeg_R", shin_r="LowerLeg_R", foot_r="Foot_R",
            upper_arm_l="UpperArm_L", forearm_l="LowerArm_L", hand_l="Hand_L",
            upper_arm_r="UpperArm_R", forearm_r="LowerArm_R", hand_r="Hand_R",
        ),  # fmt: skip
        balls=("Toes_L", "Toes_R"),
        axes=dict(
            pelvis=("z", "-y", "x"),
            chest=("y", "z", "x"),
            head=("y", "z", "x"),
            **_limbs(dict(
                leg=(("z", "y", "-x"), ("-z", "y", "x")),
                arm=(("z", "y", "-x"), ("-z", "y", "x")),
                foot=(("x", "y", "z"), ("-x", "y", "-z")),
            )),
        ),
        pitch=dict(foot_l=39.6, foot_r=39.6, head=12.6),
    ),
    "lafan1": Rig(
        signature=("Hips", "LeftUpLeg", "Spine2", "LeftForeArm", "LeftToe"),
        joints=dict(
            pelvis="Hips", chest="Spine2", head="Head",
            thigh_l="LeftUpLeg", shin_l="LeftLeg", foot_l="LeftFoot",
            thigh_r="RightUpLeg", shin_r="RightLeg", foot_r="RightFoot",
            upper_arm_l="LeftArm", forearm_l="LeftForeArm", hand_l="LeftHand",
            upper_arm_r="RightArm", forearm_r="RightForeArm", hand_r="RightHand",
        ),  # fmt: skip
        balls=("LeftToe", "RightToe"),
        axes=dict(
            pelvis=("y", "z", "x"),
            chest=("y", "z", "x"),
            head=("y", "z", "x"),
            **_limbs(dict(
                leg=(("y", "-z", "-x"), ("y", "-z", "-x")),
                # the elbows' axis in the arms' frames, the mean of upper arm × forearm over the clip
                arm=(axes_of((0, 0.34, 0.94), "-x"), axes_of((0, -0.38, 0.92), "-x")),
                foot=(("x", "-z", "y"), ("x", "-z", "y")),
            )),
        ),
        pitch=dict(foot_l=25.8, foot_r=25.8),
    ),
}  # fmt: skip

# ------------------------------------------------------------------------------------ units and axes of a file

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "cmu": 0.0254 / 0.45}
UPS = ("x", "y", "z", "-x", "-y", "-z")
HIPS = (0.6, 1.2)  # m, height of a standing human's hips; its ends' ratio is less than that of any two units
ADULTS = (0.8, 1.1)  # m, the same of who is 1.5 to 2.1 m tall.  ASSUMED: files in inches are of adults
RARE = ("in", "cmu")  # units that a figure drawn to taste is taken for only with an adult's hips


@dataclass(frozen=True)
class Reading:
    """What a user says about files, over what is known, guessed or measured; None: nothing.

    Raises    UserError: a unit, an axis, a rate or a word that is none
    Test      tests/mocap/test_rigs.py::test_overrides, ::test_bad_joint_maps, tests/mocap/test_mend.py::test_flags
    """

    joint_map: str | None = None
    unit: str | None = None
    up: str | None = None
    rate: str | float | None = None
    floor: str | None = None
    rest_pose: str | None = None

    def __post_init__(self):
        checked_unit("--unit", self.unit)
        checked_up("--up", self.up)
        object.__setattr__(self, "rate", _rate("--rate", self.rate))
        for name, valid in (("floor", FLOORS), ("rest_pose", REST_POSES)):
            if (value := getattr(self, name)) not in (None, *valid):
                raise UserError(f"--{name.replace('_', '-')} {value}: valid: {', '.join(valid)}")

    @classmethod
    def of(cls, options) -> Reading:
        """The same of a command's options; a command without one of the flags leaves it to the reader."""
        return cls(**{f.name: getattr(options, f.name, None) for f in fields(cls)})


HELP = {  # of the flags that every command with --motion has
    "joint_map": "TOML file that says which joint is which segment, for BVH files of rigs that are neither known nor "
    "guessed",
    "unit": "length unit of the motion: m, cm, mm, in, cmu, or metres a unit; by default found from the body's size",
    "up": "axis of the BVH files that points up: x, y, z, or --up=-z; found from the body by default",
    "rate": "frames a second of the motion files, whatever they say themselves",
    "floor": "what to do where the feet rest more than 6 cm off the floor: level (default), or file to leave it",
    "rest_pose": "what to do with a rest pose before the motion, a jump away from it: drop (default) or keep",
}
FLOORS, REST_POSES = ("level", "file"), ("drop", "keep")


def checked_unit(where, value) -> float | None:
    """Metres a unit, of a name or a number.  UserError, beginning with `where`: neither

    Test      tests/mocap/test_rigs.py::test_overrides"""
    if value is None or isinstance(value, str) and value in UNITS:
        return UNITS.get(value)
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if isinstance(value, bool) or not 1e-6 <= number <= 1e6:
        valid = f"{', '.join(UNITS)}, or metres a unit as a number, 1e-6 to 1e6"
        raise UserError(f"{where} {value!r} is no unit; valid: {valid}")
    return number


def _rate(where, value) -> float | None:
    """Frames a second."""
    least, most = (1.0 / t for t in reversed(bvh.FRAME_TIMES))
    try:
        number = None if value is None else float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if number is not None and not least <= number <= most:
        raise UserError(f"{where} {value!r}: valid: frames a second, {least:g} to {most:g}")
    return number


def checked_up(where, value) -> str | None:
    """The axis that points up.  UserError, beginning with `where`: no axis

    Test      tests/mocap/test_rigs.py::test_overrides"""
    if value is not None and value not in UPS:
        raise UserError(f"{where} {value!r} is no axis; valid: {', '.join(UPS)}")
    return value


AS_IT_IS = Reading()


@cache
def from_file_axes(up: str):
    """File axes -> ours: (permutation, signs, the same turn as a quaternion).  A cyclic permutation puts the up axis
    last (from y up: x left, y up, z forward); an axis that points down is then turned over about ours x."""
    k = "xyz".index(up[-1])
    half = [(0.5, -0.5, -0.5, -0.5), (0.5, 0.5, 0.5, 0.5), (1.0, 0.0, 0.0, 0.0)][k]
    turn, signs = np.array(half), np.ones(3)
    if up[0] == "-":
        turn, signs = quat_mul(np.array([0.0, 1.0, 0.0, 0.0]), turn), np.array([1.0, -1.0, -1.0])
    return [(k + 1) % 3, (k + 2) % 3, k], signs, turn


# ------------------------------------------------------------------------------------ what is said of a file

_heard: ContextVar[list | None] = ContextVar("heard", default=None)


def say(path, text, warning=True) -> None:
    """One line about a file on stderr; a warning is also kept for whoever listens (`heard`).

    Test      tests/mocap/test_mend.py::test_inspect_json"""
    print(printable(f"{path}: {text}"), file=sys.stderr)
    if warning and (kept := _heard.get()) is not None:
        kept.append((str(path), text))


@contextlib.contextmanager
def heard():
    """A list that fills with the (path, text) of every warning said inside.

    Test      tests/mocap/test_mend.py::test_inspect_json"""
    kept = []
    token = _heard.set(kept)
    try:
        yield kept
    finally:
        _heard.reset(token)


# ------------------------------------------------------------------------------------ reading a file


def rig_of(b: bvh.Bvh) -> str | None:
    """Name of the known rig whose joints the file has, or None.  Test: tests/mocap/test_mocap.py::test_unknown_rig."""
    for name, rig in RIGS.items():
        if set(rig.signature) | set(rig.balls) | set(rig.joints.values()) <= set(b.names):
            return name
    return None


BONE_OFF = 40.0  # degrees between a bone and where a known rig's table has it: more is another rig of the same names


def known_rig(b: bvh.Bvh) -> str | None:
    """As `rig_of`, if the bones of the limbs lie in their joints' frames as that rig's do.

    Test      tests/mocap/test_mend.py::test_same_names_other_axes"""
    name = rig_of(b)
    if not name:
        return None
    pos, quat = bvh.global_pose(replace(b, values=b.values[:1]))
    at = {s: b.names.index(n) for s, n in RIGS[name].joints.items()}
    for limb in (("thigh", "shin", "foot"), ("upper_arm", "forearm", "hand")):
        for side in "lr":
            for upper, lower in zip(limb, limb[1:]):
                i, j = at[f"{upper}_{side}"], at[f"{lower}_{side}"]
                bone = quat_rotate(quat_conj(quat[0, i]), pos[0, j] - pos[0, i])
                up = _axis(RIGS[name].axes[f"{upper}_{side}"][2])
                if bone @ -up < np.cos(np.radians(BONE_OFF)) * np.linalg.norm(bone):
                    return None
    return name


def read(path, reading=AS_IT_IS, quiet=False) -> bvh.Bvh:
    """A BVH file as it stands, a rest pose in front left out, at the rate that the user says.

    Raises    UserError: there is none, or it is malformed
    Test      tests/robustness/test_cli.py::test_broken_motion, tests/mocap/test_mend.py::test_leading_rest
    """
    try:
        b = bvh.read(path, reading.rate and 1.0 / reading.rate)
    except bvh.BvhError as e:
        raise UserError(str(e)) from None
    except OSError as e:
        raise UserError(f"{path}: {e.strerror or e}; expected a regular .bvh file") from None
    _check_moving(path, len(b.names), b.values.shape[1])
    if not reading.rate and (slower := cmu_rate(path, 1.0 / b.frame_time, quiet)):
        b = replace(b, frame_time=1.0 / slower)
    if reading.rest_pose == "keep" or not may_rest(b.values):
        return b
    n = leading_rest(bvh.global_pose(replace(b, values=b.values[:REST_SEEN]))[0])
    if n and not quiet:
        say(path, _dropped(n))
    return replace(b, values=b.values[n:])


CMU_60 = re.compile(r"6[01]_(salsa_)?\d\d")  # file names of CMU's subjects 60 and 61, who dance salsa


def cmu_rate(path, rate, quiet=False) -> float | None:
    """Half the rate, and a line, for captures of CMU that were recorded at 60 Hz and are said to be of 120; else None.

    ASSUMED   subjects 60 and 61: as 120 Hz (30 in every fourth frame) eight beats of their salsa last 1.45 s, 331 a
              minute, and her pelvis turns at 20 rad/s; at half that 165, which is salsa's.  Some subjects of CMU's are
              of 60 Hz, and conversions that know one rate play them at twice their pace
    Test      tests/mocap/test_amc.py::test_cmu_rate"""
    if not CMU_60.fullmatch(Path(path).stem) or round(rate) not in (30, 120):
        return None
    if not quiet:
        half = f"read at {rate / 2:.3g} frames a second; as it was: --rate {rate:.3g}"
        say(path, f"CMU recorded this dance at 60 Hz, and {rate:.3g} frames a second are those of 120: {half}")
    return rate / 2.0


def _dropped(n) -> str:
    what = "frame 0 is a rest pose" if n == 1 else f"frames 0 to {n - 1} are a rest pose"
    return f"{what}, a jump away from the motion: dropped; to keep it: --rest-pose keep"


def _check_moving(path, joints, values):
    """A pose of all joints takes no more memory than its row of values is worth."""
    if joints > 2 * values:
        raise UserError(f"{path}: {joints} joints of which most cannot move, {values} values a frame; expected a rig")


def is_amc(path) -> bool:
    """Whether a path's name is an AMC file's.  Test: tests/mocap/test_amc.py::test_body_split."""
    return Path(path).suffix.lower() == ".amc"


def canonical(b: bvh.Bvh, rig: Rig, name: str, reading=AS_IT_IS) -> Clip:
    """A file in a rig -> the canonical human.

    Test      tests/mocap/test_mocap.py::test_root_offset, tests/mocap/test_rigs.py::test_floor"""
    pose = _clip_of(b, rig, name, "replace")
    root = b.parents.argmin()
    if np.any(b.offsets[root]) and any("position" in c for c in b.channels[root]):
        # Some exporters add the root's OFFSET to its channels, most do not: right is what puts the feet on the floor.
        added = _clip_of(b, rig, name, "add")
        if abs(_lowest(added)) < abs(_lowest(pose)):
            pose = added
    if name in RIGS and not reading.unit:
        pose = _adult(b.path, pose, rig.unit)
    pose = _on_floor(b.path, pose, reading, all(ball.endswith(".end") for ball in rig.balls))
    if (lean := _lean(pose)) > LYING:
        say(b.path, f"the body is {lean:.0f} degrees off {rig.up}, taken as up; another: --up")
    _check_size(b.path, pose, "; its unit and up axis can be given as --unit, --up")
    if not reading.rate and (doubt := doubt_rate(pose)):
        say(b.path, doubt)
    return replace(pose, body=_body(name, pose))


def _on_floor(path, clip, reading, ends=False):
    """The clip moved up or down so that its feet rest on the floor, and a line about it."""
    low = 0.0 if reading.floor == "file" else floor_of(clip, ends)
    if not low:
        return clip
    say(path, f"the feet rest {100 * abs(low):.0f} cm {'above' if low > 0 else 'below'} the floor: levelled; "
        "to leave it: --floor file")  # fmt: skip
    down = np.array([0.0, 0.0, low])
    return replace(clip, pos=clip.pos - down, ball=clip.ball - down)


ADULT = 0.9  # m, hips of an adult


def find_unit(pos):
    r"""The unit in which the hips are as high as a standing adult's.

    Height    thigh + shin + the ankle's lowest height over the floor: over the file's 0 where the balls rest within a
              twelfth of the legs' length of it, else over the balls, as far as ankles stand above them (ANKLE)
    Args      pos : (T, 17, 3) segments' joints and balls of the feet, z up, file units
    Returns   metres a unit; the unit's name, or None where none fits: then the hips are made 0.9 m high (ASSUMED: of
              a figure drawn to taste nothing else is known); the hips' height [file units]
    Test      tests/mocap/test_rigs.py::test_units_and_up, tests/mocap/test_mend.py::test_any_scale
    """
    length = lambda a, b: np.linalg.norm(pos[:, SEG[a]] - pos[:, SEG[b]], axis=-1).mean()  # noqa: E731
    legs = np.mean([length(f"thigh_{s}", f"shin_{s}") + length(f"shin_{s}", f"foot_{s}") for s in "lr"])
    ankle = np.mean(np.percentile(pos[:, FEET, 2], 5, axis=0))
    ball = np.mean(np.percentile(pos[:, 15:17, 2], 5, axis=0))
    hips = float(legs + (ankle if abs(ball) < legs / 12 else np.clip(ankle - ball, 0.0, ANKLE * legs)))
    for name, unit in UNITS.items():
        low, high = ADULTS if name in RARE else HIPS
        if low <= hips * unit <= high:
            return unit, name, hips
    return ADULT / max(hips, 1e-9), None, hips


def _adult(path, clip, unit):
    """A clip that was read in a unit: in another one if its hips are no adult's."""
    found, name, hips = find_unit(np.concatenate([clip.pos, clip.ball], axis=1) / unit)
    if HIPS[0] <= hips * unit <= HIPS[1]:
        return clip
    say(path, unit_line(found, name, hips), warning=not name)
    return replace(clip, pos=clip.pos * (found / unit), ball=clip.ball * (found / unit))


def unit_line(unit, name, hips) -> str:
    """What is said of a unit that was found.  Test: tests/mocap/test_mend.py::test_any_scale"""
    if name:
        low, high = ADULTS if name in RARE else HIPS
        return f"unit {name}: the hips of a standing adult are {low} to {high} m high, these {hips * unit:.2f} m"
    return f"hips {hips:.4g} units high: scaled to an adult's {ADULT} m, {unit:.4g} m a unit; another: --unit"


LYING = 60.0  # degrees; the most that `find_up` takes for upright is 53


def _lean(clip) -> float:
    """Degrees between up and where the head is from the feet, in the mean.

    Test      tests/mocap/test_rigs.py::test_overrides"""
    v = (clip.pos[:, SEG["head"]] - clip.pos[:, FEET].mean(axis=1)).mean(axis=0)
    return float(np.degrees(np.arctan2(np.hypot(v[0], v[1]), v[2])))


HIP_HEIGHTS = (0.1, 10.0)  # m; what follows divides by the height of the hips


def _check_size(path, clip, remedy):
    """UserError if nobody is that small or that large."""
    if not HIP_HEIGHTS[0] <= clip.hip_height <= HIP_HEIGHTS[1]:
        valid = f"{HIP_HEIGHTS[0]:g} to {HIP_HEIGHTS[1]:g} m{remedy}"
        raise UserError(f"{path}: the hips are {clip.hip_height:.3g} m above the floor; valid: {valid}")


def _body(rig: str, clip: Clip) -> str:
    """Whose body: the rig and the lengths of leg and arm [cm], so that two people in one rig are two bodies."""
    leg = clip.limb("thigh_l", "shin_l") + clip.limb("shin_l", "foot_l")
    arm = clip.limb("upper_arm_l", "forearm_l") + clip.limb("forearm_l", "hand_l")
    return f"{rig}-leg{100 * leg:.0f}-arm{100 * arm:.0f}"


def _lowest(clip):
    return np.percentile(clip.ball[..., 2].min(axis=1), 20)


def pose_of(b, root_offset="replace"):
    """Names, positions and rotations of joints and, as JOINT.end, of End Sites.  File units and axes."""
    pos, quat = bvh.global_pose(b, root_offset)
    index = {n: j for j, n in enumerate(b.names)}
    at = [index[n] for n in b.end_sites]
    ends = pos[:, at] + quat_rotate(quat[:, at], np.array(list(b.end_sites.values())).reshape(-1, 3))
    names = (*b.names, *(f"{n}.end" for n in b.end_sites))
    return names, np.concatenate([pos, ends], axis=1), np.concatenate([quat, quat[:, at]], axis=1)


def _clip_of(b, rig, name, root_offset):
    calibrations = np.stack([rig.calibration(s) for s in SEGMENTS])
    if any(n.endswith(".end") for n in (*rig.joints.values(), *rig.balls)):
        pose = pose_of(b, root_offset)
    else:
        pose = (b.names, *bvh.global_pose(b, root_offset))
    return human_clip(rig, calibrations, *pose, Path(b.path).stem, name, 1.0 / b.frame_time)


def human_clip(rig, calibrations, names, pos, quat, clip, body, rate):
    """The canonical human in a file's joints (file units and axes)."""
    index = {n: i for i, n in enumerate(names)}
    cols = [index[rig.joints[s]] for s in SEGMENTS]
    order, signs, turn = from_file_axes(rig.up)
    p = pos[..., order] * (signs * rig.unit)
    q = quat_mul(turn, quat_mul(quat[:, cols], calibrations))
    joint_pos = p[:, cols].copy()
    joint_pos[:, 0] = 0.5 * (joint_pos[:, SEG["thigh_l"]] + joint_pos[:, SEG["thigh_r"]])
    ball = p[:, [index[n] for n in rig.balls]]
    return Clip(clip, body, rate, joint_pos, quat_continuous(q), ball)


# ------------------------------------------------------------------------------------ CMU

# CMU's skeletons: the same bones and zero pose for every subject, lengths and some directions of their own.  The head's
# joint is where `head` starts: 9 cm below the headband, as in a skull.  The forearm is `radius` and `wrist` together:
# `wrist` only pronates, and `hand` flexes.  `thorax` starts in the middle of the back.
CMU_BONES = dict(
    pelvis="root", chest="thorax", head="head",
    thigh_l="lfemur", shin_l="ltibia", foot_l="lfoot", thigh_r="rfemur", shin_r="rtibia", foot_r="rfoot",
    upper_arm_l="lhumerus", forearm_l="lradius", hand_l="lhand",
    upper_arm_r="rhumerus", forearm_r="rradius", hand_r="rhand",
)  # fmt: skip
# Degrees, means over subjects 07, 08, 16, 35.  In straight walks the head looks down by 15 (10 to 18), and people look
# ahead (ASSUMED).  With ankle and ball both slower than 0.25 m/s the sole, square to the shank in the zero pose, points
# down by 2.9 (1.9 to 5.0).
CMU_PITCH = dict(head=15.0, foot_l=2.9, foot_r=2.9)
INCH = 0.0254  # m; CMU's unit is 1 / (:units length) inches
AMC_RATE = 120.0  # Hz of CMU's AMC files, which do not say it


def cmu_rig(skeleton: amc.Skeleton) -> Rig:
    r"""The rig of a CMU skeleton, from its zero pose: a T-pose with splayed legs, all bones' frames being the file's.

    Method    up: against the bone (thigh, shin, arm, hand), the file's y (trunk, head), the shin's (foot).
              left: the knee's axis, with which the shin bends back, for the leg; against the elbow's axis, with which
              the forearm bends forward, for upper arm and forearm; in the hand the T-pose's palms face down and the
              thumbs forward, so left is up (left hand) or down.  Knee and elbow turn about x of their `axis`
    Frame     of the file: x left, y up, z forward
    Raises    UserError: bones are missing, or a knee or an elbow has no rx; names them
    Test      tests/mocap/test_amc.py::test_zero_pose_is_a_t_pose, ::test_cmu_anatomy, ::test_unknown_skeleton
    """
    index = {n: i for i, n in enumerate(skeleton.names)}
    wanted = {*CMU_BONES.values(), "ltoes", "rtoes"}
    hinges = {"ltibia", "rtibia", "lradius", "rradius"}
    missing = sorted(wanted - set(index)) or sorted(n for n in hinges if "rx" not in skeleton.dofs[index[n]])
    if missing:
        raise UserError(
            f"{skeleton.path}: no CMU skeleton: {', '.join(missing)} missing or without rx; "
            f"it has {bvh.listed(skeleton.names)}"
        )

    def hinge(name):
        i = index[name]
        return Rotation.from_euler(skeleton.axis_orders[i], skeleton.axes[i]).apply([1.0, 0.0, 0.0])

    axes = dict.fromkeys(("pelvis", "chest", "head"), axes_of("x", "y"))
    for side, palm in (("l", "y"), ("r", "-y")):
        up = {s: -skeleton.directions[index[side + s]] for s in ("femur", "tibia", "humerus", "radius", "hand")}
        knee, elbow = hinge(f"{side}tibia"), -hinge(f"{side}radius")
        axes[f"thigh_{side}"], axes[f"shin_{side}"] = axes_of(knee, up["femur"]), axes_of(knee, up["tibia"])
        axes[f"foot_{side}"] = axes[f"shin_{side}"]
        axes[f"upper_arm_{side}"], axes[f"forearm_{side}"] = axes_of(elbow, up["humerus"]), axes_of(elbow, up["radius"])
        axes[f"hand_{side}"] = axes_of(palm, up["hand"])
    return Rig(CMU_BONES, axes, ("ltoes", "rtoes"), CMU_PITCH, INCH / skeleton.length)


def from_amc(path, reading=AS_IT_IS) -> Clip:
    """Read a CMU motion as the canonical human; its skeleton lies beside it.

    Symbols   as in `from_bvh`; unit 0.0254 / (:units length) m; the balls of the feet are where the toes start
    Frame     world, floor at z = 0, metres; made level by `level`
    Args      path : SUBJECT_TRIAL.amc beside SUBJECT.asf, or beside a single .asf of any name
              reading : its rate [Hz] is not in the file; CMU's are 120
    Returns   Clip at that rate, body cmu-SUBJECT with lengths of leg and arm
    Raises    UserError: cannot be opened, malformed, no skeleton beside it, or not CMU's; names what was looked for
    Test      tests/mocap/test_amc.py::test_from_amc_against_matrices, ::test_skeleton_beside, ::test_cmu_anatomy
    """
    s, motion = read_amc(path)
    try:
        rig = cmu_rig(s)
        rig = replace(rig, unit=checked_unit("--unit", reading.unit) or rig.unit)
    except ValueError as e:
        raise UserError(f"{s.path}: the axes of its bones make no frame: {e}; expected CMU's bones") from None
    calibrations = np.stack([rig.calibration(segment) for segment in SEGMENTS])
    pose = amc.global_pose(s, motion)
    rate = reading.rate or cmu_rate(path, AMC_RATE) or AMC_RATE
    clip = human_clip(rig, calibrations, s.names, *pose, Path(path).stem, "", rate)
    n = leading_rest(clip.pos) if reading.rest_pose != "keep" else 0
    if n:
        say(path, _dropped(n))
        clip = clip[n:]
    if not reading.unit:
        clip = _adult(path, clip, rig.unit)
    clip = _on_floor(path, level(clip), reading)
    _check_size(path, clip, f"; the unit is that of {Path(s.path).name}: 1 / (length of :units) inches, or --unit")
    if not reading.rate and (doubt := doubt_rate(clip)):
        say(path, doubt)
    return replace(clip, body=_body(f"cmu-{Path(s.path).stem}", clip))


LEVEL_SPREAD, LEVEL_LIMIT = 0.2, 3.0  # m; degrees


def level(clip: Clip) -> Clip:
    r"""The clip turned about the origin so that the floor under its standing feet is level.

    Why       the floor of CMU's subjects 07 and 08 rises by 1.8 to 2.1 cm a metre: 6 cm from end to end of a walk
    Equation  g = argmin mean_i (h_i − g·x_i)² + s² |g|²; h_i, x_i: height and place of a standing ball, both less that
              foot's means.  s = 0.2 m: where the feet spread less than that, as across a straight walk, g stays 0.
              Then a turn by atan |g| about (−g_y, g_x, 0)
    ASSUMED   the floor is a plane through the capture's origin: there the balls of all four subjects stand 3 to 5 cm
              high.  More than 3 degrees are stairs or a ramp, which stay
    Test      tests/mocap/test_amc.py::test_level, ::test_cmu_floor
    """
    standing = (clip.ball[..., 2] < CONTACT_HEIGHT) & (
        np.linalg.norm(linear_velocity(clip.ball, clip.rate), axis=-1) < CONTACT_SPEED
    )
    feet = [clip.ball[standing[:, k], k] for k in (0, 1) if standing[:, k].any()]
    if not feet:
        return clip
    d = np.concatenate([f - f.mean(axis=0) for f in feet])
    x, h = d[:, :2], d[:, 2]
    g = np.linalg.solve(x.T @ x / len(x) + LEVEL_SPREAD**2 * np.eye(2), x.T @ h / len(x))
    steep = np.linalg.norm(g)
    angle = np.arctan(steep)
    if not 0.0 < angle < np.radians(LEVEL_LIMIT):
        return clip
    q = np.array([np.cos(angle / 2), *np.sin(angle / 2) / steep * np.array([-g[1], g[0], 0.0])])
    return replace(clip, pos=quat_rotate(q, clip.pos), ball=quat_rotate(q, clip.ball), quat=quat_mul(q, clip.quat))


def skeleton_beside(path):
    """The .asf files that may belong to an .amc file, best first; those equally good are all given.

    Rule      SUBJECT.asf for SUBJECT_TRIAL.amc; else the longest name with which the motion's begins; else, for
              `09_06-run.amc`, those of subject 09 (`09-run.asf`, `9.asf`), of several those with the same suffix; else
              a single one of any name
    Test      tests/mocap/test_amc.py::test_skeleton_beside, tests/mocap/test_mend.py::test_skeletons_with_suffixes
    """
    beside = sorted(f for f in path.parent.glob("*") if f.suffix.lower() == ".asf")
    stem = path.stem.lower()
    words = lambda name: [w.lstrip("0") or w for w in re.findall(r"[^\W_]+", name.lower())]  # noqa: E731
    subject = stem.rpartition("_")[0] or stem
    found = [f for f in beside if f.stem.lower() == subject]
    begins = [f for f in beside if re.match(re.escape(f.stem.lower()) + r"(?![^\W_])", stem)]
    found = found or [f for f in begins if len(f.stem) == max(len(g.stem) for g in begins)]
    found = found or [f for f in beside if words(f.stem)[:1] == words(stem)[:1]]
    same = [f for f in found if words(f.stem)[1:] and words(f.stem)[1:] == words(stem)[-len(words(f.stem)[1:]) :]]
    return same if len(found) > 1 and same else found or beside


def read_amc(path):
    """Skeleton and motion of an .amc file."""
    path = Path(path)
    skeleton = skeleton_beside(path)
    try:
        if path.exists() and len(skeleton) != 1:
            subject = path.stem.rpartition("_")[0] or path.stem
            found = ", ".join(f.name for f in sorted(path.parent.glob("*")) if f.suffix.lower() == ".asf") or "none"
            raise UserError(
                f"{path}: no skeleton beside it: looked for {subject}.asf or a single .asf in {path.parent}; "
                f"there is {found[:200]}"
            )
        s = amc.read_asf(skeleton[0]) if skeleton else None
        motion = amc.read_amc(path, s)
        _check_moving(s.path, len(s.names), len(s.columns))
        return s, motion
    except amc.AmcError as e:
        raise UserError(str(e)) from None
    except OSError as e:
        raise UserError(f"{e.filename or path}: {e.strerror or e}; expected a regular file") from None
