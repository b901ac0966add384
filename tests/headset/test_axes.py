"""headset/axes.py: a stream's axes, unit, order and grip told from head, hands and forearms; wrong ones are found."""

import csv
import functools
import time

import numpy as np
import pytest
from test_mocap import walk as make_walk
from test_stream import sensors_dir, to_csv  # noqa: F401, a fixture

from headset import axes
from headset.axes import NAMES, beginning, choose, fits, guess, judge, lever, tracked, unit_of
from headset.reader import AXES, COLUMNS, UNIT, Reader, Sample, to_world
from human import quat_about, quat_mul, quat_rotate, sensors
from plumbing.cli import UserError

POINTING = quat_about(1, np.radians(75.0))  # from the hand's frame to that of what it points with


@functools.cache
def user(seconds=8.0):
    """A walker with controllers that point 15 degrees above the fingers, as arrays in our axes: t, pos, quat."""
    clip = make_walk(seconds, turn_rate=0.3)
    pos, quat = sensors(clip)
    quat = quat.copy()
    quat[:, 1:] = quat_mul(quat[:, 1:], POINTING)
    return np.arange(len(clip)) / clip.rate, pos, quat


def reexpressed(samples, source, target, unit=1.0, order=(0, 1, 2)):
    """Samples of one convention as another one would have them: x, y, z, w and positions in its axes and unit."""
    a, b, out = AXES[source], AXES[target], []
    m = b.T @ a  # file axes of the one to those of the other
    for s in samples:
        q = np.concatenate([np.round(np.linalg.det(m)) * (s.quat[:, :3] @ m.T), s.quat[:, 3:]], axis=1)
        out.append(Sample(s.t, (s.pos @ m.T / unit)[list(order)], q[list(order)]))
    return out


def in_axes(name="unity", **kw):
    t, pos, quat = user()
    ours = [Sample(t[k], pos[k], np.roll(quat[k], -1, axis=-1)) for k in range(len(t))]
    return reexpressed(ours, "mujoco", name, **kw)


def test_reexpressed():
    """The helper against to_world: what it makes is read back the same."""
    t, pos, quat = user()
    for name in NAMES:
        p, q = zip(*(to_world(s.pos, s.quat, name, 90.0, unit=1.0) for s in in_axes(name)), strict=True)
        np.testing.assert_allclose(p, pos, atol=1e-12)
        np.testing.assert_allclose(np.abs(np.sum(np.array(q) * quat, axis=-1)), 1.0, atol=1e-12)


# ---------------------------------------------------------------- what tells


def test_lever():
    """A device on a rod that turns about a point which drifts, in any frame."""
    rng, t = np.random.default_rng(0), np.arange(300) / 60.0
    angles = 0.5 * np.sin(np.outer(t, [3.0, 4.0, 5.0]) + rng.uniform(0, 6, 3))
    quat = quat_mul(quat_mul(quat_about(0, angles[:, 0]), quat_about(1, angles[:, 1])), quat_about(2, angles[:, 2]))
    rod = np.array([0.3, -0.02, -0.1])
    pos = quat_rotate(quat, np.tile(rod, (300, 1))) + 0.05 * np.sin(0.3 * t)[:, None]
    r, share = lever(t, pos, quat)
    np.testing.assert_allclose(r, rod, atol=0.02)
    assert share > 0.95
    all_three = np.stack([0 * pos, pos, pos], axis=1), np.stack([np.roll(quat, -1, axis=-1)] * 3, axis=1)
    for pair in ((0, 1), (0, 2)):
        np.testing.assert_allclose(axes.levers(t, *all_three)[pair][0], r)
    assert lever(t, np.zeros((300, 3)), quat)[1] == 0 and lever(t[:3], pos[:3], quat[:3])[1] == 0


def test_units():
    _, pos, _ = user()
    for unit in (1.0, 0.01, 0.001):
        assert unit_of(pos / unit) == unit
    assert unit_of(pos * 30.0) in (None, 0.01) and unit_of(np.zeros((4, 3, 3))) is None


