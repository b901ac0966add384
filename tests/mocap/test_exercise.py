"""The built-in exercises: one body, still feet, weight above them, jumps that fall as stones do."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from mocap import data, exercise, gait

INDEX = {name: i for i, name in enumerate(gait.SEGMENTS)}
KINDS = list(exercise.EXERCISES)


def of(clip, name):
    return clip["pos"][:, INDEX[name]]


def above_floor(clip):
    """(T, 2): the lower of heel and ball of each foot, less where it is when the foot stands flat."""
    body, low = gait.body_of(clip), []
    for j, e in enumerate("lr"):
        turn = Rotation.from_quat(clip["quat"][:, INDEX[f"foot_{e}"]], scalar_first=True)
        heel = of(clip, f"foot_{e}") + turn.apply(body.heel)
        low.append(np.minimum(heel[:, 2], clip["ball"][:, j, 2] - body.ball_height))
    return np.stack(low, 1)


@pytest.mark.parametrize("kind", KINDS)
def test_one_body(kind):
    """Shapes, unit quaternions without jumps, and joints as far apart as the body has them."""
    height = 1.62
    clip, body = exercise.generate(kind, 12, seed=3, height=height), gait.Body(height)
    assert [clip[k].shape for k in ("pos", "quat", "ball")] == [(360, 15, 3), (360, 15, 4), (360, 2, 3)]
    assert np.isclose(gait.body_of(clip).height, height)
    np.testing.assert_allclose(np.linalg.norm(clip["quat"], axis=-1), 1, atol=1e-12)
    assert (np.sum(clip["quat"][1:] * clip["quat"][:-1], -1) > 0.9).all()
    joints = [("pelvis", "chest", body.chest), ("chest", "head", body.head)]
    for j, (e, sign) in enumerate((("l", 1), ("r", -1))):
        joints += [
            ("pelvis", f"thigh_{e}", np.array([0, sign * body.hip_half_width, 0])),
            (f"thigh_{e}", f"shin_{e}", np.array([0, 0, -body.thigh])),
            (f"shin_{e}", f"foot_{e}", np.array([0, 0, -body.shin])),
            ("chest", f"upper_arm_{e}", body.shoulder * [1, sign, 1]),
            (f"upper_arm_{e}", f"forearm_{e}", np.array([0, 0, -body.upper_arm])),
            (f"forearm_{e}", f"hand_{e}", np.array([0, 0, -body.forearm])),
        ]
        foot = Rotation.from_quat(clip["quat"][:, INDEX[f"foot_{e}"]], scalar_first=True)
        np.testing.assert_allclose(clip["ball"][:, j], of(clip, f"foot_{e}") + foot.apply(body.ball), atol=1e-9)
    for parent, child, offset in joints:
        turn = Rotation.from_quat(clip["quat"][:, INDEX[parent]], scalar_first=True)
        np.testing.assert_allclose(of(clip, child), of(clip, parent) + turn.apply(offset), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_feet_neither_skate_nor_sink(kind):
    """A foot on the floor, flat or on its ball, keeps its ball where it is; none goes through the floor."""
    clip = exercise.generate(kind, 30, seed=5)
    low = above_floor(clip)
    assert low.min() > -1e-9
    stands = (low[1:] < 1e-4) & (low[:-1] < 1e-4)
    moves = np.linalg.norm(np.diff(clip["ball"], axis=0), axis=2)
    assert stands.mean() > 0.3 and moves[stands].max() < 2e-3


def test_center_of_mass():
    """Against MuJoCo: a body of points of the masses of Winter's table 4.1, where the clip has them."""
    masses = dict(
        trunk=0.497, head=0.081, upper_arm=0.028, forearm=0.016, hand=0.006, thigh=0.1, shin=0.0465, foot=0.0145
    )
    clip = exercise.generate("windmill", 4, seed=1)
    poss = {name: clip["pos"][:, i] for name, i in INDEX.items()}
    spots = {
        "trunk": ("pelvis", ("upper_arm_l", "upper_arm_r"), 0.5),
        "head": ("head", ("head",), 0.0),
    }
    for e in "lr":
        spots |= {
            f"upper_arm {e}": (f"upper_arm_{e}", (f"forearm_{e}",), 0.436),
            f"forearm {e}": (f"forearm_{e}", (f"hand_{e}",), 0.430),
            f"hand {e}": (f"hand_{e}", (f"hand_{e}",), 0.0),
            f"thigh {e}": (f"thigh_{e}", (f"shin_{e}",), 0.433),
            f"shin {e}": (f"shin_{e}", (f"foot_{e}",), 0.433),
        }
    frame, bodies = 70, []

    def body(mass, x):
        place = " ".join(map(repr, map(float, x)))
        bodies.append(
            f'<body pos="{place}"><freejoint/><inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/></body>'
        )

    for name, (origin, ends, share) in spots.items():
        end = np.mean([poss[k][frame] for k in ends], axis=0)
        body(masses[name.split()[0]], poss[origin][frame] * (1 - share) + share * end)
    for j, e in enumerate("lr"):
        body(masses["foot"], 0.5 * (poss[f"foot_{e}"] + clip["ball"][:, j])[frame])
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>")
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    assert model.body_mass.sum() == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(exercise.center_of_mass(poss, clip["ball"])[frame], state.subtree_com[0], atol=1e-9)


