"""The built-in motions: consistent bodies, still feet, published angles, the speeds that were asked for."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from mocap import gait, inspect

DEG = np.pi / 180
INDEX = {name: i for i, name in enumerate(gait.SEGMENTS)}


@pytest.fixture(scope="module")
def clips():
    return gait.library()


@pytest.fixture(scope="module")
def standing():
    return gait.library(5.0, mix=gait.STANDING)


def rotation(clip, name):
    return Rotation.from_quat(clip["quat"][:, INDEX[name]], scalar_first=True)


def knee(clip, side):
    relative = rotation(clip, f"thigh_{side}").inv() * rotation(clip, f"shin_{side}")
    return relative.as_euler("YXZ")[:, 0]


def path_length(clip, smooth=None):
    xy = clip["pos"][:, 0, :2]
    if smooth:  # average over whole strides: leaves the path, removes the sway
        xy = np.stack([np.convolve(x, np.ones(smooth) / smooth, "valid") for x in xy.T], 1)
    return np.linalg.norm(np.diff(xy, axis=0), axis=1).sum() / ((len(xy) - 1) / clip["rate"])


def test_body_fractions():
    body = gait.Body(1.8)
    assert np.isclose(body.thigh + body.shin + body.ankle_height, 0.530 * 1.8)  # hip height
    assert np.isclose((0.530 * 1.8) + body.chest[2] + body.shoulder[2], 0.818 * 1.8)  # shoulder height
    assert np.isclose(body.ball[0] - body.heel[0], 0.72 * 0.152 * 1.8)
    assert body.heel[2] == -body.ankle_height


def test_stride_frequency():
    speed = 1.3
    steps = 120 * gait.stride_frequency(speed)  # per minute
    assert np.isclose((speed * 60 / steps) / steps, 0.0065)  # the walk ratio of Sekiya and Nagasaki
    assert 105 < steps < 115
    assert np.isclose(2 * gait.stride_frequency(3.0, jog=True), 2.7)
    assert gait.stride_frequency(1.3, 1.9) < gait.stride_frequency(1.3, 1.5)


@pytest.mark.parametrize("kind", gait.KINDS)
def test_shapes_and_quaternions(kind):
    clip = gait.generate(kind, 12, seed=3)
    assert [clip[k].shape for k in ("pos", "quat", "ball")] == [(360, 15, 3), (360, 15, 4), (360, 2, 3)]
    assert all(clip[k].dtype == np.float64 and np.isfinite(clip[k]).all() for k in ("pos", "quat", "ball"))
    np.testing.assert_allclose(np.linalg.norm(clip["quat"], axis=-1), 1, atol=1e-12)
    assert (np.sum(clip["quat"][1:] * clip["quat"][:-1], -1) > 0.9).all()


@pytest.mark.parametrize("kind", ["walk", "jog", "sidestep", "gesture"])
def test_limbs_have_constant_length(kind):
    height = 1.62
    clip, body = gait.generate(kind, 10, seed=1, height=height), gait.Body(height)
    pos = clip["pos"]
    assert np.isclose(gait.body_of(clip).height, height)

    def check(parent, child, offset):
        want = pos[:, INDEX[parent]] + rotation(clip, parent).apply(offset)
        np.testing.assert_allclose(pos[:, INDEX[child]], want, atol=1e-9)

    check("pelvis", "chest", body.chest)
    check("chest", "head", body.head)
    for j, (side, sign) in enumerate((("l", 1), ("r", -1))):
        check("pelvis", f"thigh_{side}", [0, sign * body.hip_half_width, 0])
        check(f"thigh_{side}", f"shin_{side}", [0, 0, -body.thigh])
        check(f"shin_{side}", f"foot_{side}", [0, 0, -body.shin])
        check("chest", f"upper_arm_{side}", body.shoulder * [1, sign, 1])
        check(f"upper_arm_{side}", f"forearm_{side}", [0, 0, -body.upper_arm])
        check(f"forearm_{side}", f"hand_{side}", [0, 0, -body.forearm])
        ball = pos[:, INDEX[f"foot_{side}"]] + rotation(clip, f"foot_{side}").apply(body.ball)
        np.testing.assert_allclose(clip["ball"][:, j], ball, atol=1e-9)


def test_standing_pose_is_the_reference_pose():
    clip = gait.generate("stand", 2, variation=0, height=1.7)
    for name in ("pelvis", "chest", "head", "foot_l", "foot_r"):
        assert rotation(clip, name).magnitude().max() < 8 * DEG  # toes point 6 degrees outward
    assert abs(clip["pos"][0, 0, 2] / 1.7 - 0.53) < 0.01
    left, right = (clip["pos"][0, INDEX[f"hand_{e}"]] for e in "lr")
    np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-9)


def test_straight_walking_is_symmetric():
    half = 16  # frames: 112.5 steps a minute at 30 frames a second
    clip = gait.generate("walk", 8, cadence=112.5, variation=0)
    advance = 1.3 * half / 30
    for name in ("foot", "shin", "hand"):
        left = clip["pos"][:-half, INDEX[f"{name}_l"]]
        right = clip["pos"][half:, INDEX[f"{name}_r"]]
        inside = slice(half, -half)  # the pelvis height is averaged over time, one-sidedly at the ends
        np.testing.assert_allclose((left * [1, -1, 1] + [advance, 0, 0])[inside], right[inside], atol=1e-6)


def test_walk_matches_published_curves():
    clip = gait.generate("walk", 6, rate=120, variation=0, speed=1.3)
    want = gait.walk_angles(np.arange(720) / 120 * gait.stride_frequency(1.3))  # the left heel strikes at t = 0
    down = rotation(clip, "thigh_l").apply([0, 0, -1])
    ankle = -(rotation(clip, "shin_l").inv() * rotation(clip, "foot_l")).as_euler("YXZ")[:, 0]
    got = {"hip": np.arctan2(down[:, 0], -down[:, 2]), "knee": knee(clip, "l"), "ankle": ankle}
    for name, limit in (("hip", 6), ("knee", 10.5), ("ankle", 8)):
        rms = np.sqrt(np.mean((got[name] - want[name]) ** 2)) / DEG
        assert rms < limit, f"{name}: {rms:.1f} degrees"
    assert 55 < got["knee"].max() / DEG < 70
    assert 0.03 < np.ptp(clip["pos"][:, 0, 2]) < 0.05


def test_walk_angles_pass_through_their_keys():
    got = gait.walk_angles(gait.WALK_PERCENT / 100)
    for name, keys in gait.WALK_ANGLES.items():
        np.testing.assert_allclose(got[name] / DEG, keys, atol=1e-9)


def test_jog_flies():
    clip = gait.generate("jog", 6, rate=60, seed=2)
    lowest = np.minimum(clip["ball"][..., 2].min(1), clip["pos"][:, [5, 8], 2].min(1))
    body = gait.Body()
    flight = clip["ball"][..., 2].min(1) > body.ball_height + 0.015
    assert 0.1 < flight.mean() < 0.5 and lowest.min() > 0
    assert (np.linalg.norm(np.diff(clip["pos"][:, 0], 2, axis=0), axis=1) * 3600).max() < 1.2 * gait.GRAVITY


@pytest.mark.parametrize(
    "kind, speed", [("walk", 0.5), ("walk", 1.0), ("walk", 1.6), ("jog", 2.0), ("jog", 3.0), ("turn", 1.0)]
)
def test_speed_is_what_was_asked_for(kind, speed):
    clip = gait.generate(kind, 20, seed=5, speed=speed)
    stride = round(clip["rate"] / float(gait.stride_frequency(speed, jog=kind == "jog")))
    assert abs(path_length(clip, stride) / speed - 1) < 0.05


@pytest.mark.parametrize("rate", [-1.0, -0.4, 0.3, 0.8])
def test_turn_rate_is_what_was_asked_for(rate):
    clip = gait.generate("turn", 20, seed=4, speed=0.9, turn_rate=rate)
    forward = rotation(clip, "pelvis").apply([1, 0, 0])
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    got = np.polyfit(np.arange(len(heading)) / 30, heading, 1)[0]
    assert abs(got / rate - 1) < 0.05


def test_cadence_and_stride():
    for params in ({"cadence": 100}, {"stride": 1.5}):
        clip = gait.generate("walk", 20, rate=60, variation=0, speed=1.25, **params)
        down = np.diff((clip["ball"][:, 0, 2] < gait.Body().ball_height + 1e-6).astype(int)) > 0
        assert abs(np.diff(np.flatnonzero(down)).mean() / 60 - 1.2) < 0.01


@pytest.mark.parametrize("kind", ["start", "stop", "sidestep"])
def test_rests_have_both_feet_flat_and_side_by_side(kind):
    clip = gait.generate(kind, 30, seed=0, variation=0, turn_rate=0.2 if kind == "start" else 0.0)
    feet = clip["pos"][:, [INDEX["foot_l"], INDEX["foot_r"]]]
    moving = np.linalg.norm(np.diff(feet, axis=0), axis=2).max(1) > 1e-6
    root = np.linalg.norm(np.diff(clip["pos"][:, 0, :2], axis=0), axis=1) * clip["rate"]
    rest = np.flatnonzero(~moving & (root < 0.01))
    assert 30 < len(rest) < 600 and np.count_nonzero(np.diff(rest) > 1) >= 1  # several rests
    np.testing.assert_allclose(clip["ball"][rest, :, 2], gait.Body().ball_height, atol=1e-3)
    np.testing.assert_allclose(feet[rest, :, 2], gait.Body().ankle_height, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(feet[rest, 0] - feet[rest, 1], axis=1), 0.17, atol=0.005)


def test_same_seed_same_bytes():
    a, b, c = gait.library(1.5, seed=1), gait.library(1.5, seed=1), gait.library(1.5, seed=2)
    assert all(x[k].tobytes() == y[k].tobytes() for x, y in zip(a, b, strict=True) for k in ("pos", "quat", "ball"))
    assert all(x["pos"].tobytes() != y["pos"].tobytes() for x, y in zip(a, c, strict=True) if x["pos"].shape)
    one, two = (gait.generate("walk", 5, seed=s)["pos"] for s in (0, 1))
    assert not np.array_equal(one, two)


@pytest.mark.parametrize(
    "mix, want", [(gait.MIX, -1793.617233), (gait.STANDING, 109.691672), (gait.BACKWARDS, 875.978156)]
)
def test_motions_are_what_they_were(mix, want):
    """Policies were trained and tables measured on them: no tidying may change a number.  A random sum of them all."""
    rng = np.random.default_rng(0)
    numbers = (clip[key] for clip in gait.library(2.0, mix=mix) for key in ("pos", "quat", "ball"))
    assert sum(float(np.sum(x * rng.normal(size=x.shape))) for x in numbers) == pytest.approx(want, abs=1e-5)


def test_library_covers_everything(clips):
    assert {c["name"].split("_")[1] for c in clips} == set(gait.KINDS)
    seconds = [len(c["pos"]) / c["rate"] for c in clips]
    assert abs(sum(seconds) - 600) < 1 and min(seconds) > 20 and max(seconds) < 40
    heights = [gait.body_of(c).height for c in clips]
    assert 1.5 <= min(heights) < 1.6 and 1.8 < max(heights) <= 1.9
    speeds = [path_length(c) for c in clips]
    assert max(speeds) > 2.5 and sum(0.5 < s < 1.7 for s in speeds) >= 8


def test_library_feet_neither_skate_nor_sink(clips, standing):
    for clip in clips + standing:
        slide, sink = gait.foot_report(clip)
        assert slide < 0.05 and sink < 0.005, f"{clip['name']}: slide {slide:.3f} m/s, sink {sink:.3f} m"


def test_library_moves_like_a_human(clips):
    for clip in clips:
        for side in "lr":
            angle = knee(clip, side)
            assert -2 * DEG < angle.min() and angle.max() < 150 * DEG, clip["name"]
            assert np.abs(np.diff(angle)).max() * clip["rate"] < 15, clip["name"]
        height = clip["pos"][:, 0, 2] / gait.body_of(clip).height
        assert 0.46 < height.min() and height.max() < 0.54, clip["name"]
        acceleration = np.diff(clip["pos"][:, 0], 2, axis=0) * clip["rate"] ** 2
        assert np.linalg.norm(acceleration, axis=1).max() < (10 if "jog" in clip["name"] else 6), clip["name"]


def test_library_legs_do_not_collide(clips, standing):
    for clip in clips + standing:
        shin = [0.5 * (clip["pos"][:, INDEX[f"shin_{e}"]] + clip["pos"][:, INDEX[f"foot_{e}"]]) for e in "lr"]
        for a, b in (shin, (clip["pos"][:, INDEX["foot_l"]], clip["pos"][:, INDEX["foot_r"]])):
            assert np.linalg.norm(a - b, axis=1).min() > 0.08, clip["name"]


def test_strokes_move_the_hands_alone():
    """As many movements as asked for, fast, within the ranges; the rest of the body is what it is without them."""
    calm, busy = (gait.generate("stand", 30, seed=4, strokes=s) for s in (0, 1.5))
    arms = [INDEX[f"{n}_{e}"] for n in ("upper_arm", "forearm", "hand") for e in "lr"]
    rest = [i for i in range(len(gait.SEGMENTS)) if i not in arms]
    assert np.array_equal(calm["pos"][:, rest], busy["pos"][:, rest])
    for e in "lr":
        hand = busy["pos"][:, INDEX[f"hand_{e}"]] - busy["pos"][:, INDEX["chest"]]
        speed = np.linalg.norm(np.diff(hand, axis=0), axis=1) * 30
        assert 2 < np.percentile(speed, 95) < 8
        moving = speed > 0.5
        starts = np.sum(moving[1:] & ~moving[:-1])
        assert 0.5 < starts / 30 < 2.0, starts
        elbow = (rotation(busy, f"upper_arm_{e}").inv() * rotation(busy, f"forearm_{e}")).magnitude() / DEG
        assert 9 < elbow[60:].min() and elbow.max() < 111
        wrist = (rotation(busy, f"forearm_{e}").inv() * rotation(busy, f"hand_{e}")).magnitude() / DEG
        assert 10 < wrist.max() < 36


def test_crouch_keeps_the_weight_above_the_feet():
    """The pelvis sinks by as much as was asked for, the feet stay, and the trunk's weight stays above them."""
    tall, low = (gait.generate("stand", 60, seed=2, crouch=c) for c in (0.0, 0.2))
    assert 0.15 < (tall["pos"][:, 0, 2] - low["pos"][:, 0, 2]).max() < 0.205  # the bow takes the rest
    np.testing.assert_allclose(tall["ball"], low["ball"], atol=1e-9)  # legs long enough, knees bent
    deep = np.argmax(tall["pos"][:, 0, 2] - low["pos"][:, 0, 2])
    middle = low["pos"][deep, [INDEX["pelvis"], INDEX["chest"], INDEX["head"]], 0].mean()
    foot = [low["pos"][deep, INDEX["foot_l"], 0] - 0.05, low["ball"][deep, :, 0].max()]
    assert foot[0] < middle < foot[1]