@pytest.mark.parametrize("true", NAMES)
@pytest.mark.parametrize("told", NAMES)
def test_wrong_axes(true, told):
    """The built-in walker in every convention, read with every other, in metres and centimetres, hands exchanged."""
    plain = in_axes(true)
    assert guess(plain).axes == true and guess(plain).order == (0, 1, 2)
    lines = judge(plain, told, grip=15.0, unit=1.0)
    assert lines == [] if told == true else len(lines) == 1 and f"--axes {true}, not {told}" in lines[0]
    lines = judge(in_axes(true, unit=0.01), true, grip=15.0, unit=1.0)
    assert len(lines) == 1 and "in centimetres, not at 1 m a unit: --stream-unit 0.01" in lines[0]
    found = guess(in_axes(true, unit=0.01))
    assert found.axes == true and (found.unit or UNIT.get(true, 1.0)) == 0.01
    if true in ("unity", "openxr"):  # of the other two one is the other's mirror
        found = guess(in_axes(true, order=(0, 2, 1)))
        assert (found.axes, found.order) == (true, (0, 2, 1)) and "--devices head,right,left" in found.lines[0]
        assert any("--devices head,right,left" in line for line in judge(in_axes(true, order=(0, 2, 1)), true))
        found = guess(in_axes(true, order=(1, 0, 2)))
        assert found.order == (1, 0, 2) and found.axes == true


def test_grip():
    """Controllers that point, and a grip pose: the forearm says which."""
    points, t = in_axes("openxr"), user()[0]
    assert "--grip 15" in judge(points, "openxr")[0] and judge(points, "openvr") == []
    assert guess(points).grip == 15.0
    back = quat_about(1, np.radians(-75.0))
    held = [Sample(s.t, s.pos, s.quat.copy()) for s in points]
    _, pos, quat = user()
    for k, s in enumerate(held):
        own = quat_mul(quat[k, 1:], back)
        s.quat[1:] = reexpressed([Sample(0.0, pos[k], np.roll(np.stack([own[0], *own]), -1, axis=-1))],
                                 "mujoco", "openxr")[0].quat[1:]  # fmt: skip
    assert axes.grip_of(fits(held)[0].forearm) == 90.0 and judge(held, "openxr") == [] and len(t)
    assert "--grip 90" in judge(held, "unity")[-1] or "--axes openxr" in judge(held, "unity")[0]


def test_few():
    """Nothing is said of too little, of a headset alone, of samples that are no poses."""
    few = in_axes()[:10]
    assert judge(few) == [] and guess(few, "openxr").axes == "openxr" and "too little" in guess(few).lines[0]
    assert judge(in_axes(), "openxr", devices=1) == []
    bad = [Sample(s.t, s.pos * np.nan, s.quat) for s in in_axes()]
    assert tracked(bad) == [] and judge(bad, "openxr") == []
    fast = [Sample(k / 1000, s.pos, s.quat) for k, s in enumerate(in_axes())]
    assert len(tracked(fast)) < len(fast) / 10


def test_lying():
    """Controllers on a table tell nothing; a file is read until somebody takes them."""
    first = in_axes()[0]
    still = [Sample(s.t, np.stack([first.pos[0] + 0.01 * np.sin(s.t), *first.pos[1:]]), first.quat) for s in in_axes()]
    assert axes.lie(still) and not axes.lie(in_axes())
    assert "not sure" in guess(still).lines[0] and judge(still, "openxr") == [] == judge(still, "unity")


# ---------------------------------------------------------------- files and live streams


def lines_of_user(name="unity"):
    t, pos, quat = user()
    return to_csv(t, pos, quat, name)