@pytest.mark.parametrize("kind", [kind for kind, one in exercise.EXERCISES.items() if not one.jumps])
def test_sizes(kind):
    """A tall person does as a short one, in proportion; the one exception is when a foot counts as lifted, at 1 mm."""
    short, tall = (exercise.generate(kind, 20, seed=3, height=h)["pos"] / h for h in (1.5, 1.9))
    np.testing.assert_allclose(short, tall, atol=0.01)


def test_sides():
    """Who boxes brings the shoulder along with the fist; in a windmill the trunk swings away from the low hand's side,
    and the other hand is up."""
    box, mill = (exercise.generate(kind, 30, seed=7) for kind in ("box", "windmill"))
    for e, other, sign in (("l", "r", 1), ("r", "l", -1)):
        i = (of(box, f"hand_{e}") - of(box, "chest"))[:, 0].argmax()
        assert of(box, f"upper_arm_{e}")[i, 0] > of(box, f"upper_arm_{other}")[i, 0] + 0.1
        i = of(mill, f"hand_{e}")[:, 2].argmin()
        middle = 0.5 * (of(mill, "upper_arm_l") + of(mill, "upper_arm_r"))[i, 1]
        assert sign * middle < -0.05 and of(mill, f"hand_{other}")[i, 2] > of(mill, f"upper_arm_{other}")[i, 2]


def test_weight_goes_to_the_standing_foot():
    clip = exercise.generate("raise", 30, seed=7)
    com = exercise.center_of_mass({name: clip["pos"][:, i] for name, i in INDEX.items()}, clip["ball"])
    for e, other in ("lr", "rl"):
        i = of(clip, f"foot_{e}")[:, 2].argmax()
        assert abs(com[i, 1] - of(clip, f"foot_{other}")[i, 1]) < 0.04


@pytest.mark.parametrize("jumps", [False, True])
def test_between(jumps):
    """Two keys half a second apart: the polynomial of minimum jerk, a parabola's height, the dip's own maximum."""
    c = len(exercise.CHANNELS)
    poses, places = np.stack([np.zeros(c), np.ones(c)]), np.zeros((2, 2))
    t = np.linspace(0, 0.5, 501)
    poses, feet, flight, sinks = exercise._between(
        exercise._Keys(np.array([0, 0.5]), poses, places, np.array([False, jumps])), t
    )
    s, air = t / 0.5, 0.2 * jumps  # s in the air: 0.4 of the move
    np.testing.assert_allclose(poses[:, 0], 10 * s**3 - 15 * s**4 + 6 * s**5, atol=1e-12)
    assert flight.max() == pytest.approx(gait.GRAVITY * air**2 / 8, abs=1e-6)
    assert sinks.max() == pytest.approx(4 / 27 * gait.GRAVITY * air / 2 * (0.5 - air) / 2, rel=1e-3)
    if not jumps:  # both feet are put elsewhere: one after the other
        up = feet[..., 2] - poses[:, exercise.CHANNELS.index("up_l"), None]
        assert ((up > 1e-9).sum(1) <= 1).all() and up.max() == pytest.approx(0.04 + 0.12 * 2**0.5, abs=1e-4)


@pytest.mark.parametrize("kind", ["bend", "squat", "windmill"])
def test_weight_is_above_the_feet(kind):
    """Of who does not step the centre of mass stays above the middle of both feet, however low the head."""
    clip, body = exercise.generate(kind, 20, seed=2), gait.Body()
    com = exercise.center_of_mass({name: clip["pos"][:, i] for name, i in INDEX.items()}, clip["ball"])
    middle = 0.5 * (body.heel[0] + body.ball[0])  # of a foot, from its ankle
    feet = np.mean([of(clip, f"foot_{e}") for e in "lr"], axis=0) + [middle, 0, 0]
    np.testing.assert_allclose(com[:, :2], feet[:, :2], atol=3e-3)


@pytest.mark.parametrize("kind", ["hop", "jack"])
def test_jumps_fall_as_stones_do(kind):
    """With both feet off the floor a hopper falls with g, however tall, and lands and leaves at below 3.5 g."""
    clip = exercise.generate(kind, 12, rate=240.0, seed=4, height=1.5)
    pelvis, *feet = (np.diff(of(clip, name)[:, 2], 2) * 240.0**2 for name in ("pelvis", "foot_l", "foot_r"))
    air = (above_floor(clip) > 1e-9).all(1)
    inside = air[:-2] & air[1:-1] & air[2:]
    assert inside.sum() > 240 and above_floor(clip).max() > 0.04
    if kind == "hop":  # in a jumping jack the legs open meanwhile
        for falls in (pelvis, *feet):
            np.testing.assert_allclose(falls[inside], -gait.GRAVITY, atol=0.1)  # the pelvis tilts a little, too
    assert np.abs(pelvis).max() < 3.5 * gait.GRAVITY