def test_sway_scales():
    one, three = (np.ptp(gait.generate("stand", 60, seed=2, sway=s)["pos"][:, 0, 1]) for s in (1.0, 3.0))
    assert np.isclose(three, 3 * one, rtol=1e-6)


@pytest.mark.parametrize("kind", gait.KINDS)
@pytest.mark.parametrize("duration", [0.2, 3.0])
def test_short_clips(kind, duration):
    clip = gait.generate(kind, duration, seed=1)
    assert len(clip["pos"]) == round(duration * 30) and np.isfinite(clip["pos"]).all()


def test_errors_name_what_is_valid():
    with pytest.raises(ValueError, match="sidestep"):
        gait.generate("moonwalk", 5)
    with pytest.raises(ValueError, match="turn_rate"):
        gait.generate("walk", 5, pace=2)
    with pytest.raises(ValueError, match="wave"):
        gait.generate("gesture", 5, gesture="salute")
    with pytest.raises(ValueError, match="positive"):
        gait.generate("walk", 0)
    for wrong in ({"strokes": -1}, {"sway": 9}, {"crouch": 0.5}, {"strokes": float("nan")}):
        with pytest.raises(ValueError, match="0 to 0.3 m"):
            gait.generate("stand", 5, **wrong)


def test_inspect_prints_a_table(capsys):
    """`python -m mocap inspect builtin`, and `standing`: a line a clip."""
    for name, clips in (("builtin", "turn_006 stand_007"), ("standing", "stand_003 stop_004")):
        inspect.main(["inspect", name])
        out = capsys.readouterr().out
        assert all(clip in out for clip in clips.split()) and f"{name} [all] 30 clips" in out