def test_choose(tmp_path):
    """A file's axes are found, or judged; what the user says counts."""
    for name in NAMES:
        path = tmp_path / f"{name}.csv"
        path.write_text("".join(lines_of_user(name)))
        found = choose(path)
        assert found.axes == name and found.grip == 15.0 and f"--axes {name} --grip 15" in found.lines[0]
        assert choose(path, name, grip=15.0).lines == [] and choose(path, grip=40.0).grip == 40.0
        wrong = choose(path, "unity" if name != "unity" else "openxr", grip=15.0)
        assert any("--axes auto" in line for line in wrong.lines) and wrong.axes != name
        path.write_text(f"# mine; axes: {name}\n" + "".join(lines_of_user("unity")))  # what it says itself counts
        assert choose(path).axes == name and choose(path, "unreal").axes == "unreal"
        path.write_text("# axes: sideways\n" + "".join(lines_of_user(name)))  # and what is none does not
        assert choose(path).axes == name
    assert choose("-").axes == "unity" and choose("-", "openxr").lines == []
    with pytest.raises(UserError, match="--axes north: unknown; valid: auto, unity"):
        choose(path, "north")
    path.write_text("".join(lines_of_user()[:3]))
    assert "too little" in choose(path).lines[0]
    assert len(beginning(path)) == 2


def test_told(tmp_path):
    """With --axes auto what the user says of order, grip and unit counts, and the axes are found around it."""
    shuffled, path = in_axes("openxr", order=(1, 0, 2), unit=0.01), tmp_path / "s.csv"
    assert {f.order for f in fits(shuffled, order=(1, 0, 2))} == {(1, 0, 2)}
    rows = [np.concatenate([s.pos, s.quat], axis=1).ravel() for s in in_axes("unity", order=(0, 2, 1))]
    text = [",".join(COLUMNS), *(",".join(map(str, [t, *row])) for t, row in zip(user()[0], rows))]
    path.write_text("\n".join(text) + "\n")
    for order in ((0, 2, 1), (0, 1, 2)):
        found = choose(path, order=order, grip=40.0, unit=0.5)
        assert (found.order, found.grip, found.unit) == (order, 40.0, 0.5)
        assert "--grip 40" in found.lines[0] and "--stream-unit 0.5" in found.lines[0]
    assert choose(path, order=(0, 2, 1)).axes == "unity" and choose(path).order == (0, 2, 1)
    path.write_text("\n".join(text[:4]) + "\n")
    little = choose(path, order=(0, 2, 1), grip=40.0)
    assert "too little" in little.lines[0] and (little.order, little.grip) == ((0, 2, 1), 40.0)
    assert choose("-", order=(2, 0, 1)).order == (2, 0, 1)


def test_headset_alone(tmp_path):
    """Of a stream that is read for its headset alone the controllers, where there are any, still tell the axes."""
    path = tmp_path / "u.csv"
    path.write_text("".join(lines_of_user("openxr")))
    assert choose(path, devices=1).axes == "openxr" and choose(path, devices=1).order == (0, 1, 2)
    path.write_text("".join(",".join(line.split(",")[:8]).strip() + "\n" for line in lines_of_user("openxr")))
    alone = choose(path, devices=1)
    assert alone.axes == "unity" and "too little" in alone.lines[0] and not alone.usual


def test_usual(tmp_path):
    """Nothing need be said of Unity's axes; of all else, and of what is not sure, something."""
    path = tmp_path / "u.csv"
    path.write_text("".join(lines_of_user()))
    assert choose(path).usual and choose("-").usual and choose(path).lines and choose(path).told == []
    assert not any(choose(path, **k).usual for k in ({"order": (0, 2, 1)}, {"unit": 0.02}, {"wanted": "openxr"}))
    path.write_text("# axes: unity\n" + "".join(lines_of_user()))
    assert choose(path).usual
    for lines in (lines_of_user("openxr"), lines_of_user()[:3]):
        path.write_text("".join(lines))
        assert not choose(path).usual and choose(path).told == choose(path).lines != []
    assert not guess(in_axes(unit=0.01)).usual and not guess(in_axes(order=(0, 2, 1))).usual


def test_watch():
    """A live stream is judged after a second and after eleven; what was said is not said again."""
    samples, watch, said = in_axes("openxr"), axes.Watch("unity", 15.0), []
    longer = [Sample(s.t + 8.0 * k, s.pos, s.quat) for k in range(2) for s in samples]
    for s in longer:
        said += [(s.t, line) for line in watch.push(s)]
    assert len(said) == 1 and "--axes openxr, not unity" in said[0][1] and said[0][0] < 12
    right = axes.Watch("openxr", 15.0)
    assert not any(right.push(s) for s in longer) and right.due == []


# ---------------------------------------------------------------- recordings


