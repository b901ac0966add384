"""What every test shares: the repository on the path, software pictures, and the folder of recorded motion."""

import functools
import os
import sys
from pathlib import Path

import pytest

# As ppo.py does: two tests beside each other, or a training run beside the tests, make threads of BLAS wait for each
# other, ten times as long.  And with another number of threads sums differ in their last bit, which a fall makes large.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
sys.path += [str(folder) for folder in sorted((ROOT / "tests").iterdir()) if folder.is_dir()]  # helpers of other tests

if "MUJOCO_GL" not in os.environ and "DISPLAY" not in os.environ:
    from plumbing import render

    name = render.gl_backend()
    if name:
        os.environ["MUJOCO_GL"] = name


@pytest.fixture(scope="session")
def mocap_dir():
    """The folder of recorded motion that MOCAP_DIR names; the test is skipped without it."""
    name = os.environ.get("MOCAP_DIR")
    if not name:
        pytest.skip("MOCAP_DIR is not set: name a folder of recorded motion to run this test")
    if not Path(name).is_dir():
        pytest.fail(f"MOCAP_DIR={name} is not a folder")
    return Path(name)


@pytest.fixture(scope="session", autouse=True)
def motions_once():
    """The built-in motions are made once, not for every run of every module; who writes into them fails."""
    from mocap import data

    original, made = data.builtin_clips, {}

    @functools.wraps(original)
    def once(rate=data.CONTROL_RATE, seed=0, name="builtin"):
        if (rate, seed, name) not in made:
            made[rate, seed, name] = original(rate, seed, name)
            for clip in made[rate, seed, name]:
                for array in (clip.pos, clip.quat, clip.ball):
                    array.flags.writeable = False
        return list(made[rate, seed, name])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data, "builtin_clips", once)
        yield


@pytest.fixture(scope="module")
def char():
    """Jesse, one a module: what a module changes of it no other sees."""
    import character

    return character.load("jesse")


@pytest.fixture(scope="module")
def ref(char):
    """Two seconds each of a few built-in motions, retargeted."""
    import retarget
    from mocap import data

    return retarget.reference(char, [c[:60] for c in data.load("builtin", clips="*_00[57]")])