def test_exercises_are_what_they_are_called():
    """Each by what a watcher would see of it."""
    clips = {kind: exercise.generate(kind, 30, seed=7) for kind in KINDS}
    head = {kind: of(c, "head")[:, 2] / of(c, "head")[0, 2] for kind, c in clips.items()}
    hands = {kind: np.minimum(of(c, "hand_l")[:, 2], of(c, "hand_r")[:, 2]) for kind, c in clips.items()}
    assert head["bend"].min() < 0.5 and hands["bend"].min() < 0.25
    assert 0.6 < head["squat"].min() < 0.8 and of(clips["squat"], "pelvis")[:, 2].min() < 0.7
    assert head["windmill"].min() < 0.6 and hands["windmill"].min() < 0.35
    assert head["pick"].min() < 0.75 and hands["pick"].min() < 0.45
    apart = np.linalg.norm(of(clips["jack"], "foot_l") - of(clips["jack"], "foot_r"), axis=1)
    assert apart.max() > 0.5 and of(clips["jack"], "hand_l")[:, 2].max() > of(clips["jack"], "head")[:, 2].max() + 0.2
    assert head["hop"].max() > 1.03
    strides = of(clips["lunge"], "foot_l")[:, 0] - of(clips["lunge"], "foot_r")[:, 0]
    assert strides.max() > 0.4 and strides.min() < -0.4 and head["lunge"].min() < 0.9  # either foot goes first
    assert min(above_floor(clips["raise"])[:, j].max() for j in (0, 1)) > 0.2
    reach = [of(clips["box"], f"hand_{e}")[:, 0] - of(clips["box"], "chest")[:, 0] for e in "lr"]
    assert min(r.max() for r in reach) > 0.45 and max(np.median(r) for r in reach) < 0.4  # both fists, and back again


def test_without_variation_repetitions_are_alike():
    """All as far as EXERCISES says, at lengths of their own; and as deep in proportion, whatever the height."""
    low = []
    for height in (1.6, 1.75):
        z = of(exercise.generate("squat", 30, rate=120.0, seed=1, height=height, variation=0.0), "pelvis")[:, 2]
        dips = z[1:-1][(z[1:-1] <= z[:-2]) & (z[1:-1] < z[2:])]
        assert len(dips) > 3 and np.ptp(dips) < 1e-3
        low.append(dips.mean() / height)
    assert low[0] == pytest.approx(low[1], abs=1e-3)


def test_same_seed_same_bytes():
    a, b, c = (exercise.library(1.5, seed=s) for s in (1, 1, 2))
    assert all(x[k].tobytes() == y[k].tobytes() for x, y in zip(a, b, strict=True) for k in ("pos", "quat", "ball"))
    assert all(x["pos"].tobytes() != y["pos"].tobytes() for x, y in zip(a, c, strict=True))


def test_library():
    """Every exercise by people from 1.5 to 1.9 m; as a data set each is both trained on and held out."""
    clips = exercise.library(10.0)
    assert {c["name"].split("_")[1] for c in clips} == set(KINDS) and len(clips) == 20
    assert all(24 <= len(c["pos"]) / c["rate"] <= 36 for c in clips)
    heights = [gait.body_of(c).height for c in clips]
    assert 1.5 <= min(heights) < 1.6 and 1.8 < max(heights) <= 1.9
    for split in ("train", "validation"):
        assert {c.name.split("_")[0] for c in data.load("exercises", split=split)} == set(KINDS)


def test_motions_are_what_they_were():
    """Policies were trained on them: no tidying may change a number.  A random sum of them all."""
    rng = np.random.default_rng(0)
    numbers = (clip[key] for clip in exercise.library(5.0) for key in ("pos", "quat", "ball"))
    assert sum(float(np.sum(x * rng.normal(size=x.shape))) for x in numbers) == pytest.approx(504.300164, abs=1e-5)


@pytest.mark.parametrize(
    "wrong, says",
    [
        (dict(kind="yoga"), "exercise 'yoga': valid are bend, squat, windmill"),
        (dict(duration=0.0), "duration 0.0, rate 30.0, height 1.75: must be positive"),
        (dict(height=-1.0), "height -1.0: must be positive"),
    ],
)
def test_errors_name_what_is_valid(wrong, says):
    with pytest.raises(ValueError, match=says):
        exercise.generate(**{"kind": "squat", "duration": 5.0, **wrong})