def recordings(folder):
    """(name, its axes, its first seconds) of every recording."""
    for row in csv.DictReader(open(folder / "INDEX.csv")):
        path = folder / row["part"] / row["file"]
        samples = beginning(path)
        yield row["file"], "openxr" if row["file"].startswith(("webvr", "quest_steps")) else "unity", (
            beginning(path, seconds=axes.LONG) if axes.lie(samples) else samples
        )  # fmt: skip


def test_recorded(sensors_dir, capsys):  # noqa: F811
    """All recordings in all conventions, read with all others: how many are found, right ones left alone.

    Printed with pytest -s.  One has both controllers on a table nearly all the time: of it nothing can be told."""
    table, silent, guessed, total, swapped = {}, 0, 0, 0, 0
    for name, source, samples in recordings(sensors_dir):
        tells = not name.startswith("quest_steps")
        total += 1
        if tells:
            guessed += guess(samples).axes == source
        silent += judge(samples, source, grip=15.0) == []
        exchanged = reexpressed(samples, source, source, order=(0, 2, 1))
        swapped += any("--devices head,right,left" in line for line in judge(exchanged, source, grip=15.0))
        for true in NAMES:
            told_as = reexpressed(samples, source, true)
            for told in NAMES:
                lines = judge(told_as, told, grip=15.0, unit=1.0)
                said = sum(f"--axes {true}, not {told}" in line for line in lines)
                table[true, told] = table.get((true, told), 0) + (said if told != true else not lines)
    with capsys.disabled():
        print(f"\n{total} recordings: axes guessed {guessed}, right ones not complained of {silent}, "
              f"exchanged hands found {swapped}")  # fmt: skip
        print("recorded in \\ read as", *NAMES, "(on the diagonal: not complained of)")
        for true in NAMES:
            print(f"{true:21s}", *(f"{table[true, told]:{len(told)}d}" for told in NAMES))
    assert guessed >= total - 1 and silent == total and swapped >= total - 2
    for (true, told), count in table.items():
        assert count >= total - 1, (true, told)


def test_no_person(sensors_dir):  # noqa: F811
    """Rotations in the order w, x, y, z, and heights in the place of depths, are said to fit nobody; people are not."""
    total, complained = 0, {"as it is": [], "w x y z": [], "y and z exchanged": []}
    for name, _, samples in recordings(sensors_dir):
        turned = [s._replace(quat=np.roll(s.quat, 1, axis=-1)) for s in samples]
        exchanged = [s._replace(pos=s.pos[:, [0, 2, 1]]) for s in samples]
        total += 1
        for key, read in zip(complained, (samples, turned, exchanged), strict=True):
            if any("of 8: fits no person well" in line for line in guess(read).lines):
                complained[key].append(name)
    assert all(name.startswith("quest_steps") for name in complained["as it is"])
    assert len(complained["w x y z"]) == total
    assert len(complained["y and z exchanged"]) >= 0.9 * total


def test_first_second(sensors_dir):  # noqa: F811
    """After one second most mirrored readings are found, and no right one is complained of."""
    found, total = 0, 0
    for _, source, samples in recordings(sensors_dir):
        first = [s for s in samples if s.t - samples[0].t <= 1.0]
        other = "openxr" if source == "unity" else "unity"
        assert judge(first, source, grip=15.0) == []
        found += any(f"--axes {source}, not" in line for line in judge(first, other, grip=15.0))
        total += 1
    assert found > 0.8 * total, found


def test_speed():
    """Eleven seconds are judged in a fraction of one: a live stream must not stutter."""
    samples = in_axes() * 2
    start = time.process_time()
    judge(samples)
    assert time.process_time() - start < 0.5


def test_reader_reads_all_axes():
    """to_csv, the Reader and to_world agree for every convention, its unit included."""
    t, pos, quat = user()
    for name in AXES:
        sample = next(iter(Reader("x").read(to_csv(t, pos, quat, name))))
        p, q = to_world(sample.pos, sample.quat, name, 90.0)
        np.testing.assert_allclose(p, pos[0], atol=1e-6)
        assert abs(abs(np.sum(q * quat[0], axis=-1)) - 1.0).max() < 1e-6
